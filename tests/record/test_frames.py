"""Reading frames: images of every kind, folders, videos, and each way they can be bad."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from tapetum.errors import InputError
from tapetum.record.frames import SOURCES, Asked, FrameSource, SourceKind, open_frames
from tapetum.record.images import read_image
from tapetum.record.source import Frame
from tapetum.record.video import VideoWriter

DATA = Path(__file__).parents[2] / ".." / "shared" / "data"
SPOTS, STARS = DATA / "laser-spots", DATA / "star-fields"
needs_data = pytest.mark.skipif(not SPOTS.is_dir(), reason="the real frames of ../shared/data are not here")


def picture(dtype: type = np.uint8, height: int = 40, width: int = 60, seed: int = 0) -> np.ndarray:
    """Random numbers over the type's whole range."""
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, (height, width), dtype, endpoint=True)


@pytest.mark.parametrize("suffix", ["png", "tif", "tiff", "pgm", "pnm"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_lossless_images_come_back_exactly(tmp_path: Path, suffix: str, dtype: type) -> None:
    image = picture(dtype)
    file = tmp_path / f"a.{suffix}"
    cv2.imwrite(str(file), image)
    source = open_frames(file)
    (frame,) = source
    assert frame.image.dtype == dtype and np.array_equal(frame.image, image)
    assert source.count == len(source) == 1
    assert source.full_scale == frame.full_scale == np.iinfo(dtype).max


def test_bmp_and_jpg(tmp_path: Path) -> None:
    smooth = np.tile(np.arange(60, dtype=np.uint8), (40, 1))
    for name, tolerance in (("a.bmp", 0), ("b.jpg", 3), ("c.JPEG", 3)):
        cv2.imwrite(str(tmp_path / name), smooth)
        (frame,) = open_frames(tmp_path / name)
        assert np.abs(frame.image.astype(int) - smooth).max() <= tolerance


def test_colour_becomes_luma_in_both_depths(tmp_path: Path) -> None:
    for dtype in (np.uint8, np.uint16):
        top = np.iinfo(dtype).max
        colour = np.zeros((4, 6, 4), dtype)
        colour[..., 2], colour[..., 3] = top, top  # opaque red
        cv2.imwrite(str(tmp_path / "red.png"), colour)
        image, _ = read_image(tmp_path / "red.png")
        assert image.shape == (4, 6) and image.dtype == dtype
        assert np.allclose(image / top, 0.299, atol=0.01)


def test_pgm_of_12_bit_is_big_endian_and_states_its_scale(tmp_path: Path) -> None:
    image = picture(np.uint16) % 4096
    header = b"P5\n# a camera's comment 8 8 8\n60 40\n4095\n"
    (tmp_path / "a.pgm").write_bytes(header + image.astype(">u2").tobytes())
    (frame,) = open_frames(tmp_path / "a.pgm")
    assert np.array_equal(frame.image, image) and frame.full_scale == 4095


def test_tiff_of_several_pages_is_several_frames(tmp_path: Path) -> None:
    pages = [picture(np.uint16, seed=seed) for seed in range(3)]
    cv2.imwritemulti(str(tmp_path / "stack.tif"), pages)
    frames = list(open_frames(tmp_path / "stack.tif", rate=10))
    assert all(np.array_equal(frame.image, page) for frame, page in zip(frames, pages, strict=True))
    assert [frame.time for frame in frames] == pytest.approx([0, 0.1, 0.2])


def test_folder_in_natural_order_of_differing_sizes_and_again(tmp_path: Path) -> None:
    for number in (10, 9, 1):
        cv2.imwrite(str(tmp_path / f"frame{number}.png"), np.full((number + 1, 5), number, np.uint8))
    (tmp_path / "notes.txt").write_text("not a frame")
    (tmp_path / "._frame2.png").write_bytes(b"a Mac's shadow")
    source = open_frames(tmp_path)
    assert isinstance(source, FrameSource) and source.count == 3
    for _ in range(2):
        assert [(frame.index, frame.name, frame.image.shape) for frame in source] == [
            (0, "frame1.png", (2, 5)),
            (1, "frame9.png", (10, 5)),
            (2, "frame10.png", (11, 5)),
        ]


def test_missing_path_and_empty_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        open_frames(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"no images.*png, tif, tiff, pgm"):
        open_frames(tmp_path)


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "tiff", "pgm"])
@pytest.mark.parametrize("left", [0.0, 0.1, 0.6, 0.97])
def test_truncated_images_are_told_in_one_line(
    tmp_path: Path, suffix: str, left: float, capfd: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / f"cut.{suffix}"
    cv2.imwrite(str(file), picture(height=100, width=120))
    data = file.read_bytes()
    file.write_bytes(data[: int(left * len(data))])
    with pytest.raises(InputError, match=r"cut\.\w+: .*(truncated|empty)") as caught:
        list(open_frames(tmp_path))
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("damage", ["cut", "overwritten"])
def test_damaged_jpegs_are_told(tmp_path: Path, damage: str, capfd: pytest.CaptureFixture[str]) -> None:
    """OpenCV fills what is missing with grey, where a search then finds what is not there."""
    file = tmp_path / "bad.jpg"
    cv2.imwrite(str(file), picture(height=100, width=120))
    data = file.read_bytes()
    half = len(data) // 2
    bad = {"cut": data[:half] + b"\xff\xd9", "overwritten": data[:half] + 200 * b"\xff\x00" + data[half + 400 :]}
    file.write_bytes(bad[damage])
    with pytest.raises(InputError, match=r"bad\.jpg: the image is damaged"):
        list(open_frames(file))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("flags", [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]])
