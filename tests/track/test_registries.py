"""A detector or a kind of table of one's own is one class and one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from tapetum.errors import InputError
from tapetum.record.source import Frame
from tapetum.track import Detections, Tracker, detect, read_tracks, track, track_to_file
from tapetum.track.detector import DETECTORS, SpotDetector
from tapetum.track.formats import FORMATS, Format
from tapetum.track.pipeline import make_detector


def frames(count: int) -> list[Frame]:
    images = np.zeros((count, 48, 64), np.uint8)
    images[:, 20:25, 30:35] = 200
    # Where the laser is off the camera's answer is missing.
    return [Frame(n, n / 10, image, lit=n % 2 == 0) for n, image in enumerate(images)]


class LitOnly:
    """Looks at lit frames alone, and remembers what it was shown: what a detector of pairs would need."""

    def __init__(self) -> None:
        self.shown: list[int] = []

    def __call__(self, frame: Frame, /) -> Detections:
        self.shown.append(frame.index)
        return detect(frame.image) if frame.lit else Detections.empty()


def test_a_detector_sees_every_frame_in_order_with_all_that_is_known_of_it(monkeypatch) -> None:
    own = LitOnly()
    found = [len(one.detections) for one in track(frames(6), detector=own)]
    assert own.shown == list(range(6)) and found == [1, 0] * 3
    monkeypatch.setitem(DETECTORS, "lit", lambda **options: LitOnly())
    assert [len(one.detections) for one in track(frames(4), detector="lit")] == [1, 0, 1, 0]


class Patient(LitOnly):
    """Wants a track to be seen three times before it counts."""

    usual_largest = 9.0

    def __init__(self, largest: float = 0.0) -> None:
        super().__init__()
        self.largest = largest

    def tracker(self) -> Tracker:
        return Tracker(persist=(3, 5))


def test_a_detector_brings_the_tracker_and_the_size_that_suit_it(monkeypatch) -> None:
    lit = [Frame(n, n / 10, frames(1)[0].image, lit=True) for n in range(4)]
    assert [len(one.rows) for one in track(lit, detector=Patient())] == [0, 0, 1, 1]
    assert [len(one.rows) for one in track(lit, detector=LitOnly())] == [1] * 4
    monkeypatch.setitem(DETECTORS, "patient", Patient)
    made = make_detector("patient")
    assert isinstance(made, Patient) and made.largest == 9.0
    assert [len(one.rows) for one in track(lit, detector="patient")] == [0, 0, 1, 1]


def test_the_one_of_single_frames_is_detect_with_its_options(tmp_path: Path) -> None:
    frame = frames(1)[0]
    assert SpotDetector(min_snr=7.0)(frame).to_table().equals(detect(frame.image, min_snr=7.0).to_table())
    with pytest.raises(InputError, match=r"detect_options: unknown option colour; use full_scale, ghost_radius"):
        SpotDetector(colour="red")
    with pytest.raises(InputError, match="use one of spots"):
        track(frames(1), detector="sports")
    with pytest.raises(InputError, match="give the detector its options where it is made"):
        track(frames(1), detector=LitOnly(), detect_options={"min_snr": 7.0})
    # A detector of one's own decides about ghosts itself, and its detections can be kept.
    summary = track_to_file(frames(4), tmp_path / "t.csv", detector=LitOnly(), detections=tmp_path / "d.csv")
    assert (summary.frames, summary.seen) == (4, 2)


def test_a_table_of_ones_own_kind(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(FORMATS, ".stream", Format(pa.ipc.new_stream, FORMATS[".arrow"].read))
    track_to_file(frames(4), tmp_path / "t.stream")
    assert read_tracks(tmp_path / "t.stream").num_rows == 4
    with pytest.raises(InputError, match=r"unknown kind of table '.xls'; use one of .parquet, .csv, .jsonl"):
        track_to_file(frames(1), tmp_path / "t.xls")
