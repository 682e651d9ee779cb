"""Surfaces, spectra and further lines of a scene: read, refused by their path, and changed by name."""

from __future__ import annotations

import copy
import itertools
import json
import math
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from tapetum.bench import (
    Diffuse,
    Layer,
    Line,
    Microlens,
    PixelArray,
    Scene,
    at_wavelength,
    field_path,
    load_scene,
    scene_dict,
    scene_from_dict,
    scene_yaml,
    with_values,
)
from tapetum.errors import InputError

SENSOR = "target.sensor"
THIN: dict[str, Any] = yaml.safe_load(scene_yaml(load_scene("thin-lens")))
RICH: dict[str, Any] = {
    "array": {"pitch": "2.2 um", "fill": 0.6, "surround": 0.2, "phase": 1.5, "bayer": [1, 0.5, 0.5, 0.3]},
    "microlens": {"focal_length": "6 um", "fill": 0.9},
    "diffuse": {"albedo": 0.2, "spread": "10 um"},
    "layers": [
        {"depth": "0.3 mm", "index": 1.5, "diffuse": {"albedo": 0.01}},
        {
            "depth": "1 mm",
            "reflectance": [["640 nm", 0.02], ["785 nm", 0.9]],
            "transmittance": [["640 nm", 0.95], ["700 nm", 0.1]],
        },
    ],
}
LIGHT = {
    "wavelength": "640 nm",
    "lines": [{"wavelength": "785 nm", "power": "2 mW"}],
    "bandwidth": "20 nm",
    "coherence_length": "30 um",
    "source_size": "1 deg",
    "vergence": "-0.2 1/m",
}
NOISE = {"gain": 0.04, "hot_pixels": 1e-3, "hot_current": "500 1/s", "serial": 12}


def changed(path: str, value: object) -> dict[str, Any]:
    """The thin lens as written, with one field set."""
    content = copy.deepcopy(THIN)
    node, (*steps, last) = content, path.split(".")
    for step in steps:
        node = node.setdefault(step, {})
    node[last] = value
    return content


def rich() -> Scene:
    content = changed(SENSOR, {"reflectance": 0.1, **RICH})
    content["illumination"] = LIGHT
    content["probe"]["sensor"].update(NOISE)
    return scene_from_dict(content)


def layered(**fields: object) -> list[dict[str, object]]:
    return [{"depth": "1 mm", **fields}]


