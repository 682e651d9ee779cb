"""`tapetum dataset import`: what a newcomer sees, and what is never done without being asked."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import scipy.io

from tapetum.data import open_dataset
from tapetum.record.video import VideoWriter

N, SIDE = 20, 24
GAZE = np.stack([np.linspace(-0.4, 0.4, N), np.linspace(0.3, -0.2, N)], axis=1)


def pictures(height: int = SIDE, width: int = SIDE, off: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(1)
    rows, columns = np.mgrid[:height, :width]
    n = np.arange(N)[:, None, None]
    x, y = (width - 1) / 2 + off * np.sin(n), (height - 1) / 2 + off * np.cos(n)
    image = 12 + 180 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 18)
    return np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)


def npy(folder: Path) -> None:
    np.save(folder / "run1_images.npy", pictures())
    np.save(folder / "run1_labels.npy", GAZE)


def npz(folder: Path) -> None:
    np.savez(folder / "data.npz", images=pictures().astype(np.uint16) * 16, gaze_x=GAZE[:, 0], gaze_y=GAZE[:, 1])


def h5(folder: Path) -> None:
    with h5py.File(folder / "set.h5", "w") as file:
        file["rr"], file["labels"] = pictures(), GAZE
        file["video"] = np.repeat([1, 2], N // 2)


def mat(folder: Path) -> None:
    told = {"images": pictures().transpose(1, 2, 0), "gaze": GAZE, "ft": np.full(N, 50.0), "xd": np.full(N, 3.5)}
    scipy.io.savemat(folder / "old.mat", told)


def images(folder: Path) -> None:
    (folder / "frames").mkdir()
    rows = []
    for n, image in enumerate(pictures(50, 60, off=8)):
        cv2.imwrite(str(folder / "frames" / f"{n}.png"), image)
        rows.append([f"frames/{n}.png", *np.round(GAZE[n] + 0.5, 4), ["a", "b"][n % 2]])
    with (folder / "labels.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows([["filename", "gaze_x", "gaze_y", "phone"], *rows])


def videos(folder: Path) -> None:
    """Probe videos whose names tell focal length and object distance, as a Focusing set may be kept."""
    for name in ("50mm_3.5m.mkv", "85mm_4m.mkv"):
        with VideoWriter(folder / name, (50, 60)) as video:
            for image in pictures(50, 60, off=8):
                video.write(image)


LAYOUTS = {
    npy: ("gaze_x", "gaze_y"),
    npz: ("gaze_x", "gaze_y"),
    h5: ("gaze_x", "gaze_y"),
    mat: ("gaze_x", "gaze_y", "object_distance", "focal_length"),
    images: ("gaze_x", "gaze_y", "device"),
    videos: ("object_distance", "focal_length"),
}


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.__name__)
def test_a_folder_is_listed_and_proposed_and_imported_only_with_a_yes(layout, run, tmp_path: Path):
    folder, out = tmp_path / "theirs", tmp_path / "set.zarr"
    folder.mkdir()
    layout(folder)
    before = sorted(tmp_path.rglob("*"))
    asked = run("dataset", "import", folder, "-o", out)
    assert asked.code == 2
    assert "pass --yes, or save what was printed as map.yaml" in asked.complaint
    assert sorted(tmp_path.rglob("*")) == before
    # What is printed is a mapping file that does the same.
    (tmp_path / "map.yaml").write_text(asked.out)
    by_hand = run("dataset", "import", folder, "-o", out, "--mapping", tmp_path / "map.yaml")
    assert by_hand.code == 0, by_hand.err
    agreed = run("dataset", "import", folder, "-o", tmp_path / "again.zarr", "--yes")
    assert agreed.code == 0 and asked.out in agreed.out
    dataset = open_dataset(out)
    assert dataset.tp.hash == open_dataset(tmp_path / "again.zarr").tp.hash
    assert dataset.tp.targets == LAYOUTS[layout]
    assert f"{out}: " in by_hand.out and "to train on" in by_hand.out
    if "gaze_x" in dataset.tp.targets:
        np.testing.assert_allclose(dataset.tp.values(("gaze_x", "gaze_y")), GAZE, atol=1e-4)
    if layout in (npy, h5, mat):
        np.testing.assert_array_equal(dataset["image"], pictures())
    if layout is h5:
        assert dataset["split"].values.tolist() == ([0] * 8 + [1] * 2) * 2
    if layout is mat:
        assert float(dataset["focal_length"][0]) == pytest.approx(0.05)
    if layout is videos:
        assert sorted(set(dataset["object_distance"].values.tolist())) == [3.5, 4.0]
        np.testing.assert_allclose(np.unique(dataset["focal_length"]), [0.05, 0.085])


def test_pixels_need_a_size_that_nobody_can_guess(run, tmp_path: Path):
    np.savez(tmp_path / "a.npz", images=pictures(), x=640 * (GAZE[:, 0] + 0.5), y=480 * (GAZE[:, 1] + 0.5))
    ran = run("dataset", "import", tmp_path, "-o", tmp_path / "set.zarr", "--yes")
    assert ran.code == 2
    assert "the size of the target's frame is not known for gaze_x of a.npz" in ran.complaint
    text = ran.out.replace("size: null", "size: 640", 1).replace("size: null", "size: 480", 1)
    (tmp_path / "map.yaml").write_text(text)
    ran = run("dataset", "import", tmp_path, "-o", tmp_path / "set.zarr", "--mapping", tmp_path / "map.yaml")
    assert ran.code == 0
    values = open_dataset(tmp_path / "set.zarr").tp.values(("gaze_x", "gaze_y"))
    np.testing.assert_allclose(values, GAZE + 0.5 / np.array([640, 480]), atol=1e-6)


def test_a_person_is_asked_at_a_terminal(run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    npy(tmp_path)
    answers = iter([False, True])
    monkeypatch.setattr("typer.confirm", lambda text: next(answers))
    monkeypatch.setattr("tapetum.cli.dataset_import._at_terminal", lambda: True)
    no = run("dataset", "import", tmp_path, "-o", tmp_path / "set.zarr")
    assert no.code == 0 and "nothing imported; correct" in no.out
    assert not (tmp_path / "set.zarr").exists()
    by_hand = run("dataset", "import", tmp_path, "-o", tmp_path / "m.zarr", "--mapping", tmp_path / "set.yaml")
    assert by_hand.code == 0
    yes = run("dataset", "import", tmp_path, "-o", tmp_path / "set.zarr")
    assert yes.code == 0 and (tmp_path / "set.zarr" / "zarr.json").exists()


def test_half_copied_files_stop_the_import(run, tmp_path: Path):
    folder = tmp_path / "theirs"
    folder.mkdir()
    npz(folder)
    videos(folder)
    (folder / "readme.txt").write_text("What these files are, nobody says.\n")
    for name, told in {"data.npz": "truncated", "50mm_3.5m.mkv": "truncated"}.items():
        whole = (folder / name).read_bytes()
        for part in (b"", whole[: len(whole) // 2]):
            (folder / name).write_bytes(part)
            ran = run("dataset", "import", folder, "-o", tmp_path / "set.zarr", "--yes")
            assert ran.code == 2
            assert f"{folder / name}: " in ran.complaint and (told in ran.complaint or "is empty" in ran.complaint)
            assert "unreadable" in ran.out
            assert sorted(one.name for one in tmp_path.iterdir()) == ["theirs"]
        (folder / name).write_bytes(whole)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("nowhere",), "nowhere: does not exist"),
        (("empty",), "no pictures were found (nothing); give a folder with videos, images or arrays"),
        (("empty", "--mapping", "nowhere.yaml"), "nowhere.yaml: no such file"),
        (("npy", "--side", "100", "--yes"), "smaller than the crops of 100 px"),
    ],
)
def test_misuse(arguments: tuple[str, ...], told: str, run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    for name in ("empty", "npy"):
        (tmp_path / name).mkdir()
    npy(tmp_path / "npy")
    ran = run("dataset", "import", *arguments, "-o", "set.zarr")
    assert ran.code == 2 and told in ran.complaint
    assert not (tmp_path / "set.zarr").exists()


def test_what_stands_there_is_kept(run, tmp_path: Path):
    npy(tmp_path)
    out = tmp_path / "set.zarr"
    out.mkdir()
    assert "exists already" in run("dataset", "import", tmp_path, "-o", out, "--yes").complaint
    assert "is no tapetum-dataset" in run("dataset", "import", tmp_path, "-o", out, "--yes", "--overwrite").complaint
    out.rmdir()
    assert run("dataset", "import", tmp_path, "-o", out, "--yes").code == 0
    assert run("dataset", "import", tmp_path, "-o", out, "--yes", "--overwrite", "--side", 16).code == 0
    assert open_dataset(out).tp.side == 16