def test_whole_jpegs_are_read(tmp_path: Path, flags: list[int]) -> None:
    file = tmp_path / "whole.jpg"
    cv2.imwrite(str(file), picture(height=101, width=123), flags)
    # Some cameras append a little.
    file.write_bytes(file.read_bytes() + bytes(100))
    assert next(iter(open_frames(file))).image.shape == (101, 123)


def test_a_float_tiff_is_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.tiff"), np.ones((4, 4), np.float32))
    with pytest.raises(InputError, match="float32 samples; save it with 8 or 16 bit"):
        list(open_frames(tmp_path / "a.tiff"))


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.txt", b"some words\n" * 50),
        ("a.mp4", bytes(5000)),
        ("list.m3u8", b"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nother.ts\n#EXT-X-ENDLIST\n"),
    ],
)
def test_what_is_no_video_is_refused(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match="not a video that can be read"):
        open_frames(tmp_path / name)


def test_an_empty_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mkv").touch()
    with pytest.raises(InputError, match="0 frames could be read"):
        open_frames(tmp_path / "a.mkv")


def test_a_recording_by_name_only(tmp_path: Path) -> None:
    (tmp_path / "a.rec").mkdir()
    with pytest.raises(InputError, match=r"recording\.json"):
        open_frames(tmp_path / "a.rec")


def test_video_as_a_source_has_the_files_times_and_scale(tmp_path: Path) -> None:
    images = [picture(np.uint16, seed=seed) % 1024 for seed in range(4)]
    times = [0.0, 0.07, 0.13, 0.31]
    with VideoWriter(tmp_path / "odd:name.mkv", (40, 60), 15, np.uint16, full_scale=1023) as writer:
        for image, time in zip(images, times, strict=True):
            writer.write(image, time)
    source = open_frames(tmp_path / "odd:name.mkv")
    assert source.full_scale == 1023
    with pytest.raises(TypeError):
        len(source)
    for _ in range(2):
        frames = list(source)
        assert [frame.time for frame in frames] == pytest.approx(times)
        assert all(np.array_equal(frame.image, image) for frame, image in zip(frames, images, strict=True))
        assert frames[2].name == "odd:name[2]" and frames[2].full_scale == 1023