REFUSED: list[tuple[str, object, str]] = [
    # Layers.
    (f"{SENSOR}.layers", [{}], "target.sensor.layers.0.depth: is missing; add 'depth: ...'"),
    (f"{SENSOR}.layers", layered(depth=0), "layers.0.depth: 0 is out of range; give more than 0"),
    (f"{SENSOR}.layers", layered(depth="1 s"), "layers.0.depth: '1 s' has the wrong dimension; give it in m"),
    (f"{SENSOR}.layers", layered(depth="95 mm"), "a layer 0.095 m before the sensor lies in the lens; move it nearer"),
    (f"{SENSOR}.layers", layered(index=0.9), "layers.0.index: 0.9 is out of range; give at least 1"),
    (f"{SENSOR}.layers", layered(index=6), "layers.0.index: 6 is out of range; give at most 5"),
    (f"{SENSOR}.layers", layered(indx=1), "layers.0.indx: unknown key; did you mean target.sensor.layers.index?"),
    (f"{SENSOR}.layers", layered(reflectance=1.2), "layers.0.reflectance: 1.2 is out of range; give 0 to 1"),
    (f"{SENSOR}.layers", layered(reflectance=True), "layers.0.reflectance: True is out of range; give 0 to 1"),
    (f"{SENSOR}.layers", layered(reflectance=math.nan), "layers.0.reflectance: nan is out of range; give 0 to 1"),
    (f"{SENSOR}.layers", layered(reflectance="much"), "reflectance: 'much' is no number; give one from 0 to 1"),
    (f"{SENSOR}.layers", layered(reflectance=[]), "layers.0.reflectance: [] has no rising wavelengths; write [["),
    (f"{SENSOR}.layers", layered(reflectance=[0.1, 0.2]), "layers.0.reflectance: 0.1 is no pair; write [["),
    (f"{SENSOR}.layers", layered(reflectance=[["640 nm", 0.1, 2]]), "is no pair; write [["),
    (
        f"{SENSOR}.layers",
        layered(reflectance=[["700 nm", 0.1], ["640 nm", 0.2]]),
        "[['700 nm', 0.1], ['640 nm', 0.2]] has no rising wavelengths; write [[",
    ),
    (f"{SENSOR}.layers", layered(reflectance=[["640 nm", 1.5]]), "reflectance: 1.5 is out of range; give 0 to 1"),
    (f"{SENSOR}.layers", layered(reflectance=[["640 W", 0.5]]), "'640 W' has the wrong dimension; give it in m"),
    (f"{SENSOR}.layers", layered(reflectance=[[-1, 0.5]]), "-1 is no wavelength; give for example '640 nm'"),
    (f"{SENSOR}.layers", layered(reflectance=[[math.inf, 0.5]]), "inf is no wavelength; give for example '640 nm'"),
    (f"{SENSOR}.layers", layered(transmittance=-0.1), "layers.0.transmittance: -0.1 is out of range; give 0 to 1"),
    (
        f"{SENSOR}.layers",
        layered(reflectance=0.5, transmittance=0.6),
        "layers.0: reflectance and transmittance add up to 1.1 at 640 nm; lower one of them",
    ),
    (
        f"{SENSOR}.layers",
        layered(reflectance=[["500 nm", 0.1], ["700 nm", 0.9]], transmittance=0.5),
        "add up to 1.4 at 700 nm; lower one of them",
    ),
    (f"{SENSOR}.layers", layered(diffuse={"albedo": 2}), "layers.0.diffuse.albedo: 2 is out of range; give at most 1"),
    # Scatter.
    (f"{SENSOR}.diffuse", {}, "target.sensor.diffuse.albedo: is missing; add 'albedo: ...'"),
    (f"{SENSOR}.diffuse", {"albedo": -0.1}, "diffuse.albedo: -0.1 is out of range; give at least 0"),
    (f"{SENSOR}.diffuse", {"albedo": 0.1, "spread": "-1 um"}, "diffuse.spread: '-1 um' is out of range; give at least"),
    (f"{SENSOR}.diffuse", {"albedo": 0.95}, "reflectance and diffuse.albedo add up to 1.05; keep them below 1"),
    # Photosites.
    (f"{SENSOR}.array", {"pitch": 0}, "target.sensor.array.pitch: 0 is out of range; give more than 0"),
    (f"{SENSOR}.array", {"fill": 0}, "array.fill: 0 is out of range; give more than 0"),
    (f"{SENSOR}.array", {"fill": 1.1}, "array.fill: 1.1 is out of range; give at most 1"),
    (f"{SENSOR}.array", {"shape": "star"}, "array.shape: unknown value 'star'; use 'square', 'round' or 'hexagon'"),
    (
        f"{SENSOR}.array",
        {"shape": "round", "fill": 0.9},
        "round photosites fill at most 0.785 of the plane, fill is 0.9; use a square",
    ),
    (f"{SENSOR}.array", {"surround": 1.5}, "array.surround: 1.5 is out of range; give at most 1"),
    (f"{SENSOR}.array", {"phase": 4}, "array.phase: 4 is out of range; give at most 3.14159"),
    (f"{SENSOR}.array", {"bayer": [1, 1, 1]}, "target.sensor.array.bayer"),
    (f"{SENSOR}.array", {"bayer": [1, 1, 1, 2]}, "array.bayer.3: 2 is out of range; give at most 1"),
    (f"{SENSOR}.microlens", {}, "target.sensor.microlens.focal_length: is missing; add 'focal_length: ...'"),
    (f"{SENSOR}.microlens", {"focal_length": "-5 um"}, "microlens.focal_length: '-5 um' is out of range; give more"),
    (f"{SENSOR}.microlens", {"focal_length": "5 um", "fill": 0}, "microlens.fill: 0 is out of range; give more than 0"),
    (f"{SENSOR}.mask", {"pitch": "1 um"}, "target.sensor.mask.file: is missing; add 'file: ...'"),
    (f"{SENSOR}.mask", {"file": 5, "pitch": "1 um"}, "target.sensor.mask.file: must be a string, is 5"),
    (f"{SENSOR}.mask", {"file": "a.npy", "pitch": 0}, "mask.pitch: 0 is out of range; give more than 0"),
    (
        SENSOR,
        {"mask": {"file": "a.npy", "pitch": "1 um"}, "array": {}},
        "target.sensor: a mask takes the place of array and microlens; leave one of them out",
    ),
    # Light.
    ("illumination.lines", [{"wavelength": "785 nm"}], "illumination.lines.0.power: is missing; add 'power: ...'"),
    (
        "illumination.lines",
        [{"wavelength": "785 nm", "power": 0}],
        "lines.0.power: 0 is out of range; give more than 0",
    ),
    (
        "illumination.lines",
        [{"wavelength": "785 um", "power": 1}],
        "lines.0.wavelength: '785 um' is out of range; give at most 2e-06",
    ),
    ("illumination.bandwidth", "-1 nm", "illumination.bandwidth: '-1 nm' is out of range; give at least 0"),
    ("illumination.bandwidth", "300 nm", "illumination.bandwidth: '300 nm' is out of range; give at most 2e-07"),
    ("illumination.coherence_length", 0, "coherence_length: 0 is out of range; give more than 0"),
    ("illumination.coherence_length", math.inf, "coherence_length: must be finite, is inf"),
    ("illumination.source_size", "-1 deg", "source_size: '-1 deg' is out of range; give at least 0"),
    ("illumination.source_size", "15 deg", "source_size: '15 deg' is out of range; give less than 0.2"),
    ("illumination.vergence", "5 m", "vergence: '5 m' has the wrong dimension; give it in 1/m, for example '0.2 1/m'"),
    ("illumination.vergence", math.inf, "vergence: inf is not a finite number; give one"),
    # The probe's noise.
    ("probe.sensor.gain", 0, "probe.sensor.gain: 0 is out of range; give more than 0"),
    ("probe.sensor.gain", math.nan, "probe.sensor.gain: must be finite, is nan"),
    ("probe.sensor.hot_pixels", 1.1, "probe.sensor.hot_pixels: 1.1 is out of range; give at most 1"),
    ("probe.sensor.hot_pixels", -1e-3, "probe.sensor.hot_pixels: -0.001 is out of range; give at least 0"),
    ("probe.sensor.hot_current", -1, "probe.sensor.hot_current: -1 is out of range; give at least 0"),
    ("probe.sensor.hot_current", "5 s", "hot_current: '5 s' has the wrong dimension; give it in 1/s"),
    ("probe.sensor.serial", -1, "probe.sensor.serial: -1 is out of range; give at least 0"),
    ("probe.sensor.serial", 1.5, "probe.sensor.serial: must be a whole number, is 1.5"),
    # Lenses and propagation.
    ("target.lens.glass", "BK8", "target.lens.glass: unknown value 'BK8'; use 'N-BK7', 'N-SF11', 'fused silica' or"),
    ("target.lens.design_wavelength", "5 um", "design_wavelength: '5 um' is out of range; give at most 2e-06"),
    ("sampling.propagation", "near", "propagation: unknown value 'near'; use 'auto', 'far field' or 'finite'"),
]


