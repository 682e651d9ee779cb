"""Cameras of a room in a modulated video by hand; ghosts at one offset; what the detector says it could not use."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import av
import cv2
import numpy as np
import pyarrow as pa
import pytest
from pyarrow.csv import write_csv
from pyarrow.parquet import write_table

from tapetum.cli.app import main
from tapetum.detection import Found
from tapetum.errors import InputError
from tapetum.record.recording import RecordingWriter, StreamInfo
from tapetum.record.source import Frame
from tapetum.track import Detections, detect, read_tracks, retrack, track, track_to_file
from tapetum.track.cameras import CameraDetector
from tapetum.track.ghosts import Ghost, calibrate_ghost
from tapetum.track.motion import MOTION
from tapetum.track.tables import detections_schema, read_table

CAMERAS = [(120.0, 80.0, 150.0), (300.0, 210.0, 110.0), (230.0, 120.0, 75.0)]


def room(seed: int, height: int = 300, width: int = 400) -> np.ndarray:
    """Walls, furniture and lamps, softened as by a lens."""
    rng = np.random.default_rng(seed)
    picture = np.full((height, width), 80.0, np.float32)
    for _ in range(100):
        x, y, level = rng.uniform(0, width), rng.uniform(0, height), float(rng.uniform(20, 150))
        w, h = rng.uniform(6, 80, 2)
        cv2.rectangle(picture, (int(x), int(y)), (int(x + w), int(y + h)), level, -1)
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.9))


def shot(
    picture: np.ndarray, lit: bool | None, shift: tuple[float, float], seed: int, cameras=CAMERAS, full: int = 255
) -> np.ndarray:
    """A frame by hand, with the cameras' light where it is lit."""
    h, w = picture.shape
    light = picture.copy()
    for x, y, height in cameras if lit else ():
        down, along = (np.exp(-((np.arange(n) - at) ** 2) / (2 * 1.3**2)) for n, at in ((h, y), (w, x)))
        light += np.outer(height * down, along).astype(np.float32)
    way = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
    moved = cv2.warpAffine(light, way, (w, h), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    noisy = moved + np.random.default_rng(seed).normal(0, 2, (h, w))
    return np.clip(noisy * full / 255, 0, full).round().astype(np.uint8 if full == 255 else np.uint16)


def modulated(count: int, first_lit: bool, known: bool = True, full: int = 255) -> tuple[list[Frame], np.ndarray]:
    """Frames lit and dark in turns, shaken by some 6 pixels, and where the frame went, [count, 2]."""
    picture, rng = room(1), np.random.default_rng(7)
    shifts = rng.normal(0, 6, (count, 2))
    frames = []
    for n, shift in enumerate(shifts.tolist()):
        lit = (n % 2 == 0) == first_lit
        image = shot(picture, lit, (shift[0], shift[1]), n, full=full)
        frames.append(Frame(n, n / 30, image, full_scale=full, lit=lit if known else None))
    return frames, shifts


@pytest.mark.parametrize("first_lit", [True, False], ids=["lit first", "dark first"])
@pytest.mark.parametrize("full", [255, 4095])
def test_a_modulated_video_is_compared_lit_with_dark(first_lit: bool, full: int) -> None:
    frames, shifts = modulated(12, first_lit, full=full)
    detector = CameraDetector()
    ids: dict[int, set[int]] = {}
    for one in track(frames, detector=detector):
        if one.moment["lit"] is False:
            assert len(one.detections) == 0
            continue
        for row in one.rows:
            if row.seen:
                apart = [math.dist((row.x, row.y), np.add(camera[:2], shifts[one.frame])) for camera in CAMERAS]
                assert min(apart) < 1.5
                ids.setdefault(int(np.argmin(apart)), set()).add(row.track)
    assert sorted(ids) == [0, 1, 2] and [len(one) for one in ids.values()] == [1, 1, 1]
    assert detector.notes == ({"no dark frame came before": 1} if first_lit else {})


@pytest.mark.parametrize(("rate", "count", "missed"), [(None, 24, 1), (0.02, 14, 0)])
def test_no_camera_is_a_row_before_it_persisted(tmp_path: Path, rate: float | None, count: int, missed: int) -> None:
    frames, _ = modulated(count, False)
    # By default (0.01) one of the 36 sightings is missed: its estimated rate is 0.014.
    wanted = {} if rate is None else {"detect_options": {"false_alarms": rate}}
    options = {"detector": "cameras", "detections": tmp_path / "d.csv", **wanted}
    summary = track_to_file(frames, tmp_path / "t.csv", **options)
    assert summary.tracks == 3
    rows = read_tracks(tmp_path / "t.csv").to_pylist()
    begun = [row for row in rows if row["event"] == "begun"]
    assert [row["frame"] for row in begun] == [5] * 3
    assert {row["event"] for row in rows if row["lit"] is False} == {"dark"}
    assert sum(not row["seen"] for row in rows if row["lit"]) <= missed


def test_a_dim_camera_is_found_as_it_persists(tmp_path: Path) -> None:
    """In single pairs one that chance makes as bright is expected in every fifth to every fiftieth frame."""
    picture, dim = room(1), (120.0, 80.0, 26.0)
    shifts = np.random.default_rng(7).normal(0, 6, (40, 2)).tolist()
    frames = [
        Frame(n, n / 30, shot(picture, n % 2 == 1, (x, y), n, cameras=[dim]), full_scale=255, lit=n % 2 == 1)
        for n, (x, y) in enumerate(shifts)
    ]
    files = [tmp_path / name for name in ("t.parquet", "d.parquet", "old.parquet")]
    track_to_file(frames, files[0], detector="cameras", detections=files[1])
    rows = read_tracks(files[0]).to_pylist()
    seen = [row for row in rows if row["seen"]]
    assert len(seen) >= 15 and len({row["track"] for row in seen}) == 1
    for row in seen:
        assert math.dist((row["x"], row["y"]), np.add(dim[:2], shifts[row["frame"]])) < 1.5
    # What counts little is kept, and followed in the same way again.
    detections = read_table(files[1], detections_schema())
    assert 0 < sum(one is not None and one < 1 for one in detections["evidence"].to_pylist()) < 15
    again = retrack(files[1], tracker=CameraDetector().tracker()).to_pylist()
    places = [[(row.pop("x"), row.pop("y")) for row in one] for one in (again, [dict(row) for row in rows])]
    assert np.allclose(*places, rtol=0, atol=1e-9)
    assert again == [{name: row[name] for name in row if name not in ("x", "y")} for row in rows]
    # Older tables say which spots are weak, or not even that: then all count.
    bare = detections.drop_columns(["evidence", *MOTION])
    counts = detections["evidence"].to_pylist()
    weak = bare.append_column("weak", pa.array([None if one is None else one < 1 for one in counts]))
    seen_in = []
    for table in (weak, bare):
        write_table(table, files[2])
        write_csv(table, files[2].with_suffix(".csv"))
        old, other = (
            retrack(one, tracker=CameraDetector().tracker()) for one in (files[2], files[2].with_suffix(".csv"))
        )
        assert [row["track"] for row in old.to_pylist()] == [row["track"] for row in other.to_pylist()]
        seen_in.append(sum(row["seen"] for row in old.to_pylist()))
    assert 0 < seen_in[0] <= seen_in[1]


def test_a_dark_frame_that_does_not_suit_is_said_and_left() -> None:
    detector = CameraDetector()
    dark, other = shot(room(1), False, (0, 0), 0), shot(room(2), False, (0, 0), 0)
    lit = shot(room(1), True, (0, 0), 1)
    for image, time in ((dark[:-2], 0.0), (dark.astype(np.uint16) * 257, 0.1), (other, 0.2)):
        detector(Frame(0, time, image, lit=False))
        detector(Frame(1, time + 0.03, lit, lit=True))
    detector(Frame(2, 0.3, dark, lit=False))
    detector(Frame(3, 1.3, lit, lit=True))
    assert detector.notes == {
        "the dark frame has another size or type": 2,
        "the dark frame cannot be registered": 1,
        "the latest dark frame is more than 0.5 s old": 1,
    }


@pytest.mark.parametrize("level", [0, 255])
def test_black_and_white_frames_hold_nothing(level: int) -> None:
    flat = np.full((300, 400), level, np.uint8)
    frames = [Frame(n, n / 30, flat, lit=n % 2 == 1) for n in range(4)]
    assert [len(one.detections) for one in track(frames, detector="cameras")] == [0] * 4


def test_frames_too_large_to_search_are_refused() -> None:
    huge = np.broadcast_to(np.uint8(0), (20_000, 20_000))
    with pytest.raises(InputError, match="more than can be searched at once"):
        CameraDetector()(Frame(0, 0.0, huge))


def test_a_wall_patch_is_no_camera() -> None:
    picture = np.full((900, 1200), 30.0, np.float32)
    picture[200:700, 300:800] = 150
    lit, dark = picture.copy(), np.full_like(picture, 30.0)
    lit[100:103, 1000:1003] += 120
    film = [Frame(n, n / 30, shot(lit if n % 2 else dark, False, (0, 0), n), lit=n % 2 == 1) for n in range(12)]
    seen = [row for one in track(film, detector="cameras") for row in one.rows if row.seen]
    assert len(seen) == 4 and {row.track for row in seen} == {1}
    for row in seen:
        assert (row.x, row.y) == pytest.approx((1001, 101), abs=0.5)


def ghosted(x: float, y: float, height: float = 150.0, more: tuple = ()) -> list[tuple[float, float, float]]:
    return [(x, y, height), (x + 40, y - 25, 0.12 * height), *more]


def bench_frames(cameras_of, count: int = 12) -> list[Frame]:
    ground = np.full((300, 400), 8.0, np.float32)
    return [Frame(n, n / 30, shot(ground, True, (0, 0), n, cameras_of(n))) for n in range(count)]


def test_a_ghost_is_dropped_by_offset_and_ratio_and_a_second_camera_kept(tmp_path: Path) -> None:
    alone = bench_frames(lambda n: ghosted(60 + 20 * n, 100 + 8 * n))
    ghost = calibrate_ghost(detect(f.image, ghost_ratio=0, stray=0) for f in alone)
    assert (ghost.dx, ghost.dy) == pytest.approx((40, -25), abs=0.5) and ghost.ratio == pytest.approx(0.12, rel=0.15)
    ghost.save(tmp_path / "g.json")
    assert Ghost.load(tmp_path / "g.json") == ghost
    # A camera an eighth as bright, 60 px from the bright one: what the bench's own rule takes for its ghost.
    (both,) = bench_frames(lambda n: ghosted(150, 150, more=((200.0, 180.0, 18.0),)), 1)
    assert detect(both.image).x == pytest.approx([150], abs=1)
    assert sorted(detect(both.image, known_ghost=ghost).x) == pytest.approx([150, 200], abs=1)
    for ghosts in ("drop", "mark"):
        found = CameraDetector(false_alarms=1e9, min_snr=8.0, known_ghost=ghost, ghosts=ghosts)(both)
        kept = sorted(found.without_ghosts.x)
        assert [any(abs(x - at) < 1 for x in kept) for at in (150, 200, 190)] == [True, True, False]
        assert found.ghost.any() == (ghosts == "mark")


def test_what_is_no_ghost_is_not_calibrated() -> None:
    rng = np.random.default_rng(0)
    wandering = bench_frames(lambda n: [(200, 150, 150), (*rng.uniform(50, 250, 2), 20)])
    with pytest.raises(InputError, match=r"no ghost was found: the best offset holds in \d of 12 frames"):
        calibrate_ghost(detect(f.image, ghost_ratio=0, stray=0) for f in wandering)
    with pytest.raises(InputError, match="holds in 0 of 0 frames"):
        calibrate_ghost([Detections.empty()] * 5)


@pytest.mark.parametrize("text", ["", "[]", '{"format": "tapetum-ghost", "version": 1}', '{"format": "other"}'])
def test_a_damaged_ghost_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "g.json").write_text(text)
    with pytest.raises(InputError, match="is no calibrated ghost"):
        Ghost.load(tmp_path / "g.json")
    with pytest.raises(InputError, match="no such file"):
        Ghost.load(tmp_path / "none.json")


