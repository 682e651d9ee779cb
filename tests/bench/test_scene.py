"""Scenes in and out of YAML, changed by name, and refused by the field's path."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import re
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tapetum.bench import (
    Illumination,
    PhoneTarget,
    PrescriptionLens,
    Scene,
    field_path,
    load_scene,
    scene_dict,
    scene_from_dict,
    scene_names,
    scene_schema,
    scene_yaml,
    with_values,
)
from tapetum.errors import InputError

SCENES = resources.files("tapetum.bench") / "scenes"
THIN: dict[str, Any] = yaml.safe_load((SCENES / "thin-lens.yaml").read_text(encoding="utf-8"))


def changed(path: str, value: object) -> dict[str, Any]:
    """The bundled thin-lens as written, with one field set."""
    content = copy.deepcopy(THIN)
    node, (*steps, last) = content, path.split(".")
    for step in steps:
        node = node.setdefault(step, {})
    node[last] = value
    return content


def test_the_bundled_thin_lens_is_the_papers() -> None:
    scene = load_scene("thin-lens")
    assert (scene.distance, scene.illumination.wavelength, scene.illumination.power) == (5.0, 640e-9, 1e-3)
    assert scene.target.lens.focal_length == pytest.approx(0.1)
    assert scene.target.lens.aperture_radius == pytest.approx(3e-3)
    assert scene.target.object_distance == 5.0 and scene.target.rotation == (0.0, 0.0)
    assert scene.probe.lens.focal_length == pytest.approx(0.2) and scene.probe.sensor.pixels == (256, 256)


@pytest.mark.parametrize("name", scene_names())
def test_bundled_scenes_survive_a_round_trip(name: str, tmp_path: Path) -> None:
    scene = load_scene(name)
    assert scene_from_dict(scene_dict(scene)) == scene
    assert scene_from_dict(json.loads(json.dumps(scene_dict(scene), allow_nan=False))) == scene
    (tmp_path / "copy.yaml").write_text(scene_yaml(scene), encoding="utf-8")
    assert load_scene(tmp_path / "copy.yaml") == scene


def test_a_target_focused_at_infinity_survives_a_round_trip() -> None:
    scene = scene_from_dict(changed("target.object_distance", math.inf))
    assert scene.target.object_distance == math.inf
    told = json.dumps(scene_dict(scene), allow_nan=False)
    assert scene_from_dict(json.loads(told)) == scene
    assert with_values(scene, {"distance": 3}).target.object_distance == math.inf
    assert load_scene("thin-lens", ["object_distance=inf"]).target.object_distance == math.inf


def test_scenes_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        load_scene("thin-lens").distance = 3.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("targt", {}, "f.yaml: targt: unknown key; did you mean target?"),
        ("target.lens.apperture", 1, "target.lens.apperture: unknown key; did you mean target.lens.aperture_radius?"),
        ("probe.wavelength", 1, "probe.wavelength: unknown key; did you mean illumination.wavelength?"),
        ("probe.zzz", 1, "probe.zzz: unknown key; use lens, sensor, transmission"),
        ("target.lens.aperture_radius", "-3 mm", "aperture_radius: '-3 mm' is out of range; give more than 0"),
        ("target.lens.aperture_radius", 0, "aperture_radius: 0 is out of range; give more than 0"),
        ("target.lens.aperture_radius", math.inf, "aperture_radius: must be finite, is inf"),
        ("target.lens.aperture_radius", "3 kg", "'3 kg' has the wrong dimension; give it in m"),
        ("target.lens.focal_length", None, "focal_length: None is no quantity"),
        ("target.lens.kind", "thick", "target.lens.kind: unknown value 'thick'; use 'thin' or 'prescription'"),
        ("target.lens.kind", 5, "target.lens.kind: unknown value '5'; use 'thin' or 'prescription'"),
        ("target.kind", "phones", "target.kind: unknown value 'phones'; use 'camera' or 'phone'"),
        # The kinds of a union are names that a file may hold as well.
        ("camera", {}, "f.yaml: camera: unknown key; did you mean target.camera?"),
        ("thin", 1, "f.yaml: thin: unknown key; use distance, illumination,"),
        ("target.camera", "main", "target.camera: unknown key; it belongs to another kind; give the whole target of"),
        ("target.lens.thin", 1, "f.yaml: target.lens.thin: unknown key; use aperture_radius,"),
        ("probe.lens.prescription", 1, "f.yaml: probe.lens.prescription: unknown key; use aperture_radius,"),
        ("target.lens.name", "phone-f", "target.lens.name: unknown key; it belongs to another kind; give the whole"),
        ("target.lens", "phone-f", "target.lens: must be a mapping of fields, is 'phone-f'; give it a kind, thin or"),
        ("target.object_distance", "5 cm", "object_distance 0.05 m is not beyond the focal length 0.1 m; focus"),
        ("target.object_distance", "100 mm", "is not beyond the focal length"),
        ("target.rotation", ["40 deg", 0], "light under 40 deg, outside the model of a thin lens; stay below 30 deg"),
        ("target.rotation", ["29 deg", "29 deg"], "meets the light under 43.28 deg, outside the model of a thin lens"),
        ("target.rotation", ["1 deg"], "target.rotation: has 1 of the values it needs, is ['1 deg']; give all"),
        ("target.rotation", "1 deg", "target.rotation: must be a list of two values, is '1 deg'; write it in brackets"),
        ("target", 5, "target: must be a mapping of fields, is 5; give it a kind, camera or phone, and the fields of"),
        ("probe", 5, "probe: must be a mapping of fields, is 5; give it the fields lens, sensor, transmission"),
        ("target.sensor.reflectance", 1.5, "reflectance: 1.5 is out of range; give at most 1"),
        ("illumination.mode", "lamp", "unknown value 'lamp'; use 'collimated', 'diverging' or 'fixed_area'"),
        ("illumination.mode", "diverging", "mode 'diverging' needs a divergence; add"),
        ("illumination.mode", "fixed_area", "mode 'fixed_area' needs a diameter; add"),
        ("illumination.divergence", "1 deg", "divergence has no meaning in mode 'collimated'; leave it out"),
        ("illumination.wavelength", "640 um", "wavelength: '640 um' is out of range; give at most 2e-06"),
        ("illumination.second_beam", {"ratio": 0.1}, "illumination.second_beam.angle: is missing; add 'angle: ...'"),
        ("probe.sensor.bits", 8.5, "probe.sensor.bits: must be a whole number, is 8.5"),
        ("probe.sensor.bits", 17, "probe.sensor.bits: 17 is out of range; give at most 16"),
        ("probe.sensor.pixels", [0, 5], "pixels [0, 5] are out of range; give 1 to 16384 a side"),
        ("probe.sensor.full_well", math.nan, "full_well: must be finite, is nan"),
        ("probe.sensor.exposure", "10 Hz", "exposure: '10 Hz' has the wrong dimension; give it in s"),
        ("sampling.pupil", -4, "sampling.pupil: -4 is out of range; give more than 0"),
        ("distance", True, "distance: True is no quantity"),
        ("distance", math.nan, "distance: nan is not a finite number; give one"),
    ],
)
def test_refused_with_path_value_and_remedy(path: str, value: object, words: str) -> None:
    with pytest.raises(InputError) as raised:
        scene_from_dict(changed(path, value), where="f.yaml")
    assert str(raised.value).startswith("f.yaml: ") and words in str(raised.value)
    assert raised.value.remedy and "\n" not in str(raised.value)


def test_a_missing_field() -> None:
    content = copy.deepcopy(THIN)
    del content["target"]["lens"]["focal_length"]
    with pytest.raises(InputError, match=r"f: target\.lens\.focal_length: is missing; add 'focal_length: \.\.\.'"):
        scene_from_dict(content, "f")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no mapping"),
        ("- 1", "holds no mapping"),
        ("distance: 5 m", "has schema None; begin it with 'schema: tapetum/scene/1'"),
        ("schema: tapetum/scene/2", "has schema 'tapetum/scene/2'"),
        ("a: [1", "is no YAML"),
        ("schema: tapetum/scene/1\nprobe: {lens: 1, lens: 2}", "key 'lens' twice"),
        ("!!python/object/apply:os.getcwd []", "is no YAML"),
    ],
)
def test_files_that_are_no_scene(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as raised:
        load_scene(path)
    assert str(raised.value).startswith(f"{path}: ") and words in str(raised.value)


def test_files_that_are_not_there_or_no_text(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no such scene; give the path of a YAML file, or one of .*thin-lens"):
        load_scene(tmp_path / "gone.yaml")
    (tmp_path / "a.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="is no text"):
        load_scene(tmp_path / "a.yaml")


def test_keys_are_found_by_their_last_words() -> None:
    assert field_path("rotation") == ("target", "rotation")
    assert field_path(" distance ") == ("distance",)
    assert field_path("target.sensor.pitch") == ("target", "sensor", "pitch")
    assert field_path("second_beam.ratio") == ("illumination", "second_beam", "ratio")
    with pytest.raises(InputError, match=r"say target\.lens\.focal_length or .* or probe\.lens\.focal_length"):
        field_path("focal_length")
    with pytest.raises(InputError, match=r"rotatoin: a scene has no such field; did you mean target\.rotation or"):
        field_path("rotatoin")
    with pytest.raises(InputError, match=r"did you mean .*target"):
        field_path("qqqq")


@pytest.mark.parametrize(
    ("value", "degrees"),
    [
        ("0.5", (0, 0.5)),
        ("5e-1", (0, 0.5)),
        ("'0.5'", (0, 0.5)),
        ("-2", (0, -2)),
        ("1 deg", (0, 1)),
        ("10 mrad", (0, math.degrees(0.01))),
        ("[1, 2]", (1, 2)),
        ("[1 deg, 2]", (1, 2)),
        ("[1e0, 2]", (1, 2)),
    ],
)
def test_a_bare_rotation_is_in_degrees_about_x(value: str, degrees: tuple[float, float]) -> None:
    scene = load_scene("thin-lens", [f"rotation={value}"])
    assert scene.target.rotation == pytest.approx(tuple(math.radians(d) for d in degrees))


def test_a_rotation_of_any_sequence_is_in_degrees() -> None:
    scene = load_scene("thin-lens")
    for value, degrees in (
        (np.array([0.1, 0.2]), (0.1, 0.2)),
        (np.array([0.1, 0.2], np.float32), (0.1, 0.2)),
        (range(1, 3), (1, 2)),
        (iter((0.1, 0.2)), (0.1, 0.2)),
        (np.array(0.2), (0, 0.2)),
        (np.float32(0.2), (0, 0.2)),
    ):
        turned = with_values(scene, {"rotation": value}).target.rotation
        assert turned == pytest.approx(tuple(math.radians(d) for d in degrees), rel=1e-6)
    for value in ({0.1, 0.2}, {"x": 0.1}, np.array([[0.1, 0.2]]), np.array([0.1, 0.2, 0.3]), None, object()):
        with pytest.raises(InputError, match="rotation"):
            with_values(scene, {"rotation": value})


def test_changes_are_checked_with_the_whole() -> None:
    scene = load_scene("thin-lens", ["target.lens.focal_length=75 mm", "object_distance = 0.08"])
    assert scene.target.lens.focal_length == pytest.approx(0.075) and scene.target.object_distance == 0.08
    again = with_values(scene, {"illumination.second_beam": {"ratio": 0.1, "angle": ["1 mrad", 0]}, "bits": 12})
    assert again.illumination.second_beam is not None and again.probe.sensor.bits == 12
    assert scene.illumination.second_beam is None
    with pytest.raises(InputError, match=r"thin-lens: target: object_distance 0\.05 m is not beyond"):
        load_scene("thin-lens", ["object_distance=5 cm"])


@pytest.mark.parametrize("name", ["rotation", "focusing"])
def test_the_bundled_cameras_are_built_about_half_as_badly_as_makers_allow(name: str) -> None:
    """Basler's pilot: 40 um over the sensor, at most 0.63 deg, and 0.25 mm (docs/sign.md)."""
    sensor = load_scene(name).target.sensor
    for pixels, tilt, decentre in zip(sensor.pixels, sensor.tilt, sensor.decentre, strict=True):
        assert 0.4 < abs(math.tan(tilt)) * pixels * sensor.pitch / 40e-6 < 0.6
        assert abs(tilt) < math.radians(0.63) and 0.3 < abs(decentre) / 0.25e-3 < 0.6


