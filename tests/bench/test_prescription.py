"""Prescriptions as a scene holds them: scaled, zoomed, stopped down, focused, and refused in one line."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from pydantic import TypeAdapter, ValidationError

from tapetum.bench import scene_dict, scene_from_dict, with_values
from tapetum.bench.lens_data import clearance
from tapetum.bench.lens_file import LENS_SCHEMA, load_lens, prescription_from_dict
from tapetum.bench.prescription import PrescriptionLens
from tapetum.errors import InputError
from tapetum.optics.focus import best_focus, moved_group, pupil_height
from tapetum.optics.paraxial import paraxial

# A thin-ish symmetric lens and a stop behind it, in millimetres.
PLAIN: dict[str, Any] = {
    "name": "plain",
    "source": "made up",
    "unit": "mm",
    "states": [{"name": "prime"}],
    "surfaces": [
        {"radius": 40, "thickness": 3, "nd": 1.5168, "vd": 64.2, "semi_diameter": 6},
        {"radius": -40, "thickness": 1, "semi_diameter": 6},
        {"thickness": 36, "semi_diameter": 4, "stop": True},
    ],
}


def changed(path: str, value: object) -> dict[str, Any]:
    content = copy.deepcopy(PLAIN)
    node: Any = content
    *steps, last = path.split(".")
    for step in steps:
        node = node[int(step)] if isinstance(node, list) else node[step]
    if value is None:
        del node[last]
    else:
        node[int(last) if isinstance(node, list) else last] = value
    return content


def write(folder: Path, content: dict[str, Any], schema: str = LENS_SCHEMA) -> str:
    path = folder / "lens.yaml"
    path.write_text(yaml.safe_dump({"schema": schema, **content}), encoding="utf-8")
    return str(path)


def test_a_file_is_read_in_its_unit(tmp_path: Path) -> None:
    lens = load_lens(write(tmp_path, PLAIN))
    assert lens.surfaces[0].radius == pytest.approx(40e-3) and lens.surfaces[2].semi_diameter == pytest.approx(4e-3)
    inches = copy.deepcopy(PLAIN) | {"unit": "inch"}
    assert prescription_from_dict(inches).surfaces[0].radius == pytest.approx(40 * 25.4e-3)
    # A text carries its own unit; a coefficient of r^4 goes with the unit's third power.
    mixed = changed("surfaces.0.radius", "4 cm")
    mixed["surfaces"][0]["asphere"] = {4: 1e-5, 3: "2e-6"}
    surface = prescription_from_dict(mixed).surfaces[0]
    assert surface.radius == pytest.approx(40e-3)
    assert dict(surface.asphere) == pytest.approx({4: 1e4, 3: 2.0})


def test_a_changed_file_is_read_again(tmp_path: Path) -> None:
    name = write(tmp_path, PLAIN)
    first, before = load_lens(name), PrescriptionLens(name).focused(640e-9, math.inf)
    second = load_lens(write(tmp_path, changed("surfaces.0.radius", 41.5)))
    assert first != second and second.surfaces[0].radius == pytest.approx(41.5e-3)
    assert PrescriptionLens(name).focused(640e-9, math.inf).image > before.image + 1e-4


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("surfaces.0.vd", None, r"surfaces\.0: nd and vd belong together; give both"),
        ("surfaces.0.glass", "N-BK7", r"surfaces\.0: two media behind one surface; give nd and vd, or index, or glass"),
        ("surfaces.0.semi_diameter", None, r"surfaces\.0\.semi_diameter: is missing; add 'semi_diameter"),
        ("surfaces.0.semi_diameter", -1, r"surfaces\.0\.semi_diameter: -0\.001 is out of range"),
        ("surfaces.0.radius", "4 kg", r"surfaces\.0\.radius: '4 kg' has the wrong dimension"),
        ("surfaces.0.radius", [1], r"surfaces\.0\.radius: \[1\] is no quantity"),
        ("surfaces.0.radius", 0, r"surfaces\.0: a radius of 0 m is that of no lens"),
        ("surfaces.0.asphere", {1: 0.1}, r"surfaces\.0\.asphere.*out of range; give at least 2"),
        ("surfaces.0.asphere", {"x": 0.1}, r"surfaces\.0\.asphere: 'x': 0\.1 is no term; write it as"),
        ("surfaces.0.asphere", {4: "big"}, r"surfaces\.0\.asphere: coefficient 'big' of r\^4 is no number"),
        ("surfaces.0.thicknes", 3, r"surfaces\.0\.thicknes: unknown key; did you mean surfaces\.thickness\?"),
        (
            "surfaces.0.thickness",
            -4,
            r"state 'prime': surfaces 0 and 1 cross .* m from the axis, by .*; mend the thick",
        ),
        ("surfaces.0.thickness", 0.5, r"state 'prime': surfaces 0 and 1 cross 0\.006 m from the axis"),
        ("surfaces.2.stop", False, r"no surface is the aperture stop; give one surface 'stop: true'"),
        ("surfaces.0.stop", True, r"surfaces \[0, 2\] are the aperture stop; give one"),
        ("surfaces.2.index", 1.5, r"glass behind the last surface; end with"),
        ("surfaces", [], r"surfaces"),
        ("states", [], r"states"),
        ("states.0.thickness", {9: 1.0}, r"state 'prime' names surface 9; count from 0 to 2"),
        ("focus", [0, 1], r"a group \[0, 1\] cannot move; name surfaces from 1 to 1"),
        ("unit", "furlong", r"unit: unknown value 'furlong'; use m, cm, mm, um, inch"),
    ],
)
def test_faults_of_a_file_are_named(path: str, value: object, message: str, tmp_path: Path) -> None:
    name = write(tmp_path, changed(path, value))
    with pytest.raises(InputError, match=message) as caught:
        load_lens(name)
    assert str(caught.value).startswith(name) and "\n" not in str(caught.value)


def test_an_unknown_glass_is_named() -> None:
    glassy = changed("surfaces.0", {"radius": 40, "thickness": 3, "glass": "BK8", "semi_diameter": 6})
    with pytest.raises(InputError, match=r"lens: surfaces\.0: glass: unknown glass 'BK8'; use N-BK7"):
        prescription_from_dict(glassy)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("schema: tapetum/lens/2\n", "has schema 'tapetum/lens/2'; begin it with 'schema: tapetum/lens/1'"),
        ("[1, 2]", "holds no mapping"),
        ("{", "is no YAML"),
        ("schema: tapetum/lens/1\nname: a\nname: b\n", "key 'name' twice"),
    ],
)
def test_files_that_are_no_lens(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "other.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        load_lens(str(path))


def test_an_unknown_name_brings_the_nearest() -> None:
    with pytest.raises(InputError, match=r"phone-z: no such lens; did you mean phone-"):
        load_lens("phone-z")
    with pytest.raises(ValidationError, match=r"zoom-18-140: no such lens; did you mean zoom-18-140mm"):
        PrescriptionLens("zoom-18-140", focal_length=50e-3)


def test_a_prime_lens_is_scaled() -> None:
    own, half = PrescriptionLens("phone-f"), PrescriptionLens("phone-f", focal_length=2.0315e-3)
    ratio = half.focal_length / own.focal_length
    one, other = own.focused(640e-9, math.inf), half.focused(640e-9, math.inf)
    assert half.focal_length == 2.0315e-3
    assert torch.allclose(other.lens.z, ratio * one.lens.z, rtol=1e-12)
    assert other.focal_length == pytest.approx(ratio * one.focal_length, rel=1e-12)
    assert half.aperture_radius == pytest.approx(ratio * own.aperture_radius, rel=1e-9)
    assert other.image == pytest.approx(ratio * one.image, rel=1e-4)


@pytest.mark.parametrize(
    ("name", "focals"), [("zoom-18-140mm", (18.6, 27, 50, 85, 135)), ("zoom-5-15mm", (5.2, 7, 12))]
)
def test_a_zoom_runs_through_its_states(name: str, focals: tuple[float, ...]) -> None:
    images, f_numbers = [], []
    for focal in focals:
        lens = PrescriptionLens(name, focal_length=focal * 1e-3)
        focused = lens.focused(lens.design_wavelength, math.inf)
        assert focused.focal_length == pytest.approx(focal * 1e-3, rel=1e-9)
        f_numbers.append(lens.focal_length / (2 * lens.aperture_radius))
        images.append(focused.image)
        assert all(clearance(focused.lens, i, i + 1)[0] > -1e-4 for i in range(len(focused.lens) - 1))
    assert f_numbers == sorted(f_numbers)
    assert len(set(images)) == len(focals)


def test_a_zoom_keeps_to_its_range() -> None:
    with pytest.raises(
        ValidationError, match=r"zoom-18-140mm: a zoom needs a focal_length; give one of 18\.5\d? to 135"
    ):
        PrescriptionLens("zoom-18-140mm")
    for focal in (17e-3, 150e-3):
        with pytest.raises(ValidationError, match=r"focal_length 1(7|50) mm is beyond this zoom; give one of"):
            PrescriptionLens("zoom-18-140mm", focal_length=focal)
    states = copy.deepcopy(PLAIN)
    states["states"] = [{"name": "a"}, {"name": "b", "thickness": {1: 2.0}}]
    with pytest.raises(InputError, match="sort them by focal length"):
        from tapetum.bench.zoom import focal_range

        focal_range(prescription_from_dict(states), 587.56e-9)


def test_stopping_down() -> None:
    wide, closed = PrescriptionLens("phone-f"), PrescriptionLens("phone-f", f_number=4.0)
    assert closed.aperture_radius == pytest.approx(closed.focal_length / 8, rel=1e-6)
    assert pupil_height(closed.focused(587.56e-9, math.inf).lens) == pytest.approx(closed.aperture_radius)
    assert wide.aperture_radius > closed.aperture_radius
    with pytest.raises(ValidationError, match=r"f_number 1\.2 is wider than phone-f opens; give 2\.3 or more"):
        PrescriptionLens("phone-f", f_number=1.2)


def test_focusing_moves_the_sensor_and_keeps_it_for_other_light() -> None:
    lens = PrescriptionLens("phone-f")
    far, near = lens.focused(587.56e-9, math.inf), lens.focused(587.56e-9, 1.0)
    # x_i = f²/(x - f) to first order.
    moved = near.image - far.image
    assert moved == pytest.approx(lens.focal_length**2 / 1.0, rel=0.05)
    red = lens.focused(785e-9, math.inf)
    assert red.image == far.image
    assert red.focal_length > far.focal_length
    # Out of focus by what its glasses make of it.
    assert best_focus(red.lens, math.inf) - red.image > 5e-6
    assert PrescriptionLens("phone-f", design_wavelength=785e-9).focused(785e-9, math.inf).image > far.image


@pytest.mark.parametrize("name", ["cmount-12mm-f1.4", "zoom-5-15mm"])
def test_focusing_by_a_group_keeps_the_sensor(name: str, validated) -> None:
    lens = PrescriptionLens(name, focal_length=None if name.startswith("c") else 10e-3)
    first, last = load_lens(name).focus  # pyright: ignore[reportAssignmentType]
    far, near = lens.focused(587.56e-9, math.inf), lens.focused(587.56e-9, 0.5)
    assert near.image == far.image
    moved = near.lens.z - far.lens.z
    still = [i for i in range(len(moved)) if not first <= i <= last]
    assert moved[still].abs().max() == 0 and moved[first].abs() > 1e-5
    error = abs(best_focus(near.lens, 0.5) - near.image)
    validated("Lenses", f"Best focus of {name}, its group at 0.5 m", error, 1e-10, "its sensor", "m")
    other = PrescriptionLens(name, focal_length=lens.focal_length, focus="unit").focused(587.56e-9, 0.5)
    assert other.image > far.image


def test_a_group_moves_as_the_patent_has_it(validated) -> None:
    """Published travel of the focusing element to 1:40 and to 0.2 m in JP 2017-167327: 0.4598 and 1.6864 mm."""
    lens = PrescriptionLens("cmount-12mm-f1.4")
    far = lens.focused(587.56e-9, math.inf)
    # 111 mm before the first vertex: from there to the entrance pupil.
    near = lens.focused(587.56e-9, 111e-3 + far.entrance_pupil)
    travel = float(far.lens.z[22] - near.lens.z[22])
    validated(
        "Lenses", "Focusing travel of cmount-12mm-f1.4 to 0.2 m", abs(travel - 1.6864e-3), 3e-5, "its patent", "m"
    )


def test_a_group_that_would_collide_is_refused() -> None:
    lens = PrescriptionLens("cmount-12mm-f1.4")
    with pytest.raises(InputError, match=r"object_distance: the group of surfaces 22 to 23 would collide before .* m"):
        lens.focused(587.56e-9, 0.03)
    with pytest.raises(ValidationError, match="phone-a names no group that focuses; use 'focus: unit'"):
        PrescriptionLens("phone-a", focus="group")


def test_an_object_nearer_than_the_front_focus_is_refused() -> None:
    with pytest.raises(
        InputError, match=r"object_distance: an object 0\.003 m away has no image .*; focus farther away"
    ):
        PrescriptionLens("phone-a").focused(587.56e-9, 3e-3)


def test_wavelengths_without_an_index_are_refused() -> None:
    with pytest.raises(
        InputError, match="wavelength: 1550 nm is outside the range that n_d and the Abbe number describe"
    ):
        PrescriptionLens("phone-a").focused(1550e-9, math.inf)


def test_a_lens_that_lets_nothing_through_is_refused(tmp_path: Path) -> None:
    shut = copy.deepcopy(PLAIN)
    # Steep surfaces of high index: every ray but the axis's is reflected inside, or misses.
    shut["surfaces"] = [
        {"radius": -1.0, "thickness": 3, "index": 1.9, "semi_diameter": 0.9},
        {"radius": 1.0, "thickness": 1, "semi_diameter": 0.9},
        {"thickness": 36, "semi_diameter": 4, "stop": True},
    ]
    with pytest.raises(ValidationError, match=r"use a converging lens|has no image|no ray gets through"):
        PrescriptionLens(write(tmp_path, shut))


SCENE: dict[str, Any] = {
    "schema": "tapetum/scene/1",
    "distance": "5 m",
    "target": {"lens": {"kind": "prescription", "name": "phone-f"}, "object_distance": "1 m"},
    "probe": {"lens": {"focal_length": "200 mm", "aperture_radius": "25 mm"}},
}


def test_a_scene_with_a_prescription_survives_a_round_trip() -> None:
    scene = scene_from_dict(SCENE)
    assert isinstance(scene.target.lens, PrescriptionLens)
    assert scene.target.lens.focal_length == pytest.approx(4.0631e-3, rel=1e-3)
    assert scene_from_dict(scene_dict(scene)) == scene
    zoom = with_values(scene, {"target.lens.name": "zoom-18-140mm", "target.lens.focal_length": "85 mm"})
    assert scene_from_dict(scene_dict(zoom)) == zoom and zoom.target.lens.focal_length == 0.085
    # The first one's own focal length is not forced upon another lens.
    other = with_values(scene, {"target.lens.name": "phone-c"})
    assert other.target.lens.focal_length == PrescriptionLens("phone-c").focal_length
    with pytest.raises(InputError, match=r"scene: target\.lens.*: phone-g: no such lens; did you mean phone-"):
        with_values(scene, {"target.lens.name": "phone-g"})


def test_lenses_are_compared_and_kept_by_their_values() -> None:
    one, two = PrescriptionLens("phone-f"), PrescriptionLens("phone-f")
    assert one == two and hash(one) == hash(two)
    assert one.focused(640e-9, 1.0) is two.focused(640e-9, 1.0)
    adapter = TypeAdapter(PrescriptionLens)
    assert adapter.validate_json(adapter.dump_json(one)) == one
    assert one.glass is None


def test_moved_groups_stay_within_their_lens() -> None:
    lens = PrescriptionLens("zoom-18-140mm", focal_length=135e-3)
    near = lens.focused(587.56e-9, 1.0)
    assert clearance(near.lens, 25, 26)[0] > 0 and clearance(near.lens, 28, 29)[0] > 0
    assert paraxial(moved_group(near.lens, (26, 28), 0.0)).focal_length == pytest.approx(near.focal_length, rel=1e-9)


def test_the_example_of_the_documentation_is_a_lens(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "lenses.md").read_text(encoding="utf-8")
    start = page.index("    schema: tapetum/lens/1")
    block = page[start : page.index("\n\n", start)]
    path = tmp_path / "doublet.yaml"
    path.write_text("\n".join(line.removeprefix("    ") for line in block.splitlines()), encoding="utf-8")
    lens = PrescriptionLens(str(path))
    assert lens.focal_length == pytest.approx(0.1189, rel=1e-3)
    assert lens.focal_length / (2 * lens.aperture_radius) == pytest.approx(
        load_lens(str(path)).states[0].f_number, rel=0.02
    )