def test_the_command_calibrates_and_drops(tmp_path: Path, capsys) -> None:
    for name, cameras_of in (
        ("alone", lambda n: ghosted(60 + 20 * n, 100 + 8 * n)),
        ("two", lambda n: ghosted(150 + n, 150, more=((200.0 + n, 180.0, 18.0),))),
    ):
        (tmp_path / name).mkdir()
        for frame in bench_frames(cameras_of):
            cv2.imwrite(str(tmp_path / name / f"{frame.index:03}.png"), frame.image)
    ghost = tmp_path / "ghost.json"
    assert main(["track", str(tmp_path / "alone"), "--calibrate-ghost", "-o", str(ghost)]) == 0
    assert "the ghost stands +39.9, -25.1 px" in capsys.readouterr().out
    assert json.loads(ghost.read_text())["format"] == "tapetum-ghost"
    two = str(tmp_path / "two")
    assert main(["track", two, "-o", str(tmp_path / "a.csv")]) == 0
    assert main(["track", two, "--ghost", str(ghost), "-o", str(tmp_path / "b.csv")]) == 0
    tracks = [len(set(read_tracks(tmp_path / name)["track"].to_pylist())) for name in ("a.csv", "b.csv")]
    assert tracks == [1, 2]
    assert main(["track", two, "--calibrate-ghost", "-o", str(tmp_path / "c.csv")]) == 2
    assert "name it NAME.json" in capsys.readouterr().err


