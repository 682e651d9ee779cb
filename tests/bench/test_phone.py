"""Phones of the catalogue: distinct, buildable, and nobody's brand."""

from __future__ import annotations

import copy
import itertools
import math
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
import yaml

from tapetum.bench import at_wavelength, load_lens
from tapetum.bench.phone import Phone, load_phone, phone_names
from tapetum.errors import InputError

# By their names: loaded here, every process that collects would trace all their lenses.
PHONES = phone_names()


def test_eleven_phones_of_six_lenses() -> None:
    assert phone_names() == [f"phone-{k:02d}" for k in range(1, 12)]
    phones = [load_phone(name) for name in PHONES]
    assert len({camera.lens.name for phone in phones for camera in phone.cameras}) >= 6
    assert {len(phone.cameras) for phone in phones} == {1, 2, 3, 4}
    assert all(phone.name == name and phone.assumed for name, phone in zip(PHONES, phones, strict=True))


def test_each_differs_from_all_others() -> None:
    """In its cameras, not only in their places."""
    for one, other in itertools.combinations(map(load_phone, PHONES), 2):
        assert {(c.lens, c.sensor) for c in one.cameras} != {(c.lens, c.sensor) for c in other.cameras}
        assert [c.position for c in one.cameras] != [c.position for c in other.cameras] or len(one.cameras) == 1


@pytest.mark.parametrize("phone", PHONES)
def test_sizes_are_those_of_phones(phone: str) -> None:
    for camera in load_phone(phone).cameras:
        lens, sensor = camera.lens, camera.sensor
        f_number = lens.focal_length / (2 * lens.aperture_radius)
        assert 2e-3 < lens.focal_length < 9e-3 and 2.1 < f_number < 4.1
        # With its cover it fits into a phone's bump.
        assert lens.focused(587.56e-9, math.inf).image < 10.5e-3
        assert all(abs(place) < 20e-3 for place in camera.position)
        assert 0.6e-6 < sensor.pitch < 2e-6
        half_diagonal = math.hypot(*sensor.pixels) * sensor.pitch / 2
        field = load_lens(lens.name).states[0].half_field
        assert field is not None
        assert half_diagonal < 1.02 * lens.focal_length * math.tan(field)


@pytest.mark.parametrize("phone", PHONES)
def test_filters_cut_the_infrared_by_reflecting_it(phone: str) -> None:
    for camera in load_phone(phone).cameras:
        (layer,) = camera.sensor.layers
        reflected, passed = at_wavelength(layer.reflectance, 785e-9), at_wavelength(layer.transmittance or 0.0, 785e-9)
        assert 0.8 <= reflected <= 0.98 and 0 < passed <= 0.03
        # At 640 nm the sensor is seen.
        assert at_wavelength(layer.transmittance or 0.0, 640e-9) > 0.3
        assert 0.3e-3 < layer.depth < 1.0e-3 and layer.diffuse is not None
        # In focus the filter returns as if defocused by its reduced depth: a beam from f²/(2t/n), centimetres away.
        source = camera.lens.focal_length**2 / (2 * layer.depth / layer.index)
        assert 3e-3 < source < 0.1


def test_two_phones_project_dots() -> None:
    dots = [dots for name in PHONES if (dots := load_phone(name).dots) is not None]
    assert len(dots) == 2
    for one in dots:
        assert one.wavelength == pytest.approx(940e-9) and 1 / one.period == pytest.approx(60, rel=1e-3)
        assert one.pulse < one.period and one.columns == one.rows == 24


def test_no_brand_anywhere() -> None:
    brands = (
        "apple",
        "iphone",
        "samsung",
        "galaxy",
        "google",
        "huawei",
        "xiaomi",
        "sony",
        "oneplus",
        "motorola",
        "nokia",
        "oppo",
    )
    folder = resources.files("tapetum.bench") / "phones"
    for entry in folder.iterdir():
        text = entry.read_text(encoding="utf-8").lower()
        assert not [brand for brand in brands if brand in text]


def written(folder: Path, change: Any) -> str:
    text = (resources.files("tapetum.bench") / "phones" / "phone-06.yaml").read_text(encoding="utf-8")
    content = copy.deepcopy(yaml.safe_load(text))
    change(content)
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return str(path)


def test_a_phone_of_ones_own(tmp_path: Path) -> None:
    phone = load_phone(written(tmp_path, lambda content: content.update(name="mine")))
    assert isinstance(phone, Phone) and phone.cameras == load_phone("phone-06").cameras


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda c: c["cameras"][0]["lens"].update(name="phone-q"),
            r"cameras\.0\.lens: phone-q: no such lens; did you mean",
        ),
        (lambda c: c["cameras"][1].update(name="main"), r"share a name, main, main, tele; give each its own"),
        (
            lambda c: c["cameras"][1].update(position=[0, 0]) or c["cameras"][0].update(position=[0, 0.002]),
            r"4 mm apart",
        ),
        (
            lambda c: c["cameras"][0]["sensor"]["layers"][0].update(depth="3 mm"),
            r"cameras\.0: sensor\.layers\.0: a layer 0\.003 m before the sensor lies in the lens",
        ),
        (
            lambda c: c["dots"].update(pulse="20 ms"),
            r"dots: a pulse of 0\.02 s outlasts the period of 0\.016667 s; shorten it",
        ),
        (lambda c: c.update(cameres=1), r"cameres: unknown key; did you mean cameras\?"),
        (lambda c: c.update(cameras=[]), r"cameras"),
        (lambda c: c.update(schema="tapetum/scene/1"), r"begin it with 'schema: tapetum/phone/1'"),
    ],
)
def test_faults_of_a_phone_are_named(change: Any, message: str, tmp_path: Path) -> None:
    name = written(tmp_path, change)
    with pytest.raises(InputError, match=message) as caught:
        load_phone(name)
    assert str(caught.value).startswith(name) and "\n" not in str(caught.value)


def test_an_unknown_phone_brings_the_nearest() -> None:
    with pytest.raises(InputError, match=r"phone-21: no such phone; did you mean phone-"):
        load_phone("phone-21")