def test_a_lens_and_a_phone_are_changed_by_name() -> None:
    other = load_scene("rotation", ["target.lens.name=phone-f", "target.lens.focal_length=4.06 mm"])
    assert isinstance(other.target.lens, PrescriptionLens) and other.target.lens.name == "phone-f"
    real = load_scene("thin-lens", ["target.lens={kind: prescription, name: phone-f, f_number: 4}"])
    assert isinstance(real.target.lens, PrescriptionLens) and real.target.lens.f_number == 4
    # The file's own focal length is nobody's wish: another name brings its own.
    again = with_values(real, {"target.lens.name": "phone-b", "lens.f_number": 5})
    assert again.target.lens.focal_length == pytest.approx(5.11e-3, rel=2e-3)
    phone = load_scene("phones", ["target.name=phone-03", "target.camera=tele", "imaging=false"])
    assert isinstance(phone.target, PhoneTarget) and phone.target.name == "phone-03"
    assert phone.target.unit.name == "tele" and not phone.target.imaging
    instead = load_scene("thin-lens", ["target={kind: phone, name: phone-02, object_distance: 5}"])
    assert isinstance(instead.target, PhoneTarget) and load_scene("phones").target.lens.kind == "prescription"


@pytest.mark.parametrize(
    ("scene", "changes", "words"),
    [
        ("rotation", ["target.lens.name=phone-x"], "target.lens: phone-x: no such lens; did you mean phone-"),
        ("phones", ["target.name=phone-12"], "target: phone-12: no such phone; did you mean phone-1"),
        ("phones", ["target.camera=back"], "target: phone-01 has no camera 'back'; use main"),
        ("phones", ["target.lens.name=phone-f"], "target.lens: unknown key; it belongs to another kind; give the"),
        (
            "rotation",
            ["target.lens={kind: prescription, name: phone-a}", "layers=[{depth: 0.3 mm}, {depth: 1.2 mm}]"],
            "target: sensor.layers.1: a layer 0.0012 m before the sensor lies in the lens, which ends 0.00",
        ),
        ("focusing", ["target.lens.focal_length=200 mm"], "focal_length 200 mm is beyond this zoom; give one of 18."),
        ("rotation", ["target.lens.f_number=0.9"], "f_number 0.9 is wider than cmount-12mm-f1.4 opens; give 1.4"),
    ],
)
def test_a_lens_or_a_phone_that_cannot_be(scene: str, changes: list[str], words: str) -> None:
    with pytest.raises(InputError) as raised:
        load_scene(scene, changes)
    assert words in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (["distance"], "--set: 'distance' is no change; write KEY=VALUE"),
        (["=5"], "write KEY=VALUE"),
        (["distance=[1"], "--set distance: '[1' is no value; write it as in a scene file"),
        (["target.lens=5", "target.lens.kind=thin"], "inside of a value that is changed to 5"),
        (["distance="], "thin-lens: distance: None is no quantity"),
    ],
)
def test_changes_that_cannot_be_made(changes: list[str], words: str) -> None:
    with pytest.raises(InputError) as raised:
        load_scene("thin-lens", changes)
    assert words in str(raised.value)


