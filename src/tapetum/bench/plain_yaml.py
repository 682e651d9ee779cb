"""YAML as the bench's files use it: plain values, and no key twice."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterable
from typing import Any

import yaml

from tapetum.errors import InputError

__all__ = ["UniqueKeys", "field_paths", "read_mapping"]


class UniqueKeys(yaml.SafeLoader):
    """YAML that refuses a key given twice: the first one would be lost without a word."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if key.value in seen:
                    raise yaml.MarkedYAMLError(problem=f"key {key.value!r} twice", problem_mark=key.start_mark)
                seen.add(key.value)
        return super().construct_mapping(node, deep)


def read_mapping(text: str, schema: str, where: str) -> dict[str, Any]:
    """The mapping that a YAML text of a given schema holds, without its `schema`.

    Raises
    ------
    InputError
        For text that is no YAML, no mapping, or of another schema.
    """
    try:
        content = yaml.load(text, UniqueKeys)
    except (yaml.YAMLError, RecursionError) as error:
        raise InputError(f"is no YAML ({error})", where=where, remedy="mend the line it names") from error
    if not isinstance(content, dict) or content.get("schema") != schema:
        found = f"has schema {content.get('schema')!r}" if isinstance(content, dict) else "holds no mapping"
        raise InputError(found, where=where, remedy=f"begin it with 'schema: {schema}'")
    return {key: value for key, value in content.items() if key != "schema"}


def field_paths(kind: type, at: tuple[str, ...] = (), *, lists: bool = True) -> Iterable[tuple[str, ...]]:
    """Every field of a dataclass and of those inside it, those of lists' members too where asked for."""
    for field in dataclasses.fields(kind):
        here = (*at, field.name)
        yield here
        for one in _inner(typing.get_type_hints(kind)[field.name], lists):
            yield from field_paths(one, here, lists=lists)


def _inner(hint: Any, lists: bool) -> Iterable[type]:
    if typing.get_origin(hint) is tuple and not lists:
        return
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        yield hint
    for one in typing.get_args(hint):
        yield from _inner(one, lists)
