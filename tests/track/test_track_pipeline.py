"""From frames to tables of tracks and back."""

from __future__ import annotations

import json
import math

import numpy as np
import pyarrow as pa
import pytest
from probe_frames import probe_frame

from tapetum.errors import InputError
from tapetum.models import Prediction
from tapetum.record.source import Frame
from tapetum.track import Tracker, read_tracks, retrack, track, track_schema, track_to_file, write_tracks
from tapetum.track.tables import detections_schema, read_table

COUNT = 12


class Brightness:
    """A stand-in for a fitted model: reads the crop's middle, knows no interval for one of its quantities."""

    target_names = ("gaze_x", "depth")

    def __init__(self) -> None:
        self.asked: list[tuple[tuple[int, ...], float | None]] = []

    def predict(self, crops, *, full_scale=None, progress=None):
        self.asked.append((crops.shape, full_scale))
        side = crops.shape[1]
        middle = crops[:, side // 2 - 3 : side // 2 + 4, side // 2 - 3 : side // 2 + 4].mean(axis=(1, 2)) / full_scale
        value = np.stack([middle, np.full(len(crops), 2.0)], axis=1)
        width = np.array([0.1, np.inf])
        return Prediction(self.target_names, value, value - width, value + width)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    rng = np.random.default_rng(0)
    made = []
    for n in range(COUNT):
        spots = [] if n in (5, 6) else [(150 + 6 * n, 200, 40, 120), (205 + 6 * n, 220, 40, 12)]
        made.append(Frame(n, n / 15, probe_frame(rng, spots), f"probe[{n}]"))
    return made


def test_models_see_each_spot_centred_and_in_batches(frames):
    model = Brightness()
    results = list(track(frames, model=model, batch=5, side=120))
    assert [one.frame for one in results] == list(range(COUNT))
    assert [len(one.rows) for one in results] == [1] * COUNT
    assert sum(shape[0] for shape, _ in model.asked) == COUNT - 2
    assert len(model.asked) == 3
    for one in results:
        (row,) = one.rows
        if row.seen:
            assert row.estimates["gaze_x"] > 0.3  # the bright middle
            assert row.estimates["gaze_x_low"] == pytest.approx(row.estimates["gaze_x"] - 0.1)
        else:
            assert row.estimates == {} and row.snr is None


def test_the_size_of_a_batch_changes_nothing(frames):
    one, many = (list(track(frames, model=Brightness(), batch=batch)) for batch in (1, 16))
    assert [a.rows for a in one] == [b.rows for b in many]


def test_eight_and_sixteen_bit_frames_do_not_mix_in_a_batch(frames):
    mixed = [
        Frame(
            f.index,
            f.time,
            f.image if n % 2 else f.image.astype(np.uint16) * 16,
            f.name,
            255 if n % 2 else 4080,
        )
        for n, f in enumerate(frames[:4])
    ]
    model = Brightness()
    values = [row.estimates["gaze_x"] for one in track(mixed, model=model) for row in one.rows]
    assert {full_scale for _, full_scale in model.asked} == {255.0, 4080.0}
    # The same spot, whatever the numbers that say it.
    assert np.ptp(values) < 0.05


@pytest.mark.parametrize("suffix", [".parquet", ".csv", ".jsonl"])
def test_tables_go_out_and_come_back_and_are_tracked_again(frames, tmp_path, suffix):
    out, kept = tmp_path / f"tracks{suffix}", tmp_path / f"detections{suffix}"
    summary = track_to_file(frames, out, model=[Brightness()], detections=kept)
    assert (summary.frames, summary.tracks, summary.rows, summary.seen) == (COUNT, 1, COUNT, COUNT - 2)
    table = read_tracks(out)
    assert table.schema.names[: len(track_schema())] == track_schema().names
    assert table.column_names[-5:] == ["depth", "depth_low", "depth_high", "applies", "reason"]
    rows = table.to_pylist()
    assert [row["frame"] for row in rows] == list(range(COUNT))
    assert rows[0]["gaze_x_high"] - rows[0]["gaze_x"] == pytest.approx(0.1)
    assert rows[0]["depth"] == 2.0 and rows[0]["depth_high"] is None  # an interval without an end
    assert rows[5]["gaze_x"] is None and rows[5]["snr"] is None and not rows[5]["seen"]
    assert all(row["active"] is None and row["device"] is None and row["gaze_y"] is None for row in rows)
    assert rows[3]["name"] == "probe[3]"

    again = retrack(kept)
    assert again.schema.names == table.schema.names
    assert again.to_pylist() == rows
    impatient = retrack(kept, tracker=Tracker(confirm=100))
    assert len(impatient) == COUNT - 2 and set(impatient["track"].to_pylist()) == {1, 2}

    copy = tmp_path / f"copy{suffix}"
    write_tracks(table, copy)
    assert read_tracks(copy).equals(table)
    if suffix == ".jsonl":
        assert json.loads(out.read_text().splitlines()[0])["track"] == 1


def test_a_wall_is_no_retro_reflection_and_hides_none():
    at = np.arange(600)
    wall = np.outer((at > 60) & (at < 560), (at > 20) & (at < 400)) * 200
    image = np.clip(wall + np.random.default_rng(0).normal(8, 1, (600, 600)), 0, 255).astype(np.uint8)
    image[300:306, 480:486] = 45  # a fifth of the wall: its ghost, were the wall a retro-reflection
    both = list(track([Frame(0, 0.0, image)], detect_options={"largest": None}))
    assert [round(x) for x in both[0].detections.x] == [210]
    alone = list(track([Frame(0, 0.0, image)]))
    assert alone[0].detections.x == pytest.approx([482.5], abs=1)
    with pytest.raises(InputError, match="largest: must be positive"):
        list(track([Frame(0, 0.0, image)], detect_options={"largest": 0}))


class Doubtful(Brightness):
    """A stand-in that applies to no frame."""

    def predict(self, crops, *, full_scale=None, progress=None):
        found = super().predict(crops, full_scale=full_scale)
        return found.because(["unlike"] * len(found), described=True).withheld()


@pytest.mark.parametrize("suffix", [".parquet", ".csv", ".jsonl"])
def test_what_a_model_refuses_stands_empty_with_the_reason(frames, tmp_path, suffix):
    out, kept = tmp_path / f"tracks{suffix}", tmp_path / f"found{suffix}"
    track_to_file(frames, out, model=[Doubtful(), Namer()], detections=kept, side=120)
    for table in (read_tracks(out), retrack(kept)):
        rows = [row for row in table.to_pylist() if row["seen"]]
        assert {row["gaze_x"] for row in rows} == {None}
        assert {row["device"] for row in rows} == {"phone-b"}
        assert {row["applies"] for row in rows} == {False}
        assert {row["reason"] for row in rows} == {"gaze_x, depth: unlike"}


class Namer:
    """A stand-in for a model of devices: the second half of the frames it has never seen the like of."""

    target_names = ("device",)

    def predict(self, crops, *, full_scale=None, progress=None):
        del full_scale, progress
        none = np.empty((len(crops), 0))
        shares = np.tile([0.25, 0.75], (len(crops), 1))
        novelty = np.where(crops.reshape(len(crops), -1).max(axis=1) > 0, 0.5, 2.0)
        return Prediction((), none, none, none, ("phone-a", "phone-b"), shares, novelty)


@pytest.mark.parametrize("suffix", [".parquet", ".csv", ".jsonl"])
def test_devices_stand_in_the_table_and_come_back(frames, tmp_path, suffix):
    out, kept = tmp_path / f"tracks{suffix}", tmp_path / f"found{suffix}"
    track_to_file(frames, out, model=[Brightness(), Namer()], detections=kept, side=120)
    for table in (read_tracks(out), retrack(kept)):
        rows = [row for row in table.to_pylist() if row["seen"]]
        assert {row["device"] for row in rows} == {"phone-b"}
        assert {row["device_probability"] for row in rows} == {0.75}
        assert rows[0]["gaze_x"] is not None
        assert all(row["device"] is None for row in table.to_pylist() if not row["seen"])


def test_frames_without_a_spot_give_an_empty_table(tmp_path):
    rng = np.random.default_rng(1)
    for suffix in (".parquet", ".csv", ".jsonl"):
        out, kept = tmp_path / f"none{suffix}", tmp_path / f"kept{suffix}"
        empty = [Frame(n, n / 15, probe_frame(rng)) for n in range(2)]
        summary = track_to_file(empty, out, detections=kept)
        assert (summary.frames, summary.rows) == (2, 0)
        assert len(read_tracks(out)) == 0
        assert len(retrack(kept)) == 0


def test_the_rows_of_a_run_that_failed_are_kept(frames, tmp_path):
    def breaking():
        yield from frames[:3]
        raise InputError("the video ends", where="probe.mkv")

    with pytest.raises(InputError, match=r"probe\.mkv"):
        track_to_file(breaking(), tmp_path / "tracks.parquet", detections=tmp_path / "kept.csv")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kept.unfinished.csv", "tracks.unfinished.parquet"]
    assert set(read_tracks(tmp_path / "tracks.unfinished.parquet")["frame"].to_pylist()) == {0, 1, 2}


def test_bad_input_is_told_before_anything_is_done(frames, tmp_path):
    with pytest.raises(InputError, match=r"\.xlsx"):
        track_to_file(frames, tmp_path / "tracks.xlsx")
    with pytest.raises(InputError, match="min_size"):
        track(frames, detect_options={"min_size": 3})
    with pytest.raises(InputError, match="two models estimate depth, gaze_x"):
        track(frames, model=[Brightness(), Brightness()])
    with pytest.raises(InputError, match="batch"):
        track(frames, batch=0)
    for side in (1.5, 0, True):
        with pytest.raises(InputError, match=f"side: must be a whole number from 1 to 1000000, is {side}"):
            track(frames, side=side)
    with pytest.raises(InputError, match="nowhere"):
        track(tmp_path / "nowhere")
    for seconds in (math.nan, -1.0, 0.0):
        with pytest.raises(InputError, match="seconds: must be positive"):
            track_to_file(frames, tmp_path / "t.csv", seconds=seconds)
    with pytest.raises(InputError, match="is the table of tracks too"):
        track_to_file(frames, tmp_path / "t.csv", detections=tmp_path / "t.csv")
    with pytest.raises(InputError):
        track(frames, model=tmp_path / "no-model")
    with pytest.raises(InputError, match="no column time, track"):
        write_tracks(pa.table({"frame": [1]}), tmp_path / "t.csv")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".parquet", ".csv", ".jsonl"])