@pytest.mark.parametrize(("path", "value", "words"), REFUSED, ids=[f"{p}-{i}" for i, (p, _, _) in enumerate(REFUSED)])
def test_refused_with_path_value_and_remedy(path: str, value: object, words: str) -> None:
    with pytest.raises(InputError) as raised:
        scene_from_dict(changed(path, value), where="f.yaml")
    assert str(raised.value).startswith("f.yaml: ") and words in str(raised.value)
    assert raised.value.remedy and "\n" not in str(raised.value)


def test_a_band_as_wide_as_its_wavelength_is_no_line() -> None:
    light = {"wavelength": "300 nm", "bandwidth": "160 nm"}
    with pytest.raises(InputError, match=r"bandwidth 1\.6e-07 m is no line at 3e-07 m; give a narrower one"):
        scene_from_dict(changed("illumination", light))


def test_what_a_scene_says_is_what_it_holds() -> None:
    scene = rich()
    sensor, light, noise = scene.target.sensor, scene.illumination, scene.probe.sensor
    assert sensor.array == PixelArray(2.2e-6, 0.6, "square", 0.2, 1.5, (1.0, 0.5, 0.5, 0.3))
    assert sensor.microlens == Microlens(6e-6, 0.9)
    assert sensor.diffuse is not None and sensor.diffuse.spread == pytest.approx(10e-6)
    near, far = sensor.layers
    assert near.depth == pytest.approx(3e-4) and near.diffuse == Diffuse(0.01) and near.transmittance is None
    assert isinstance(far.reflectance, tuple) and far.reflectance[1] == (pytest.approx(785e-9), 0.9)
    assert isinstance(light.lines[0], Line) and light.lines[0].wavelength == pytest.approx(785e-9)
    assert (light.bandwidth, light.coherence_length) == (pytest.approx(20e-9), pytest.approx(30e-6))
    assert light.source_size == pytest.approx(math.radians(1)) and light.vergence == -0.2
    assert (noise.gain, noise.hot_pixels, noise.hot_current, noise.serial) == (0.04, 1e-3, 500.0, 12)


