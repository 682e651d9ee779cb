"""Read and write scenes as YAML, and change values of a scene by name."""

from __future__ import annotations

import difflib
import json
import math
import os
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import yaml

from tapetum.bench.catalogue import Catalogue
from tapetum.bench.faults import adapter, build
from tapetum.bench.measured import beam_values, sensor_values
from tapetum.bench.plain_yaml import field_paths, parse
from tapetum.bench.scene import SCHEMA, Scene
from tapetum.errors import InputError, of_type

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

_SCENES = Catalogue("scene", SCHEMA, "scenes", likeness=1.0)


def scene_names() -> list[str]:
    """Names of the scenes that come with the package."""
    return list(_SCENES.names)


def as_scene(scene: Scene | str | os.PathLike[str]) -> Scene:
    """Return a scene as it is, or as `load_scene` loads it."""
    return scene if isinstance(scene, Scene) else load_scene(scene)


def load_scene(source: str | os.PathLike[str], changes: Iterable[str] = ()) -> Scene:
    """Load a scene by the name of a bundled one or from a YAML file.

    Parameters
    ----------
    source, changes
        `"thin-lens"`, or a path; and texts `key=value` as for `tapetum simulate --set`.

    Raises
    ------
    InputError
        Missing or unreadable file, unknown key, wrong unit or value: with the field's path and the remedy.
    """
    if not isinstance(source, str | os.PathLike):
        what = f"must be a name or a path, is {source!r:.60}"
        raise InputError(what, where="scene", remedy=f"give a YAML file, or one of {', '.join(_SCENES.names)}")
    name = str(os.fspath(source))
    scene = scene_from_dict(_SCENES.read(name), where=name)
    values = _parsed(changes)
    return with_values(scene, values, where=name) if values else scene


def scene_from_dict(content: Mapping[str, Any], where: str = "scene") -> Scene:
    """Build a scene from nested mappings, as read from YAML or a recording.

    Raises
    ------
    InputError
        Naming `where`, the field's path, its value and the remedy.
    """
    return build(Scene, content, where)


def scene_dict(scene: Scene) -> dict[str, Any]:
    """Return the scene as nested plain values in SI units; `scene_from_dict` reads it back.

    Infinity becomes the text `Infinity`, because JSON has no number for it.
    """
    return json.loads(adapter(Scene).dump_json(scene, exclude_none=True))


def scene_yaml(scene: Scene) -> str:
    """The scene as YAML text in SI units."""
    return yaml.safe_dump(scene_dict(scene), sort_keys=False)


def scene_schema() -> dict[str, Any]:
    """JSON Schema of a scene file, for editors; it ships as `scenes/scene.schema.json` beside the scenes."""
    schema = adapter(Scene).json_schema()
    # In Python it has a default; a file must say it.
    required = ["schema", *schema["required"]]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "required": required}


def with_values(scene: Scene, values: Mapping[str, Any], where: str = "scene") -> Scene:
    """Return the scene with some of its values replaced, checked again as a whole.

    Parameters
    ----------
    scene, where
        The scene, which is not changed, and the origin that an error names.
    values
        By field path, or the path's last words where they are unambiguous (`rotation`, `object_distance`). A single
        angle for `target.rotation` tilts about x, as the paper does; its numbers without a unit are degrees.

    Raises
    ------
    InputError
        For a key that names no field or several, and as `scene_from_dict`.
    """
    content = scene_dict(scene)
    for key, value in values.items():
        *above, last = field_path(key)
        node: Any = content
        for step in above:
            node = _item(node, step, key) if isinstance(node, list) else node.setdefault(step, {})
            if not isinstance(node, dict | list):
                remedy = "change either the whole or its parts"
                raise InputError(f"is inside of a value that is changed to {node!r}", where=key, remedy=remedy)
        if isinstance(node, list):
            _item(node, last, key)
            node[int(last)] = value
        else:
            # Of a file its values are taken now, so that further changes can name them.
            known = _FROM_FILES.get((*above, last), _rotation if last == "rotation" else _same)
            node[last] = known(value)
    return scene_from_dict(content, where)


def field_path(key: str) -> tuple[str, ...]:
    """Resolve a key to the path of a scene's field: `object_distance` to ("target", "object_distance").

    Raises an InputError for an unknown key (with the nearest ones) or an ambiguous one (with its candidates).
    """
    words, paths = tuple(key.strip().split(".")), field_paths(Scene, lists=False)
    if words in paths:
        return words
    if any(word.isdigit() for word in words):
        return _indexed(key, words)
    found = [path for path in paths if path[-len(words) :] == words]
    if len(found) == 1:
        return found[0]
    if found:
        names = " or ".join(".".join(path) for path in found)
        raise InputError("names more than one field", where=key, remedy=f"say {names}")
    near = difflib.get_close_matches(words[-1], {path[-1] for path in paths}, n=3)
    # The nearest word's fields first.
    names = [".".join(p) for word in near for p in paths if p[-1] == word] or sorted({p[0] for p in paths})
    raise InputError("a scene has no such field", where=key, remedy="did you mean " + " or ".join(names) + "?")


def _item(items: list[Any], step: str, key: str) -> Any:
    if not step.isdigit() or int(step) >= len(items):
        remedy = f"count from 0 to {len(items) - 1}" if items else "give the whole list first"
        raise InputError(f"has {len(items)} entries, none is {step!r}", where=key, remedy=remedy)
    return items[int(step)]


def _indexed(key: str, words: tuple[str, ...]) -> tuple[str, ...]:
    """`layers.0.depth` to ("target", "sensor", "layers", "0", "depth")."""
    plain = tuple(word for word in words if not word.isdigit())
    found = [path for path in field_paths(Scene) if path[-len(plain) :] == plain]
    if len(found) != 1 or words[0].isdigit():
        raise InputError("a scene has no such field", where=key, remedy="write for example layers.0.depth")
    return (*found[0][: -len(plain)], *words)


def _parsed(changes: Iterable[str]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    if isinstance(changes, str) or not isinstance(changes, Iterable):
        raise InputError(f"is no list: {changes!r:.40}", where="changes", remedy='give a list of texts, ["distance=3"]')
    for change in changes:
        of_type(change, str, "changes", "give texts, KEY=VALUE")
        key, sign, text = change.partition("=")
        if not sign or not key:
            raise InputError(f"{change!r} is no change", where="--set", remedy="write KEY=VALUE")
        short = text if len(text) < 80 else f"{text[:77]}..."
        remedy = "write it as in a scene file: 5, '75 mm', [1, 2]"
        values[key.strip()] = parse(text, f"--set {key}", what=f"{short!r} is no value", remedy=remedy)
    return values


def _same(value: object) -> object:
    return value


_FROM_FILES: dict[tuple[str, ...], Callable[[object], object]] = {
    ("probe", "sensor"): sensor_values,
    ("illumination", "second_beam"): beam_values,
}


def _rotation(value: object) -> object:
    if isinstance(value, set | frozenset):
        remedy = "give a list: about y, then about x"
        raise InputError(f"is without order: {value!r:.40}", where="rotation", remedy=remedy)
    # An array without dimensions is a number, though of an iterable type.
    single = isinstance(value, str | bytes | Mapping) or getattr(value, "ndim", 1) == 0
    angles = _angle(value) if single or not isinstance(value, Iterable) else [_angle(one) for one in value]
    return [0.0, angles] if isinstance(angles, float | str) else angles


def _angle(value: object) -> object:
    """Degrees in radians, from text too: YAML reads 1e-1, without a point, as text."""
    try:
        return value if isinstance(value, bool) else math.radians(float(value))  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError):
        return value