def test_the_schema_that_ships_is_current() -> None:
    shipped = json.loads((SCENES / "scene.schema.json").read_text(encoding="utf-8"))
    remedy = "write json.dumps(tapetum.bench.scene_schema(), indent=2) to it"
    assert shipped == scene_schema(), remedy


def test_the_schema_says_what_the_reader_asks() -> None:
    schema = scene_schema()
    assert schema["required"] == ["schema", "distance", "target", "probe"]
    assert schema["properties"]["schema"]["const"] == "tapetum/scene/1"
    fields = {field.name for field in dataclasses.fields(Scene)}
    assert set(schema["properties"]) == fields
    for part in (schema, *schema["$defs"].values()):
        assert part["additionalProperties"] is False
    lens = schema["$defs"]["ThinLens"]
    assert set(lens["required"]) == {"focal_length", "aperture_radius"}
    assert {"type": "string"} in lens["properties"]["focal_length"]["anyOf"]


@pytest.mark.parametrize(
    ("light", "radius", "curvature", "nearer"),
    [
        (Illumination(), 0.01, 0.0, 1.0),
        (Illumination(diameter=0.05), 0.025, 0.0, 1.0),
        (Illumination("diverging", divergence=0.02), 4 * math.tan(0.01), 0.25, 4.0),
        (Illumination("fixed_area", diameter=0.05), 0.025, 0.25, 1.0),
        (Illumination("fixed_area", diameter=0.05, vergence=-0.5), 0.025, -0.5, 1.0),
    ],
)
def test_each_mode_carries_its_radius_curvature_and_irradiance(
    light: Illumination, radius: float, curvature: float, nearer: float
) -> None:
    assert light.radius(4.0, 0.01) == pytest.approx(radius)
    assert light.curvature(4.0) == curvature
    assert light.spread(2.0, 4.0) == nearer
    assert light.follows_distance == (curvature == 0.25)


def test_a_truth_is_no_number() -> None:
    """Pydantic takes true for 1: a sensor of one bit was filmed."""
    for changes, told in (
        ({"probe.sensor.bits": True}, "probe.sensor.bits: must be a number, is true"),
        ({"probe.sensor.pixels": [True, 64]}, "probe.sensor.pixels.0: must be a number, is true"),
    ):
        with pytest.raises(InputError, match=re.escape(told)):
            with_values(load_scene("thin-lens"), changes)
    assert not with_values(load_scene("phones"), {"sampling.rim_light": False}).sampling.rim_light


def test_the_probes_lens_has_one_focal_length() -> None:
    """Its glass was taken, and pictures did not know of it."""
    with pytest.raises(InputError, match=r"probe: the probe's lens has one focal length.*leave lens\.glass out"):
        with_values(load_scene("thin-lens"), {"probe.lens.glass": "N-SF11"})