def test_old_scenes_have_none_of_it() -> None:
    scene = load_scene("thin-lens")
    sensor, light, noise = scene.target.sensor, scene.illumination, scene.probe.sensor
    assert sensor.layers == light.lines == ()
    assert sensor.array is sensor.microlens is sensor.mask is sensor.diffuse is light.vergence is noise.gain is None
    assert light.bandwidth == light.source_size == noise.hot_pixels == noise.hot_current == 0
    assert scene.target.lens.glass is None


def test_round_trips(tmp_path: Path) -> None:
    scene = rich()
    masked = scene_from_dict(changed(f"{SENSOR}.mask", {"file": "mask.npy", "pitch": "1 um"}))
    assert masked.target.sensor.mask is not None and masked.target.sensor.mask.file == "mask.npy"
    assert masked.target.sensor.mask.pitch == pytest.approx(1e-6)
    for one in (scene, masked):
        assert scene_from_dict(scene_dict(one)) == one
        assert scene_from_dict(json.loads(json.dumps(scene_dict(one), allow_nan=False))) == one
        (tmp_path / "copy.yaml").write_text(scene_yaml(one), encoding="utf-8")
        assert load_scene(tmp_path / "copy.yaml") == one
        assert with_values(one, {"distance": 7}) == with_values(with_values(one, {"distance": 3}), {"distance": 7})


@pytest.fixture
def path(tmp_path: Path) -> Path:
    place = tmp_path / "rich.yaml"
    place.write_text(scene_yaml(rich()), encoding="utf-8")
    return place


def test_changes_reach_into_lists(path: Path) -> None:
    scene = load_scene(
        path,
        [
            "layers.0.depth=2 mm",
            "target.sensor.layers.1.reflectance=[[500 nm, 0], [700 nm, 0.05]]",
            "lines.0.power=5 mW",
            "layers.0.diffuse.albedo=0.02",
            "bayer.2=0.25",
        ],
    )
    near, far = scene.target.sensor.layers
    assert near.depth == pytest.approx(2e-3) and near.diffuse == Diffuse(0.02)
    assert far.reflectance == ((pytest.approx(500e-9), 0.0), (pytest.approx(700e-9), 0.05))
    assert scene.illumination.lines[0].power == pytest.approx(5e-3)
    assert scene.target.sensor.array is not None and scene.target.sensor.array.bayer == (1.0, 0.5, 0.25, 0.3)
    # All else stays.
    assert far.depth == rich().target.sensor.layers[1].depth and scene.probe == rich().probe


