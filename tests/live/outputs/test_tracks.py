"""Tables of tracks of a watch: whole at the end, readable after a kill, and never in place of another."""

from __future__ import annotations

import errno
import shutil
from dataclasses import replace

import pytest
from live_messages import CAMERA, PLAIN, make_event, make_state, until

from tapetum.errors import InputError
from tapetum.live.outputs import open_output
from tapetum.track.tables import TableWriter, read_tracks


@pytest.mark.parametrize("suffix", [".parquet", ".csv", ".jsonl"])
def test_each_frame_is_a_row_for_each_camera(tmp_path, suffix):
    path = tmp_path / f"watch{suffix}"
    output = open_output(str(path))
    output.event(make_event())
    output.state(make_state(0, CAMERA, PLAIN))
    # In a dark frame the camera is followed, and what the lit one told is not repeated as if it were new.
    output.state(replace(make_state(1, CAMERA), cameras=(CAMERA,)))
    output.state(replace(make_state(1, CAMERA), cameras=(CAMERA,)))
    assert not path.exists()
    output.close()
    assert [one.name for one in tmp_path.iterdir()] == [path.name] and output.counts.failed == 0
    rows = read_tracks(path).to_pylist()
    assert [(row["frame"], row["track"], row["time"]) for row in rows] == [(0, 3, 0.0), (0, 4, 0.0), (1, 3, 0.1)]
    assert rows[0]["id"] == "a1b2" and rows[0]["utc_ns"] == CAMERA.seen_utc_ns and rows[0]["device"] == "phone-03"
    assert (rows[0]["gaze_x"], rows[0]["gaze_y_low"]) == (0.25, -0.625) and rows[1]["gaze_x"] is None
    assert rows[2]["x"] == 320.5 and rows[2]["gaze_x"] is None and rows[2]["snr"] is None


def test_rows_are_in_the_file_while_nothing_more_comes_so_that_a_kill_leaves_them(tmp_path):
    output = open_output(str(tmp_path / "watch.parquet"))
    for number in range(5):
        output.state(make_state(number, CAMERA))
    until(lambda: output.counts.sent == 5 and not output._writer._pending)
    # What a process that is killed here leaves behind.
    shutil.copy(tmp_path / "watch.unfinished.arrow", tmp_path / "left.unfinished.arrow")
    assert not (tmp_path / "watch.parquet").exists()
    output.close()
    assert read_tracks(tmp_path / "left.unfinished.arrow").num_rows == 5
    assert read_tracks(tmp_path / "watch.parquet").num_rows == 5


def test_a_full_disk_is_told_and_keeps_the_rows_before(tmp_path, monkeypatch):
    path = tmp_path / "watch.csv"
    output = open_output(str(path))
    output.state(make_state(0, CAMERA))
    until(lambda: output.counts.sent == 1 and not output._writer._pending)

    def full(self, row):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(TableWriter, "write", full)
    output.state(make_state(1, CAMERA))
    output.state(make_state(2, CAMERA))
    until(lambda: output.counts.failed == 2)
    kept = tmp_path / "watch.unfinished.csv"
    assert f"1 rows are kept in {kept}" in output.counts.fault
    output.close()
    assert not path.exists() and read_tracks(kept).num_rows == 1


def test_a_table_that_is_there_or_cannot_be_written_is_refused(tmp_path):
    there = tmp_path / "there.parquet"
    there.write_text("precious")
    with pytest.raises(InputError, match="exists already; name another file"):
        open_output(str(there))
    assert there.read_text() == "precious"
    with pytest.raises(InputError, match="no folder"):
        open_output(str(tmp_path / "none" / "watch.parquet"))
    output = open_output(str(tmp_path / "twice.csv"))
    with pytest.raises(InputError, match="is named twice"):
        open_output(str(tmp_path / "twice.csv"))
    output.close()
