"""Numbers of copies that another command measured stay in the file, where they are of the same kind of network."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import measure_copies as script


def test_rows_of_the_same_networks_stay_and_others_do_not(tmp_path: Path) -> None:
    out = tmp_path / "copies.json"
    options = argparse.Namespace(set="rotation", size=None, precision="float32", longest=None)
    about, rows = script.measured_before(out, options)
    assert rows == []
    out.write_text(json.dumps({**about, "causes": ["tilt"], "rows": [{"copies": 4}]}), encoding="utf-8")
    again, rows = script.measured_before(out, options)
    assert again == about | {"causes": ["tilt"]} and rows == [{"copies": 4}]
    options.size = 48
    assert script.measured_before(out, options) == (about | {"size": 48}, [])
