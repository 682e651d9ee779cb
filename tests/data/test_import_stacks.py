"""Arrays, folders of images and videos with labels: imported, they are what they were."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import scipy.io
import xarray as xr

from tapetum.data import content_hash, open_dataset
from tapetum.data.crop import crop, find_centre
from tapetum.data.importing import import_dataset
from tapetum.data.importing.mapping import SCHEMA, mapping_from_dict
from tapetum.errors import InputError
from tapetum.record.video import VideoWriter

N, SIDE = 20, 24


def pictures(count: int = N, size: tuple[int, int] = (SIDE, SIDE), *, top: int = 255, off: float = 0.0) -> np.ndarray:
    """RRs about the middle, or wandering `off` pixels around it, [count, *size]."""
    rng = np.random.default_rng(1)
    rows, columns = np.mgrid[: size[0], : size[1]]
    n = np.arange(count)[:, None, None]
    x, y = (size[1] - 1) / 2 + off * np.sin(n), (size[0] - 1) / 2 + off * np.cos(n)
    image = top * (0.05 + 0.7 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 18))
    image = image + rng.normal(0, 0.01 * top, image.shape)
    return np.clip(np.rint(image), 0, top).astype(np.uint8 if top < 256 else np.uint16)


GAZE = np.stack([np.linspace(-0.4, 0.4, N), np.linspace(0.3, -0.2, N)], axis=1)


def mapping(stack: dict[str, Any], **more: Any) -> Any:
    return mapping_from_dict({"side": SIDE, "centred": True, "stacks": [stack], **more})


def imported(root: Path, stack: dict[str, Any], **more: Any) -> xr.Dataset:
    out = root / "out" / "set.zarr"
    import_dataset(mapping(stack, **more), root, out)
    return open_dataset(out)


def refused(root: Path, stack: dict[str, Any], **more: Any) -> str:
    """What is said; nothing may be left behind."""
    with pytest.raises(InputError) as told:
        imported(root, stack, **more)
    assert not (root / "out").exists()
    return str(told.value)


def two_columns(file: str, array: str | None = None) -> dict[str, Any]:
    where = {"file": file} if array is None else {"file": file, "array": array}
    return {"gaze_x": {**where, "column": 0}, "gaze_y": {**where, "column": 1}}


def save_npy(root: Path, images: np.ndarray) -> dict[str, Any]:
    np.save(root / "images.npy", images)
    np.save(root / "gaze.npy", GAZE)
    return {"images": {"file": "images.npy"}, "labels": two_columns("gaze.npy")}


def save_npz(root: Path, images: np.ndarray) -> dict[str, Any]:
    np.savez_compressed(root / "all.npz", images=images, gaze=GAZE)
    return {"images": {"file": "all.npz", "array": "images"}, "labels": two_columns("all.npz", "gaze")}


def save_h5(root: Path, images: np.ndarray) -> dict[str, Any]:
    with h5py.File(root / "all.h5", "w") as file:
        file.create_dataset("set/images", data=images, chunks=(4, SIDE, SIDE), compression="gzip")
        file["set/gaze"] = GAZE
    return {"images": {"file": "all.h5", "array": "set/images"}, "labels": two_columns("all.h5", "set/gaze")}


def save_mat_73(root: Path, images: np.ndarray) -> dict[str, Any]:
    # MATLAB's (y, x, frame) and (frame, 2) are turned in the file, behind 512 bytes of its own.
    with h5py.File(root / "new.mat", "w", userblock_size=512) as file:
        file["images"], file["gaze"] = images.transpose(0, 2, 1), GAZE.T
    with (root / "new.mat").open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(116))
    images_of = {"file": "new.mat", "array": "images", "axes": "frame x y"}
    return {"images": images_of, "labels": two_columns("new.mat", "gaze")}


def save_mat_5(root: Path, images: np.ndarray) -> dict[str, Any]:
    turned = images.transpose(1, 2, 0)
    scipy.io.savemat(root / "old.mat", {"images": turned, "gaze": GAZE}, do_compression=True)
    images_of = {"file": "old.mat", "array": "images", "axes": ["y", "x", "frame"]}
    return {"images": images_of, "labels": two_columns("old.mat", "gaze")}


SAVERS = (save_npy, save_npz, save_h5, save_mat_73, save_mat_5)


@pytest.mark.parametrize("save", SAVERS)
def test_arrays_keep_every_pixel_and_label(save: Callable[..., dict[str, Any]], tmp_path: Path):
    images = pictures(top=4095)
    dataset = imported(tmp_path, save(tmp_path, images), full_scale=4095)
    np.testing.assert_array_equal(dataset["image"], images)
    assert dataset["image"].dtype == np.uint16 and dataset.tp.full_scale == 4095
    np.testing.assert_allclose(dataset.tp.values(("gaze_x", "gaze_y")), GAZE, rtol=1e-6)
    assert dataset["split"].values.tolist() == [0] * 16 + [1] * 4
    assert content_hash(dataset) == dataset.tp.hash


@pytest.mark.parametrize("save", SAVERS)
@pytest.mark.parametrize("left", [0, 40, -200])
def test_half_copied_arrays_are_refused(save: Callable[..., dict[str, Any]], left: int, tmp_path: Path):
    stack = save(tmp_path, pictures())
    file = tmp_path / stack["images"]["file"]
    file.write_bytes(file.read_bytes()[:left])
    assert refused(tmp_path, stack).startswith(str(file))


def test_objects_are_never_unpickled(tmp_path: Path):
    class Trap:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (tmp_path / "sprung",))

    stack = save_npy(tmp_path, pictures())
    np.save(tmp_path / "images.npy", np.array([Trap()] * N, dtype=object), allow_pickle=True)
    assert "images.npy" in refused(tmp_path, stack)
    np.savez(tmp_path / "all.npz", images=pictures(), gaze=np.array([[Trap(), Trap()]] * N, dtype=object))
    stack = {"images": {"file": "all.npz", "array": "images"}, "labels": two_columns("all.npz", "gaze")}
    assert "all.npz" in refused(tmp_path, stack)
    assert not (tmp_path / "sprung").exists()


def test_values_in_other_files_are_refused(tmp_path: Path):
    (tmp_path / "secret").write_bytes(bytes(N * SIDE * SIDE))
    with h5py.File(tmp_path / "all.h5", "w") as file:
        where = [(str(tmp_path / "secret"), 0, N * SIDE * SIDE)]
        file.create_dataset("images", (N, SIDE, SIDE), "u1", external=where)
    np.save(tmp_path / "gaze.npy", GAZE)
    stack = {"images": {"file": "all.h5", "array": "images"}, "labels": two_columns("gaze.npy")}
    assert "other files" in refused(tmp_path, stack)


def table(root: Path, rows: list[dict[str, Any]]) -> None:
    with (root / "labels.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)


def folder(root: Path, count: int = 12) -> tuple[dict[str, Any], np.ndarray]:
    """Images that a table names, in two videos whose rows are mixed, with gaze in pixels and a phone."""
    images = pictures(count, (60, 70), off=9)
    (root / "frames").mkdir()
    rows = []
    for n, image in enumerate(images):
        cv2.imwrite(str(root / "frames" / f"p{n}.png"), image)
        place = {"x": 10 * n, "y": 5 * n, "clip": "ab"[n % 2], "frame": 100 - n, "phone": ["two", "one"][n % 2]}
        rows.append({"file": f"p{n}.png", **place, "xd": 3 + n % 2})
    table(root, rows)
    at = {"file": "labels.csv"}
    stack = {
        "images": {"folder": "frames", "names": {**at, "column": "file"}},
        "labels": {
            "gaze_x": {**at, "column": "x", "unit": "px", "size": 640},
            "gaze_y": {**at, "column": "y", "unit": "px", "size": 480, "flip": True},
            "object_distance": {**at, "column": "xd", "unit": "m"},
            "focal_length": "50 mm",
            "device": {**at, "column": "phone"},
        },
        "recording": {**at, "column": "clip"},
        "order": {**at, "column": "frame"},
    }
    return stack, images


def test_images_of_a_table_are_ordered_centred_and_split_by_video(tmp_path: Path):
    stack, images = folder(tmp_path)
    dataset = imported(tmp_path, stack, centred=False)
    order = [10, 8, 6, 4, 2, 0, 11, 9, 7, 5, 3, 1]  # the table counts frames down, and begins with clip a
    for n, image in zip(order, dataset["image"].values, strict=True):
        np.testing.assert_array_equal(image, crop(images[n], find_centre(images[n]), SIDE))
    n = np.array(order)
    np.testing.assert_allclose(dataset["gaze_x"], (10 * n - 319.5) / 640, rtol=1e-5)
    np.testing.assert_allclose(dataset["gaze_y"], -(5 * n - 239.5) / 480, rtol=1e-5)
    np.testing.assert_allclose(dataset["object_distance"], 3 + n % 2)
    np.testing.assert_allclose(dataset["focal_length"], 0.05)
    assert dataset.tp.classes == ("one", "two")
    assert dataset["device"].values.tolist() == [1] * 6 + [0] * 6
    assert dataset["split"].values.tolist() == ([0] * 5 + [1]) * 2
    assert dataset["recording"].values.tolist() == [0] * 6 + [1] * 6
    assert [one["name"] for one in dataset.tp.recordings] == ["frames a", "frames b"]


def test_a_video_with_a_table_and_a_split_of_its_own(tmp_path: Path):
    images = pictures(N, (40, 48), off=4)
    with VideoWriter(tmp_path / "a.mkv", (40, 48)) as video:
        for image in images:
            video.write(image)
    table(tmp_path, [{"xd": 3 + n / 10, "part": "test" if n % 4 == 0 else "train"} for n in range(N)])
    stack = {
        "images": {"file": "a.mkv"},
        "labels": {"object_distance": {"file": "labels.csv", "column": "xd"}},
        "split": {"file": "labels.csv", "column": "part"},
    }
    dataset = imported(tmp_path, stack, centred=False)
    np.testing.assert_array_equal(dataset["image"][7], crop(images[7], find_centre(images[7]), SIDE))
    np.testing.assert_allclose(dataset["object_distance"], 3 + np.arange(N) / 10, rtol=1e-6)
    assert dataset["split"].values.tolist() == [int(n % 4 == 0) for n in range(N)]
    np.testing.assert_allclose(dataset["time"], np.arange(N) / 15)


def test_frames_without_an_rr_are_left_out_and_counted(tmp_path: Path):
    images = pictures(N, (64, 64))
    images[3] = images[9] = 12
    np.save(tmp_path / "images.npy", images)
    stack = {"images": {"file": "images.npy"}, "labels": {"object_distance": 3}}
    dataset = imported(tmp_path, stack, centred=False)
    assert dataset["frame_index"].values.tolist() == [n for n in range(N) if n not in (3, 9)]
    assert dataset.tp.recordings[0]["left_out"] == {"no label": 0, "no visible RR": 2}
    assert dataset["split"].values.tolist() == [0] * 14 + [1] * 4


def test_small_pictures_are_padded_only_when_asked(tmp_path: Path):
    stack = save_npy(tmp_path, pictures())
    assert "smaller than the crops of 32 px; set 'side: 24' (--side), or 'pad: true'" in refused(
        tmp_path, stack, side=32
    )
    dataset = imported(tmp_path, stack, side=32, pad=True)
    np.testing.assert_array_equal(dataset["image"][0, 4:28, 4:28], pictures()[0])


def test_real_numbers_and_colours(tmp_path: Path):
    grey = pictures().astype(np.float64) / 255
    stack = save_npy(tmp_path, grey)
    assert "depth of float64" in refused(tmp_path, stack)
    dataset = imported(tmp_path, stack, full_scale=1)
    np.testing.assert_array_equal(dataset["image"], grey.astype(np.float32))
    np.save(tmp_path / "images.npy", np.repeat(pictures()[..., None], 3, axis=3))
    stack["images"]["axes"] = "frame y x channel"
    import_dataset(mapping(stack), tmp_path, tmp_path / "rgb.zarr")
    np.testing.assert_array_equal(open_dataset(tmp_path / "rgb.zarr")["image"], pictures())


@pytest.mark.parametrize("slices", [1, SIDE * SIDE * 3])
def test_slices_join_without_a_seam(slices: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("tapetum.data.importing.pictures.SLICE", slices)
    dataset = imported(tmp_path, save_h5(tmp_path, pictures()))
    np.testing.assert_array_equal(dataset["image"], pictures())


def spoil(root: Path, what: str, stack: dict[str, Any]) -> dict[str, Any]:
    """Change one thing; return more keys of the mapping."""
    images, gaze = pictures(), GAZE.copy()
    if what == "nan label":
        gaze[4, 1] = np.nan
    elif what == "rows":
        gaze = gaze[:-3]
    elif what == "pixels as fractions":
        gaze *= 640
    elif what == "nan pixel":
        images = images.astype(np.float32)
        images[2, 3, 3] = np.nan
        np.save(root / "images.npy", images)
        return {"full_scale": 255}
    elif what == "too deep":
        np.save(root / "images.npy", pictures(top=4095))
        return {"full_scale": 1023}
    elif what == "axes":
        stack["images"]["axes"] = "frame y x channel"
    elif what == "array":
        stack["labels"]["gaze_x"]["column"] = 2
    elif what == "missing":
        stack["images"]["file"] = "nowhere.npy"
    elif what == "unit":
        stack["labels"]["object_distance"] = "3 kg"
    elif what == "size":
        stack["labels"]["gaze_x"]["unit"] = "px"
    np.save(root / "gaze.npy", gaze)
    return {}


@pytest.mark.parametrize(
    ("what", "told"),
    [
        ("nan label", "gaze_y is missing or not finite for 1 of 20 pictures, first for 4"),
        ("rows", "has 17 values for 20 pictures"),
        ("pixels as fractions", "lies up to 256 of the field"),
        ("nan pixel", "images.npy picture 2: holds values that are not finite"),
        ("too deep", "allowed are 0 to 1023"),
        ("axes", "has 3 axes (20 x 24 x 24), the mapping names 4"),
        ("array", "has 2 columns, none is 2"),
        ("missing", "nowhere.npy: does not exist"),
        ("unit", "'3 kg' has the wrong dimension"),
        ("size", "pixels need the size of the target's frame"),
    ],
)
def test_what_does_not_fit_is_told_in_one_line(what: str, told: str, tmp_path: Path):
    stack = save_npy(tmp_path, pictures())
    line = refused(tmp_path, stack, **spoil(tmp_path, what, stack))
    assert told in line and "\n" not in line


def test_missing_labels_may_be_dropped(tmp_path: Path):
    stack = save_npy(tmp_path, pictures())
    spoil(tmp_path, "nan label", stack)
    dataset = imported(tmp_path, stack, missing="drop")
    assert dataset.sizes["frame"] == N - 1
    assert dataset.tp.recordings[0]["left_out"]["no label"] == 1


def test_tables_are_read_strictly(tmp_path: Path):
    stack, _ = folder(tmp_path)
    file = tmp_path / "labels.csv"
    whole = file.read_text()
    for text, told in {
        "": "labels.csv: is empty",
        whole[: whole.rindex(",") - 6]: "line 13 has 5 cells, the first 7",
        whole.replace(",x,", ",column,"): "has no column 'x'",
        whole.replace("p3.png", "p33.png"): "1 of 12 images are missing, the first is 'p33.png'",
        whole.replace("p3.png", "../labels.csv"): "lies outside of the images' folder",
        whole.replace(",30,", ",thirty,"): "row 3 holds 'thirty', no number",
    }.items():
        file.write_text(text)
        assert told in refused(tmp_path, stack, centred=False)


def test_a_damaged_image_or_video_is_told(tmp_path: Path):
    stack, _ = folder(tmp_path)
    image = tmp_path / "frames" / "p7.png"
    image.write_bytes(image.read_bytes()[:-60])
    assert "p7.png: the image is truncated" in refused(tmp_path, stack, centred=False)
    with VideoWriter(tmp_path / "a.mkv", (SIDE, SIDE)) as video:
        for one in pictures():
            video.write(one)
    cut = tmp_path / "a.mkv"
    cut.write_bytes(cut.read_bytes()[:-2000])
    stack = {"images": {"file": "a.mkv"}, "labels": {"object_distance": 3}}
    assert "the video is truncated" in refused(tmp_path, stack)


def test_a_video_that_states_more_frames_than_it_holds_is_refused(tmp_path: Path):
    import av

    with av.open(str(tmp_path / "a.avi"), "w") as container:
        stream = container.add_stream("mjpeg", rate=15)
        stream.width, stream.height, stream.pix_fmt = SIDE * 2, SIDE * 2, "yuvj420p"
        for image in pictures(N, (SIDE * 2, SIDE * 2)):
            frame = av.VideoFrame.from_ndarray(np.repeat(image[..., None], 3, axis=2), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    file = tmp_path / "a.avi"
    stack = {"images": {"file": "a.avi"}, "labels": {"object_distance": 3}}
    import_dataset(mapping(stack), tmp_path, tmp_path / "whole.zarr")
    assert open_dataset(tmp_path / "whole.zarr").sizes["frame"] == N
    whole = file.read_bytes()
    # Between the frames' beginning and the index after them: how large the header is beside them depends on the
    # encoder's threads.
    file.write_bytes(whole[: (whole.index(b"movi") + whole.rindex(b"idx1")) // 2])
    assert "a.avi: the video is truncated or damaged" in refused(tmp_path, stack)


def test_two_stacks_share_their_classes(tmp_path: Path):
    np.save(tmp_path / "images.npy", pictures())
    stacks = [{"images": {"file": "images.npy"}, "labels": {"device": name}, "name": name} for name in ("p2", "p1")]
    whole = mapping_from_dict({"schema": SCHEMA, "side": SIDE, "centred": True, "stacks": stacks})
    import_dataset(whole, tmp_path, tmp_path / "set.zarr")
    dataset = open_dataset(tmp_path / "set.zarr")
    assert dataset.tp.classes == ("p1", "p2")
    assert dataset["device"].values.tolist() == [1] * N + [0] * N
    assert [one["name"] for one in dataset.tp.recordings] == ["p2", "p1"]