def test_the_command_finds_cameras_of_a_room(tmp_path: Path, capsys) -> None:
    frames, _ = modulated(16, True)
    path = tmp_path / "room.rec"
    with RecordingWriter(path, streams={"probe": StreamInfo(300, 400)}, rate=30.0, start_utc_ns=10**18) as writer:
        for frame in frames:
            at = round(frame.time * 1e9)
            writer.write("probe", frame.image, monotonic_ns=at, utc_ns=10**18 + at, lit=frame.lit)
    out = tmp_path / "t.csv"
    arguments = ["track", str(tmp_path / "room.rec"), "--detector", "cameras", "--false-alarms-per-frame", "0.02"]
    assert main([*arguments, "-o", str(out)]) == 0
    told = capsys.readouterr()
    assert "3 tracks in 16 frames" in told.out
    assert "note: 1 lit frame searched alone, which finds less: no dark frame came before" in told.err
    assert main(["track", str(tmp_path / "room.rec"), "--false-alarms-per-frame", "1", "-o", str(out)]) == 2
    assert "--false-alarms-per-frame: is of the detector of cameras" in capsys.readouterr().err
    assert main(["track", str(tmp_path / "room.rec"), "--detector", "dogs", "-o", str(out)]) == 2


def test_every_readable_frame_of_a_truncated_video_is_used_and_that_is_said(tmp_path: Path, capsys) -> None:
    video, cut = tmp_path / "whole.mkv", tmp_path / "cut.mkv"
    with av.open(str(video), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = 400, 300, "gray"
        for frame in bench_frames(lambda n: [(100 + 5 * n, 120, 150)], 30):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame.image, format="gray")))
        container.mux(stream.encode())
    data = video.read_bytes()
    cut.write_bytes(data[: len(data) // 2])
    assert main(["track", str(cut), "-o", str(tmp_path / "t.csv")]) == 2
    told = capsys.readouterr().err.splitlines()[-1]
    count = int(re.findall(r"(\d+) frames could be read", told)[0])
    assert 8 <= count < 30 and f"{count} rows are kept in {tmp_path / 't.unfinished.csv'}" in told
    assert read_tracks(tmp_path / "t.unfinished.csv")["frame"].to_pylist() == list(range(count))


@pytest.mark.parametrize("asked", [0.001, 0.01, 0.1, 2.0])
def test_a_spot_counts_the_less_the_likelier_chance_makes_one(asked: float) -> None:
    full = max(asked, min(10 * asked, 0.5))

    def counts(cost: float, snr: float) -> float:
        one = np.full(1, 10.0)
        found = Found(one, one, one / 20, np.full(1, cost), np.full(1, snr), one, one, one, one, one > 99)
        return float(CameraDetector(false_alarms=asked)._evidence(found)[0])

    assert counts(full, 5.0) == counts(0.0, 40.0) == 1
    assert counts(full * math.sqrt(30), 5.0) == pytest.approx(0.5)
    assert counts(full * math.sqrt(30), 12.0) == pytest.approx(0.25)
    assert counts(full * 31, 5.0) == counts(full * 1.01, 16.0) == 0


def test_the_tracker_of_rooms_adds_up_what_counts_little() -> None:
    tracker, lengths = CameraDetector().tracker(), []
    for n in range(8):
        columns = dict.fromkeys(Detections.names(), np.full(1, 50.0)) | {"ghost": np.zeros(1), "evidence": [0.5]}
        lengths.append(len(tracker.update(Detections.of(columns), n / 15)))
    assert lengths == [0, 0, 0, 0, 1, 1, 1, 1]


def test_dark_frames_tell_how_the_picture_moved_as_well() -> None:
    frames, shifts = modulated(6, False)
    detector = CameraDetector()
    motions = [detector(one).motion for one in frames]
    assert motions[0] is None
    for n, motion in enumerate(motions[1:], 1):
        assert motion is not None and np.abs(motion[:, 2] - (shifts[n] - shifts[n - 1])).max() < 0.6
