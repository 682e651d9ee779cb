"""Files that are no scene, lens, phone or mapping, however they are made: one error, soon."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tapetum.bench import load_lens, load_phone, load_scene
from tapetum.data.importing import load_mapping
from tapetum.errors import InputError

LOADERS: dict[str, Callable[[str], Any]] = {
    "scene": load_scene,
    "lens": load_lens,
    "phone": load_phone,
    "import": load_mapping,
}
_TENFOLD = [f"a{i}: &a{i} [{','.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]
_MERGED = [f"a{i}: &a{i} {{<<: [{','.join([f'*a{i - 1}'] * 10)}]}}" for i in range(1, 12)]
HOSTILE = {
    "nested lists": ("a: " + "[" * 900 + "]" * 900, "nested too deeply"),
    "nested mappings": ("a: " + "{a: " * 900 + "1" + "}" * 900, "nested too deeply"),
    "fifty levels": ("a: " + "[" * 50 + "]" * 50, "more than 40 levels"),
    "aliases of aliases": ("\n".join(["a0: &a0 [1]", *_TENFOLD]), "with its aliases written out"),
    "merges of merges": ("\n".join(["a0: &a0 {x: 1}", *_MERGED]), "with its aliases written out"),
    "an alias of itself": ("a: &a [*a]", "an alias inside of what it stands for"),
    "a long number": ("a: " + "9" * 5000, "a number of 5000 characters"),
    "a long number, hexadecimal": ("a: 0x" + "f" * 5000, "a number of 5002 characters"),
    "no date": ("a: 2020-99-99", "month must be in"),
    "no number": ("a: !!int ''", "is no YAML"),
    "no truth": ("a: !!bool x", "is no YAML"),
    "no time": ("a: !!timestamp x", "is no YAML"),
    "an object": ("a: !!python/object/apply:os.getcwd []", "could not determine a constructor"),
    "a key that is a list": ("? [1, 2]\n: 3", "unhashable key"),
}


@pytest.mark.parametrize("kind", LOADERS)
@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_is_one_error(kind: str, name: str, tmp_path: Path) -> None:
    body, words = HOSTILE[name]
    path = tmp_path / "file.yaml"
    path.write_text(f"schema: tapetum/{kind}/1\n{body}\n", encoding="utf-8")
    with pytest.raises(InputError) as raised:
        LOADERS[kind](str(path))
    said = str(raised.value)
    assert words in said and "file.yaml" in said and "\n" not in said and len(said) < 400


@pytest.mark.parametrize("text", ["[" * 900, "9" * 5000, "2020-99-99", "&a [*a]", "!!int ''"])
def test_a_hostile_change_is_one_error(text: str) -> None:
    with pytest.raises(InputError, match=r"--set distance: .* is no value") as raised:
        load_scene("thin-lens", [f"distance={text}"])
    assert "\n" not in str(raised.value) and len(str(raised.value)) < 300


def test_aliases_that_are_meant_well_still_load(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(
        "schema: tapetum/scene/1\ndistance: &far 5 m\n"
        "illumination: {mode: collimated, wavelength: 640 nm, power: 1 mW}\n"
        "target:\n  lens: {kind: thin, focal_length: &f 100 mm, aperture_radius: 3 mm}\n"
        "  object_distance: *far\n  sensor: {reflectance: 0.1}\n"
        "probe:\n  lens: {kind: thin, focal_length: *f, aperture_radius: 25 mm}\n"
        "  sensor: {pixels: [256, 256], pitch: 2.2 um, bits: 8}\n",
        encoding="utf-8",
    )
    scene = load_scene(path)
    assert scene.target.object_distance == 5 and scene.probe.lens.focal_length == 0.1