def other_video(path: Path, codec: str, pixels: str, count: int = 12) -> None:
    """Write a colour video that is not ours: brightness rises from frame to frame."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, pixels
        for number in range(count):
            colour = np.full((48, 64, 3), 20 * number, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(colour, format="rgb24")))
        container.mux(stream.encode(None))


@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [("a.mp4", "libx264", "yuv420p"), ("a.avi", "mjpeg", "yuvj420p"), ("a.mkv", "ffv1", "yuv420p10le")],
)
def test_other_videos_are_read_as_grey(tmp_path: Path, name: str, codec: str, pixels: str) -> None:
    other_video(tmp_path / name, codec, pixels)
    source = open_frames(tmp_path / name)
    frames = list(source)
    assert len(frames) == 12 and source.count in (None, 12)
    for frame in frames:
        assert frame.image.mean() / source.full_scale == pytest.approx(20 * frame.index / 255, abs=0.02)
        assert frame.time == pytest.approx(frame.index / 25, abs=1e-3)


@pytest.mark.parametrize(("name", "codec"), [("a.mp4", "libx264"), ("a.avi", "mjpeg")])
def test_other_videos_cut_short_are_told(tmp_path: Path, name: str, codec: str) -> None:
    other_video(tmp_path / name, codec, "yuv420p" if codec == "libx264" else "yuvj420p")
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=name):
        list(open_frames(tmp_path / name))


def test_a_frame_must_be_grey_and_whole() -> None:
    with pytest.raises(InputError, match="must be"):
        Frame(0, 0.0, np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(InputError, match="float64"):
        Frame(0, 0.0, np.zeros((4, 4)))


@needs_data
def test_the_virtual_bench_is_a_source(tmp_path: Path) -> None:
    source = open_frames("bench:hand-held", rate=30.0)
    frames = iter(source)
    first, second = next(frames), next(frames)
    assert (source.name, source.rate, source.live) == ("probe", 30.0, False)
    assert first.image.shape == source.first().image.shape
    assert first.lit is True
    assert second.utc_ns is not None
    assert abs(second.time - 1 / 30) < 0.02
    # The same scene gives the same frames again.
    assert np.array_equal(next(iter(open_frames("bench:hand-held", rate=30.0))).image, first.image)
    target = open_frames("bench:hand-held", "target")
    assert target.name == "target"
    for name, stream, what in (("bench:nowhere", "probe", "no such scene"), ("bench:hand-held", "third", "third")):
        with pytest.raises(InputError, match=what):
            open_frames(name, stream)


def test_a_kind_of_source_is_added_in_one_place(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((16, 16), 7, np.uint8))
    kind = SourceKind(
        lambda name: name.startswith("mine:"),
        lambda name, asked: open_frames(tmp_path / f"{name[5:]}.png", rate=asked.rate),
    )
    monkeypatch.setattr("tapetum.record.frames.SOURCES", {"mine": kind, **SOURCES})
    assert next(iter(open_frames("mine:a"))).image[0, 0] == 7
    assert Asked().stream == "probe"


def test_real_laser_spots() -> None:
    frames = {frame.name: frame for frame in open_frames(SPOTS)}
    assert len(frames) == len(list(SPOTS.glob("*.pgm")))
    for name, dtype in (("t-hene.pgm", np.uint8), ("TEM01_200mm.pgm", np.uint16)):
        raw = (SPOTS / name).read_bytes()
        pixels = frames[name].image
        stored = np.frombuffer(raw[-pixels.size * np.dtype(dtype).itemsize :], np.dtype(dtype).newbyteorder(">"))
        assert pixels.dtype == dtype and np.array_equal(pixels.ravel(), stored)
    names = list(frames)
    assert names.index("t-168mm.pgm") < names.index("t-210mm.pgm") < names.index("t-nolens.pgm")


@needs_data
def test_real_star_fields() -> None:
    frames = list(open_frames(STARS))
    assert [frame.image.shape for frame in frames] == [(768, 1024)] * 2
    assert all(frame.image.dtype == np.uint16 and frame.full_scale == 65535 for frame in frames)
    assert max(frame.image.max() for frame in frames) == 65535
