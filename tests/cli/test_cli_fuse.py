"""`tapetum fuse`, and `tapetum track --smooth`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tapetum.track import read_tracks, track_schema, write_tracks

GEOMETRY = ("--place", "0.1,0.05", "--distance", 5.5, "--field", "3.3,2.4")


def tracks(path: Path, shift: tuple[float, float] = (0.0, 0.0), *, later: float = 0.0, ends: bool = True) -> Path:
    """Write the tracks of one probe: a gaze that sweeps, with some noise and two of the wrong sign."""
    rng = np.random.default_rng(int(10 * shift[0]) + 3)
    rows = []
    for n in range(45):
        time = n / 15
        row = {"frame": n, "time": time + later, "track": 1, "x": 10.0, "y": 20.0, "snr": 9.0, "seen": True}
        for k, name in enumerate(("gaze_x", "gaze_y")):
            value = 0.3 * np.sin(time + 1 + k) + shift[k] + rng.normal(0, 0.01)
            value = -value if n in (20, 30) else value
            row |= {name: value} | ({f"{name}_low": value - 0.0165, f"{name}_high": value + 0.0165} if ends else {})
        rows.append({name: row.get(name) for name in track_schema().names})
    write_tracks(pa.Table.from_pylist(rows, schema=track_schema()), path)
    return path


@pytest.fixture
def pair(tmp_path: Path) -> list[Path]:
    """Two probes whose gazes differ by (0.3, 0.2)."""
    return [tracks(tmp_path / "a.parquet"), tracks(tmp_path / "b.csv", (0.3, 0.2))]


def error(path: Path) -> float:
    table = read_tracks(path)
    time, gaze = table["time"].to_numpy(), table["gaze_x"].to_numpy()
    return float(np.sqrt(np.mean((gaze - 0.3 * np.sin(time + 1)) ** 2)))


def test_two_tables_become_one(run, pair: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "fused.jsonl"
    ran = run("fuse", *pair, "-o", out, "--offset", "-0.3,-0.2", "--json")
    assert ran.code == 0, ran.err
    told = json.loads(ran.out)
    assert told["rows"] == 45 and told["used"] == [45, 45] and told["disagree"] == 2
    assert error(out) > 0.04
    smooth = tmp_path / "smooth.csv"
    ran = run("fuse", *pair, "-o", smooth, "--offset", "-0.3,-0.2", "--smooth", "whole")
    assert ran.code == 0 and "45 rows (a.parquet in 45, b.csv in 45); contradictions: 0 settled, 0 open" in ran.out
    assert error(smooth) < 0.01


def test_the_place_of_probes_and_of_their_clocks(run, tmp_path: Path) -> None:
    # 0.1 m at 5.5 m are 0.3156 of a field of 3.3 degrees, 0.05 m are 0.217 of one of 2.4.
    first = tracks(tmp_path / "a.parquet")
    second = tracks(tmp_path / "b.parquet", (0.3156, 0.2170), later=-7.0)
    out = tmp_path / "fused.parquet"
    ran = run("fuse", first, second, "-o", out, *GEOMETRY, "--start", 7, "--smooth", "live", "--roll-spread", 1)
    assert ran.code == 0 and error(out) < 0.03
    assert read_tracks(out)["probes"].to_pylist().count(2.0) >= 44


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        ([], "not known where the probes stand; give --place, --distance and --field, or --offset"),
        (["--place", "0.1,0"], "not known where"),
        (["--offset", "0.1"], "--offset: '0.1' is not two numbers"),
        (["--offset", "0,0", "--offset", "1,1"], "--offset: 2 for 1 further probes"),
        (["--offset", "0,0", "--distance", "5"], "--offset: takes the place of --place"),
        (["--offset", "0,0", "--start", "9"], "times do not overlap"),
        (["--offset", "0,0", "--start", "1", "--start", "2"], "--start: 2 for 1"),
        (["--offset", "0,0", "--smooth", "well"], "--smooth: unknown value 'well'; use one of live, whole"),
        (["--offset", "0,0", "--track", "4", "--track", "1"], "a.parquet: no track 4; it has 1"),
        (["--offset", "0,0", "--correlation", "2"], "--correlation"),
        (["--place", "0,0", "--distance", "5", "--field", "200,20"], "--field: must lie between 0 and 180 degrees"),
        (["--place", "0,0", "--distance", "0", "--field", "3,2"], "--distance: must be positive, is 0 m"),
        (["--place", "nan,0", "--distance", "5", "--field", "3,2"], "--place: 'nan,0' is not two finite numbers"),
        (["--offset", "0,0", "--start", "nan"], "--start: must be finite, is nan"),
        (["--offset", "0,0", "--roll-spread", "2"], "--roll-spread: needs --place"),
        (["--offset", "0,0", "--systematic", "0.5"], "--systematic: is of smoothing"),
    ],
)
def test_bad_input_is_one_line(run, pair: list[Path], tmp_path: Path, extra: list[str], words: str) -> None:
    out = tmp_path / "out.csv"
    ran = run("fuse", *pair, "-o", out, *extra)
    assert ran.code == 2 and words in ran.complaint
    assert not out.exists()


def test_tables_that_cannot_be_fused(run, pair: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out.csv"
    assert "a single probe cannot be fused" in run("fuse", pair[0], "-o", out).complaint
    assert "is given twice" in run("fuse", pair[0], pair[0], "-o", out, "--offset", "0,0").complaint
    assert "one of the tables" in run("fuse", *pair, "-o", pair[0], "--offset", "0,0").complaint
    assert "unknown kind of table" in run("fuse", *pair, "-o", tmp_path / "out.xls", "--offset", "0,0").complaint
    assert "no such file" in run("fuse", pair[0], tmp_path / "none.csv", "-o", out, "--offset", "0,0").complaint
    bare = tracks(tmp_path / "bare.csv", ends=False)
    ran = run("fuse", pair[0], bare, "-o", out, "--offset", "0,0")
    assert ran.code == 2 and "bare.csv: holds no estimates with intervals" in ran.complaint
    assert not out.exists()


def test_track_smooths(run, chain, tmp_path: Path) -> None:
    raw, out, kept = tmp_path / "raw.csv", tmp_path / "t.csv", tmp_path / "d.parquet"
    given = ("track", chain.recording, "--model", chain.model)
    assert run(*given, "-o", raw, "--detections", kept).code == 0
    refused = run(*given, "-o", out, "--smooth", "slowly")
    assert refused.code == 2 and "use one of live, whole" in refused.complaint
    assert "nothing to smooth" in run("track", chain.recording, "-o", out, "--smooth", "live").complaint
    assert not out.exists()
    # Detections that were kept with the models' estimates, given intervals.
    found = pq.read_table(kept)
    for end, wide in (("_low", -0.02), ("_high", 0.02)):
        for name in ("gaze_x", "gaze_y"):
            values = pa.array(found[name].to_numpy() + wide)
            found = found.set_column(found.column_names.index(name + end), name + end, values)
    pq.write_table(found, kept)
    assert run("track", kept, "-o", raw, "--overwrite").code == 0
    again = run("track", kept, "-o", out, "--smooth", "whole", "--systematic", "0.5")
    assert again.code == 0, again.err
    before, after = read_tracks(raw), read_tracks(out)
    assert not after["gaze_x"].equals(before["gaze_x"]) and after["x"].equals(before["x"])
    half = (after["gaze_x_high"].to_numpy() - after["gaze_x_low"].to_numpy()) / 2
    assert (half >= 0.0099).all() and half.min() < 0.02
