"""Zemax's files: the same lens as the catalogue's, or one line that says what is wrong."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest

from tapetum.bench.lens_file import load_lens
from tapetum.bench.prescription import PrescriptionLens
from tapetum.errors import InputError, MissingExtraError

ZEMAX = """MODE SEQ
NAME a plano-convex lens
UNIT {unit} X W X CM MR CPMM
ENPD 20
FTYP 0 0 2 1 0 0 0
XFLN 0 0
YFLN 0 5
WAVM 1 0.64 1
PWAV 1
GCAT SCHOTT
SURF 0
  TYPE STANDARD
  CURV 0.0 0 0 0 0
  DISZ INFINITY
SURF 1
  STOP
  TYPE {kind}
  CURV {curvature} 0 0 0 0
  PARM 2 {fourth}
  DISZ 3.6
  GLAS {glass}
  DIAM {semi} 1 0 0 1
SURF 2
  TYPE STANDARD
  CURV 0.0 0 0 0 0
  DISZ 97.3
  DIAM 12.7 1 0 0 1
SURF 3
  TYPE STANDARD
  CURV 0.0 0 0 0 0
  DISZ 0
  DIAM 5 0 0 0 1
"""


def zemax(folder: Path, encoding: str = "utf-8", **values: object) -> str:
    pytest.importorskip("optiland")
    known = {
        "unit": "MM",
        "kind": "EVENASPH",
        "curvature": 1 / 51.5,
        "fourth": 0,
        "glass": "N-BK7 0 0 1.5168 64.17",
        "semi": 12.7,
    }
    path = folder / "lens.zmx"
    path.write_bytes(ZEMAX.format(**(known | values)).encode(encoding))
    return str(path)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_a_zemax_file_is_the_same_lens(encoding: str, tmp_path: Path) -> None:
    lens = PrescriptionLens(zemax(tmp_path, encoding))
    ours = PrescriptionLens("la1509")
    assert lens.focal_length == pytest.approx(ours.focal_length, rel=1e-6)
    assert lens.focused(785e-9, 2.0).image == pytest.approx(ours.focused(785e-9, 2.0).image, rel=1e-4)
    assert load_lens(lens.name).states[0].half_field == pytest.approx(math.radians(5))
    curved = load_lens(zemax(tmp_path, encoding, fourth=-1e-7)).surfaces[0]
    assert dict(curved.asphere) == pytest.approx({4: -1e-7 * 1e9})


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"glass": "MIRROR"}, "surface 1: is a mirror; use a lens"),
        ({"kind": "ZERNSAG"}, "surface 1: is of the type zernsag; use standard, even and odd aspheres only"),
        ({"semi": 0}, "surface 1: has no semi-diameter; save the file with its DIAM lines"),
        ({"unit": "FT"}, "has the unit FT; use MM, CM, METER, IN"),
        ({"curvature": "round"}, "optiland cannot read it"),
    ],
)
def test_faults_of_a_zemax_file_are_named(values: dict[str, object], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        load_lens(zemax(tmp_path, **values))


def test_zemax_files_need_their_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in [one for one in sys.modules if one.split(".")[0] == "optiland"]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "optiland", None)
    path = tmp_path / "other.zmx"
    path.write_text("MODE SEQ\n", encoding="utf-8")
    with pytest.raises(MissingExtraError, match=r"pip install 'tapetum\[zemax\]'"):
        load_lens(str(path))
