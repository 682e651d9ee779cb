"""Scenes in and out of YAML, and one value of a scene changed by its name."""

from __future__ import annotations

import difflib
import functools
import json
import math
import os
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError

from tapetum.bench.faults import first_fault
from tapetum.bench.plain_yaml import field_paths, parse
from tapetum.bench.scene import SCHEMA, Scene
from tapetum.errors import InputError

__all__ = [
    "as_scene",
    "field_path",
    "load_scene",
    "scene_dict",
    "scene_from_dict",
    "scene_names",
    "scene_schema",
    "scene_yaml",
    "with_values",
]


@functools.cache
def _adapter() -> TypeAdapter[Scene]:
    return TypeAdapter(Scene)


def scene_names() -> list[str]:
    """Names of the scenes that come with the package."""
    folder = resources.files("tapetum.bench") / "scenes"
    return sorted(entry.name.removesuffix(".yaml") for entry in folder.iterdir() if entry.name.endswith(".yaml"))


def as_scene(scene: Scene | str | os.PathLike[str]) -> Scene:
    """Return a scene as it is, or load it by the name of a bundled one or from a YAML file.

    Raises
    ------
    InputError
        As `load_scene`.
    """
    return scene if isinstance(scene, Scene) else load_scene(scene)


def load_scene(source: str | os.PathLike[str], changes: Iterable[str] = ()) -> Scene:
    """Load a scene by the name of a bundled one or from a YAML file.

    Parameters
    ----------
    source
        `"thin-lens"`, or a path.
    changes
        Texts `key=value` as for `tapetum simulate --set`.

    Raises
    ------
    InputError
        Missing or unreadable file, unknown key, wrong unit or value: with the field's path and the remedy.
    """
    if not isinstance(source, str | os.PathLike):
        what = f"must be a name or a path, is {source!r:.60}"
        raise InputError(what, where="scene", remedy=f"give a YAML file, or one of {', '.join(scene_names())}")
    name = str(os.fspath(source))
    if name in scene_names():
        text = (resources.files("tapetum.bench") / "scenes" / f"{name}.yaml").read_text(encoding="utf-8")
    else:
        path = Path(name)
        if not path.is_file():
            remedy = f"give the path of a YAML file, or one of the bundled scenes: {', '.join(scene_names())}"
            raise InputError("no such scene", where=name, remedy=remedy)
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"cannot be read as text ({error})", where=name, remedy="give a YAML file") from error
    content = parse(text, name)
    if not isinstance(content, dict):
        raise InputError("holds no mapping", where=name, remedy=f"begin it with 'schema: {SCHEMA}'")
    if content.get("schema") != SCHEMA:
        what = f"has schema {content.get('schema')!r}"
        raise InputError(what, where=name, remedy=f"begin it with 'schema: {SCHEMA}'")
    scene = scene_from_dict(content, where=name)
    values = _parsed(changes)
    return with_values(scene, values, where=name) if values else scene


def scene_from_dict(content: Mapping[str, Any], where: str = "scene") -> Scene:
    """Build a scene from nested mappings, as read from YAML or a recording.

    Raises
    ------
    InputError
        Naming `where`, the field's path, its value and the remedy.
    """
    try:
        return _adapter().validate_python(dict(content))
    except ValidationError as error:
        raise first_fault(error, where, _paths(lists=True)) from error


def scene_dict(scene: Scene) -> dict[str, Any]:
    """Return the scene as nested plain values in SI units; `scene_from_dict` reads it back.

    Infinity becomes the text `Infinity`, for JSON has no number for it.
    """
    return json.loads(_adapter().dump_json(scene, exclude_none=True))


def scene_yaml(scene: Scene) -> str:
    """The scene as YAML text in SI units."""
    return yaml.safe_dump(scene_dict(scene), sort_keys=False)


def scene_schema() -> dict[str, Any]:
    """JSON Schema of a scene file, for editors; it ships as `scenes/scene.schema.json` beside the scenes."""
    schema = _adapter().json_schema()
    # In Python it has a default; a file must say it.
    required = ["schema", *schema["required"]]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "required": required}


