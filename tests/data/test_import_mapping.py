"""Mapping files: what they may say, and how what they may not is reported."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tapetum.data.importing import load_mapping
from tapetum.data.importing.mapping import mapping_from_text
from tapetum.errors import InputError

GOOD = """\
schema: tapetum/import/1
side: 32
stacks:
  - images: {file: a.h5, array: images, axes: frame y x}
    labels:
      gaze_x: {file: l.csv, column: x, unit: px, size: 640}
      gaze_y: {file: l.csv, column: 0}
      object_distance: 3 m
"""
VIDEOS = """\
schema: tapetum/import/1
videos:
  - {probe: p.mkv, target: t.mkv, align: blink, offset: 20 ms, labels: {device: phone-01}}
"""


def loaded(folder: Path, text: str):
    (folder / "map.yaml").write_text(text)
    return load_mapping(folder / "map.yaml")


def test_a_mapping_is_read_with_its_shorthands(tmp_path: Path):
    mapping = loaded(tmp_path, GOOD)
    labels = mapping.stacks[0].labels
    assert labels.given()["object_distance"].value == "3 m"
    assert labels.given()["gaze_y"].column == 0
    assert mapping.stacks[0].images.axes == ("frame", "y", "x")
    assert mapping.test_fraction == 0.2
    assert loaded(tmp_path, VIDEOS).videos[0].offset == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("gaze_x:", "gase_x:", "stacks.0.labels.gase_x: unknown key; did you mean stacks.labels.gaze_x?"),
        ("column: x", "colum: x", "stacks.0.labels.gaze_x.colum: unknown key"),
        ("side: 32", "sides: 32", "sides: unknown key; did you mean side?"),
        ("axes: frame y x", "axes: frame y", "stacks.0.images.axes: must name frame, y, x (and channel) once each"),
        ("size: 640", "size: -1", "stacks.0.labels.gaze_x.size: -1 is out of range"),
        ("column: 0", "column: [1]", "stacks.0.labels.gaze_y.column: must be a column's name or its number"),
        ("3 m", "[3]", "stacks.0.labels.object_distance: must be one value or a mapping"),
        ("side: 32", "side: 32\nside: 40", "key 'side' twice"),
        ("import/1", "import/2", "has schema 'tapetum/import/2'; begin it with 'schema: tapetum/import/1'"),
        ("{file: l.csv, column: 0}", "{unit: px}", "does not say where the values are"),
        ("{file: l.csv, column: 0}", "{file: l.csv, value: 1}", "has a value and a file as well"),
        ("file: a.h5, array", "array", "needs either a file or a folder"),
        ("stacks:", "stacks: [", "is no YAML"),
        (GOOD[33:], "", "needs either videos or stacks"),
    ],
)
def test_every_fault_names_its_field(old: str, new: str, told: str, tmp_path: Path):
    assert old in GOOD
    with pytest.raises(InputError) as error:
        loaded(tmp_path, GOOD.replace(old, new))
    line = str(error.value)
    assert line.startswith(str(tmp_path / "map.yaml")) and told in line and "\n" not in line


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("blink", "timestamps", "probe_times and target_times belong to align 'timestamps'"),
        ("blink", "guess", "videos.0.align: unknown value 'guess'"),
        ("device: phone-01", "gaze_x: 0.1", "gaze_x of a whole video must be one value and no gaze"),
        ("20 ms", "20 mm", "videos.0.offset: '20 mm' has the wrong dimension"),
        (", target: t.mkv", "", "videos.0.target: is missing"),
    ],
)
def test_faults_of_pairs(old: str, new: str, told: str, tmp_path: Path):
    with pytest.raises(InputError) as error:
        loaded(tmp_path, VIDEOS.replace(old, new))
    assert told in str(error.value)


def test_no_file(tmp_path: Path):
    with pytest.raises(InputError, match=r"map\.yaml: no such file"):
        load_mapping(tmp_path / "map.yaml")
    (tmp_path / "map.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="is no text"):
        load_mapping(tmp_path / "map.yaml")


def test_the_mappings_of_the_documentation_are_read():
    page = (Path(__file__).parents[2] / "docs" / "importing.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```yaml\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    assert len(blocks) == 3
    for block in blocks:
        mapping_from_text(block, "importing.md")


@pytest.mark.parametrize(("old", "new"), [("size: 640", "size: true"), ("    labels:", "    rate: true\n    labels:")])
def test_a_truth_is_no_number(tmp_path: Path, old: str, new: str):
    with pytest.raises(InputError, match="must be a number, is true"):
        loaded(tmp_path, GOOD.replace(old, new))