def test_tables_that_are_none_are_refused(tmp_path, suffix):
    path = tmp_path / f"t{suffix}"
    with pytest.raises(InputError, match="no such file"):
        read_tracks(path)
    path.write_bytes(b"\x00\x01 this is, no table\n{")
    with pytest.raises(InputError):
        read_tracks(path)
    with pytest.raises(InputError):
        retrack(path)
    with pytest.raises(InputError, match="no column"):
        retrack(pa.table({"frame": [1]}))


def test_detections_without_a_time_are_refused(frames, tmp_path):
    track_to_file(frames, tmp_path / "t.csv", detections=tmp_path / "d.parquet")
    kept = read_table(tmp_path / "d.parquet", detections_schema())
    times = [None, *kept["time"].to_pylist()[1:]]
    with pytest.raises(InputError, match="time: frame 0 has none"):
        retrack(kept.set_column(kept.column_names.index("time"), "time", pa.array(times, pa.float64())))


def test_rows_hold_no_nan(frames):
    for one in track(frames, model=Brightness()):
        for row in one.rows:
            values = [v for v in row.record().values() if isinstance(v, float)]
            assert not any(math.isnan(v) for v in values)


def test_tracks_of_kept_detections_know_the_picture_too(tmp_path) -> None:
    """A spot moves out at the right: the place that is foretold of it stays in the frame."""
    frames = []
    for n in range(14):
        image = np.full((120, 160), 6, np.uint8)
        image[56:64, max(0, 72 + 10 * n) : 80 + 10 * n] = 200
        frames.append(Frame(n, n / 30, image, f"made[{n}]"))
    out, kept = tmp_path / "tracks.csv", tmp_path / "spots.csv"
    track_to_file(frames, out, detections=kept)
    rows = read_tracks(out).to_pylist()
    assert max(row["x"] for row in rows) == 159 and "out of the picture" in {row["event"] for row in rows}
    assert retrack(kept).to_pylist() == rows