def with_values(scene: Scene, values: Mapping[str, Any], where: str = "scene") -> Scene:
    """The scene with some of its values replaced and all of it checked again.

    Parameters
    ----------
    scene
        Stays as it is.
    values
        By field path, or the path's last words where they are unambiguous (`rotation`, `object_distance`). A single
        angle for `target.rotation` tilts about x, as the paper does.
    where
        What an error names as the scene's origin.

    Raises
    ------
    InputError
        For a key that names no field or several, and as `scene_from_dict`.
    """
    content = scene_dict(scene)
    for key, value in values.items():
        path = field_path(key)
        node: Any = content
        for step in path[:-1]:
            if isinstance(node, list):
                node = _item(node, step, key)
            else:
                node = node.setdefault(step, {})
            if not isinstance(node, dict | list):
                remedy = "change either the whole or its parts"
                raise InputError(f"is inside of a value that is changed to {node!r}", where=key, remedy=remedy)
        if isinstance(node, list):
            _item(node, path[-1], key)
            node[int(path[-1])] = value
            continue
        node[path[-1]] = _rotation(value) if path[-1] == "rotation" else value
    return scene_from_dict(content, where)


def field_path(key: str) -> tuple[str, ...]:
    """Resolve a key to the path of a scene's field: `object_distance` to ("target", "object_distance").

    Raises
    ------
    InputError
        For an unknown key (with the nearest ones) or an ambiguous one (with its candidates).
    """
    words = tuple(key.strip().split("."))
    if words in _paths():
        return words
    if any(word.isdigit() for word in words):
        return _indexed(key, words)
    found = [path for path in _paths() if path[-len(words) :] == words]
    if len(found) == 1:
        return found[0]
    if found:
        names = " or ".join(".".join(path) for path in found)
        raise InputError("names more than one field", where=key, remedy=f"say {names}")
    near = difflib.get_close_matches(words[-1], {path[-1] for path in _paths()}, n=3)
    # The nearest word's fields first.
    names = [".".join(p) for word in near for p in _paths() if p[-1] == word] or sorted({p[0] for p in _paths()})
    raise InputError("a scene has no such field", where=key, remedy="did you mean " + " or ".join(names) + "?")


def _item(items: list[Any], step: str, key: str) -> Any:
    if not step.isdigit() or int(step) >= len(items):
        remedy = f"count from 0 to {len(items) - 1}" if items else "give the whole list first"
        raise InputError(f"has {len(items)} entries, none is {step!r}", where=key, remedy=remedy)
    return items[int(step)]


def _indexed(key: str, words: tuple[str, ...]) -> tuple[str, ...]:
    """`layers.0.depth` to ("target", "sensor", "layers", "0", "depth")."""
    plain = tuple(word for word in words if not word.isdigit())
    found = [path for path in _paths(lists=True) if path[-len(plain) :] == plain]
    if len(found) != 1 or words[0].isdigit():
        raise InputError("a scene has no such field", where=key, remedy="write for example layers.0.depth")
    return (*found[0][: -len(plain)], *words)


@functools.cache
def _paths(lists: bool = False) -> tuple[tuple[str, ...], ...]:
    """Every field of a scene; with those of the members of its lists, too, where asked for."""

    # The kinds of target and of lens share some fields.
    return tuple(dict.fromkeys(field_paths(Scene, lists=lists)))


def _parsed(changes: Iterable[str]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for change in changes:
        key, sign, text = change.partition("=")
        if not sign or not key:
            raise InputError(f"{change!r} is no change", where="--set", remedy="write KEY=VALUE")
        short = text if len(text) < 80 else f"{text[:77]}..."
        remedy = "write it as in a scene file: 5, '75 mm', [1, 2]"
        values[key.strip()] = parse(text, f"--set {key}", what=f"{short!r} is no value", remedy=remedy)
    return values


def _rotation(value: object) -> object:
    """One angle is the paper's rotation, about x; numbers without a unit are in degrees."""
    angles = [_angle(one) for one in value] if isinstance(value, list | tuple) else _angle(value)
    return [0.0, angles] if isinstance(angles, float | str) else angles


def _angle(value: object) -> object:
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return value
    try:
        # Text too: YAML takes 1e-1, without a point, for text.
        return math.radians(float(value))
    except ValueError:
        return value
