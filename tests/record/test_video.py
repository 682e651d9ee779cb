"""FFV1 video: exact, and readable whatever happened to the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tapetum.errors import InputError
from tapetum.record.video import VideoWriter, count_frames, read_video


def images(count: int, dtype: type = np.uint8, size: tuple[int, int] = (60, 82)) -> list[np.ndarray]:
    """Noisy images, which compress badly."""
    rng = np.random.default_rng(3)
    return [rng.integers(0, np.iinfo(dtype).max, size, dtype, endpoint=True) for _ in range(count)]


def written(path: Path, given: list[np.ndarray]) -> Path:
    """Write a finished video."""
    with VideoWriter(path, given[0].shape, 15, given[0].dtype) as writer:
        for image in given:
            writer.write(image)
    return path


def matching(path: Path, given: list[np.ndarray], *, tolerant: bool) -> int:
    """Read a video, compare every frame, return how many there were."""
    number = 0
    for number, image in enumerate(read_video(path, tolerant=tolerant), start=1):
        assert np.array_equal(image, given[number - 1])
    return number


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("size", [(60, 82), (33, 17)])
def test_round_trip_is_exact(tmp_path: Path, dtype: type, size: tuple[int, int]) -> None:
    given = images(8, dtype, size)
    # A view that is not contiguous must arrive as it looks.
    given[3] = given[3][:, ::-1]
    file = written(tmp_path / "a.mkv", given)
    assert matching(file, given, tolerant=False) == count_frames(file) == 8
    assert next(read_video(file)).dtype == dtype


def test_every_truncation_is_noticed_and_tolerance_gives_the_whole_frames(tmp_path: Path) -> None:
    given = images(6)
    whole = written(tmp_path / "a.mkv", given).read_bytes()
    cut = tmp_path / "cut.mkv"
    seen = set()
    for length in np.linspace(700, len(whole) - 1, 40).astype(int):
        cut.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"cut\.mkv: the video is truncated or damaged: \d frames"):
            list(read_video(cut))
        seen.add(matching(cut, given, tolerant=True))
    assert seen >= {0, 1, 2, 3, 4, 5}


def test_a_damaged_frame_is_noticed(tmp_path: Path) -> None:
    given = images(6)
    file = written(tmp_path / "a.mkv", given)
    data = bytearray(file.read_bytes())
    place = len(data) // 2
    data[place : place + 40] = bytes(40)
    file.write_bytes(data)
    with pytest.raises(InputError, match=r"[234] frames could be read"):
        list(read_video(file))
    assert matching(file, given, tolerant=True) in (2, 3)


def test_unfinished_video_lacks_at_most_the_newest_frame(tmp_path: Path) -> None:
    given = images(5)
    writer = VideoWriter(tmp_path / "a.mkv", given[0].shape)
    for number, image in enumerate(given, start=1):
        writer.write(image)
        writer.flush()
        if number > 1:
            copy = tmp_path / "copy.mkv"
            copy.write_bytes((tmp_path / "a.mkv").read_bytes())
            assert matching(copy, given, tolerant=False) == number - 1
    writer.close()
    writer.close()
    assert matching(tmp_path / "a.mkv", given, tolerant=False) == 5


def test_a_video_without_a_frame_is_refused(tmp_path: Path) -> None:
    VideoWriter(tmp_path / "a.mkv", (20, 20)).close()
    with pytest.raises(InputError, match=r"a\.mkv: the video is truncated or damaged: 0 frames"):
        list(read_video(tmp_path / "a.mkv"))


def test_bad_arguments(tmp_path: Path) -> None:
    path = tmp_path / "a.mkv"
    with pytest.raises(InputError, match="float64"):
        VideoWriter(path, (10, 10), dtype=np.float64)
    with pytest.raises(InputError, match="size"):
        VideoWriter(path, (0, 10))
    with pytest.raises(InputError, match="rate"):
        VideoWriter(path, (10, 10), rate=0)
    with pytest.raises(InputError, match="full scale"):
        VideoWriter(path, (10, 10), full_scale=256)
    with VideoWriter(path, (10, 10)) as writer:
        with pytest.raises(InputError, match=r"frame 0 is \[10, 11\] uint8"):
            writer.write(np.zeros((10, 11), np.uint8))
        with pytest.raises(InputError, match="uint16"):
            writer.write(np.zeros((10, 10), np.uint16))
        writer.write(np.zeros((10, 10), np.uint8))
    with pytest.raises(InputError, match="closed"):
        writer.write(np.zeros((10, 10), np.uint8))


def test_stamps_that_do_not_rise_still_give_every_frame(tmp_path: Path) -> None:
    given = images(4, size=(20, 20))
    with VideoWriter(tmp_path / "a.mkv", (20, 20)) as writer:
        for image, time in zip(given, (0.0, 0.0001, 0.0002, 0.0), strict=True):
            writer.write(image, time)
    assert matching(tmp_path / "a.mkv", given, tolerant=False) == 4


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_full_disk_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.mkv").symlink_to("/dev/full")
    with (
        pytest.raises(InputError, match=r"a\.mkv: no room left on the disk"),
        VideoWriter(tmp_path / "a.mkv", (200, 200)) as writer,
    ):
        for image in images(10, size=(200, 200)):
            writer.write(image)