def test_a_whole_list_or_a_whole_layer_is_set_at_once(path: Path) -> None:
    scene = load_scene(path, ["layers=[{depth: 1 mm}, {depth: 3 mm}, {depth: 2 mm}]"])
    assert [one.depth for one in scene.target.sensor.layers] == pytest.approx([1e-3, 3e-3, 2e-3])
    scene = load_scene(path, ["target.sensor.layers.1={depth: 4 mm}"])
    assert scene.target.sensor.layers[1] == Layer(depth=4e-3)
    assert load_scene(path, ["layers=[]"]).target.sensor.layers == ()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("layers.2.depth=1 mm", "layers.2.depth: has 2 entries, none is '2'; count from 0 to 1"),
        ("layers.0.depth=0", "target.sensor.layers.0.depth: 0 is out of range; give more than 0"),
        ("layers.0.reflectanse=0.1", "layers.0.reflectanse: a scene has no such field; write for example"),
        ("0.depth=1", "0.depth: a scene has no such field; write for example layers.0.depth"),
        ("lines.1.power=1 mW", "lines.1.power: has 1 entries, none is '1'; count from 0 to 0"),
        ("layers.x.depth=1 mm", "layers.x.depth: a scene has no such field"),
    ],
)
def test_changes_of_what_is_not_there(path: Path, change: str, words: str) -> None:
    with pytest.raises(InputError) as raised:
        load_scene(path, [change])
    assert words in str(raised.value) and raised.value.remedy


def test_an_empty_list_has_no_first_entry() -> None:
    for change in ("layers.0.depth=1 mm", "lines.0.power=1 mW"):
        with pytest.raises(InputError, match=r"has 0 entries, none is '0'; give the whole list first"):
            load_scene("thin-lens", [change])


def test_keys_of_list_members() -> None:
    assert field_path("layers.0.depth") == ("target", "sensor", "layers", "0", "depth")
    assert field_path("illumination.lines.1.power") == ("illumination", "lines", "1", "power")
    assert field_path("layers") == ("target", "sensor", "layers")
    # Without a number `albedo` is that of the sensor alone.
    assert field_path("albedo") == ("target", "sensor", "diffuse", "albedo")


SHARE = st.floats(0, 1)
TABLE = st.lists(st.tuples(st.floats(200e-9, 2e-6), SHARE), min_size=1, max_size=8, unique_by=lambda pair: pair[0]).map(
    lambda pairs: tuple(sorted(pairs))
)


@given(TABLE, st.floats(100e-9, 3e-6))
def test_a_spectrum_lies_between_its_neighbours(table: tuple[tuple[float, float], ...], wavelength: float) -> None:
    value = at_wavelength(table, wavelength)
    shares = [share for _, share in table]
    assert min(shares) - 1e-12 <= value <= max(shares) + 1e-12
    for (a, low), (b, high) in itertools.pairwise(table):
        if a <= wavelength <= b:
            assert min(low, high) - 1e-12 <= value <= max(low, high) + 1e-12
    if wavelength <= table[0][0]:
        assert value == table[0][1]
    if wavelength >= table[-1][0]:
        assert value == pytest.approx(table[-1][1], abs=1e-12)
    for at, share in table:
        assert at_wavelength(table, at) == pytest.approx(share, abs=1e-12)


@given(SHARE, st.floats(100e-9, 3e-6))
def test_one_number_holds_at_all_wavelengths(share: float, wavelength: float) -> None:
    assert at_wavelength(share, wavelength) == share
    assert at_wavelength(((640e-9, share),), wavelength) == share


def test_a_spectrum_is_linear_between_its_pairs() -> None:
    table = ((500e-9, 0.2), (700e-9, 0.6))
    assert at_wavelength(table, 600e-9) == pytest.approx(0.4)
    assert at_wavelength(table, 550e-9) == pytest.approx(0.3)


@given(TABLE)
def test_spectra_survive_a_round_trip(table: tuple[tuple[float, float], ...]) -> None:
    one = with_values(load_scene("thin-lens"), {"layers": [{"depth": 1e-3, "reflectance": [list(p) for p in table]}]})
    assert one.target.sensor.layers[0].reflectance == table
    assert scene_from_dict(json.loads(json.dumps(scene_dict(one), allow_nan=False))) == one


@given(TABLE, SHARE)
def test_no_layer_makes_light(table: tuple[tuple[float, float], ...], transmittance: float) -> None:
    most = max(share for _, share in table) + transmittance
    build = {"depth": 1e-3, "reflectance": table, "transmittance": transmittance}
    if most > 1 + 1e-6:
        with pytest.raises(ValueError, match="add up to"):
            Layer(**build)
    elif most <= 1:
        layer = Layer(**build)
        for wavelength in (250e-9, 640e-9, 1.5e-6):
            assert at_wavelength(layer.reflectance, wavelength) + transmittance <= 1 + 1e-9
