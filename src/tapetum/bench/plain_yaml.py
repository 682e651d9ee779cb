"""YAML restricted to plain values and unique keys."""

from __future__ import annotations

import dataclasses
import functools
import typing
from collections.abc import Iterable
from typing import Any

import yaml

from tapetum.errors import InputError

__all__ = ["field_paths", "parse", "read_mapping"]

# Limits far above any valid file: values with aliases expanded, levels of nesting, digits of a number.
_MOST_VALUES, _DEEPEST, _MOST_DIGITS = 200_000, 40, 400


class _UniqueKeys(yaml.SafeLoader):
    """A YAML loader that refuses duplicate keys, of which PyYAML keeps only the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if key.value in seen:
                    raise yaml.MarkedYAMLError(problem=f"key {key.value!r} twice", problem_mark=key.start_mark)
                seen.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_scalar(self, node: yaml.ScalarNode | yaml.MappingNode) -> Any:
        # A number of ten thousand digits is slow to convert, and Python refuses to print it in an error.
        if node.tag in ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float") and len(node.value) > _MOST_DIGITS:
            what = f"a number of {len(node.value)} characters"
            raise yaml.MarkedYAMLError(problem=what, problem_mark=node.start_mark)
        return super().construct_scalar(node)


def parse(text: str, where: str, *, what: str | None = None, remedy: str = "mend the line it names") -> Any:
    """Return the plain values of a YAML text; `where`, `what` and `remedy` word the error.

    Raises an InputError for text that is no YAML, has a key twice, or would exhaust memory: unbounded nesting, or
    aliases of aliases. Without `what` the error states the parser's own.
    """
    loader = None
    try:
        loader = _UniqueKeys(text)
        node = loader.get_single_node()
        if node is None:
            return None
        if _written_out(node) > _MOST_VALUES:
            raise yaml.YAMLError(f"more than {_MOST_VALUES} values with its aliases written out")
        return loader.construct_document(node)
    except RecursionError:
        raise InputError(what or "is no YAML (nested too deeply)", where=where, remedy=remedy) from None
    # The parser does not catch errors of its own conversions of dates, numbers and tags.
    except (yaml.YAMLError, ValueError, ArithmeticError, LookupError, TypeError, AttributeError) as error:
        met = f"is no YAML ({str(error) or type(error).__name__})"
        raise InputError(what or met, where=where, remedy=remedy) from error
    finally:
        if loader is not None:
            loader.dispose()


def _written_out(node: yaml.Node) -> int:
    """Number of values of a document with every alias expanded."""
    sizes: dict[int, int] = {}
    within: set[int] = set()

    def size(one: yaml.Node) -> int:
        if id(one) in sizes:
            return sizes[id(one)]
        if id(one) in within:
            raise yaml.MarkedYAMLError(problem="an alias inside of what it stands for", problem_mark=one.start_mark)
        if len(within) > _DEEPEST:
            problem = f"more than {_DEEPEST} levels of nesting"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=one.start_mark)
        within.add(id(one))
        children: list[yaml.Node] = []
        if isinstance(one, yaml.MappingNode):
            children = [child for pair in one.value for child in pair]
        elif isinstance(one, yaml.SequenceNode):
            children = list(one.value)
        sizes[id(one)] = 1 + sum(size(child) for child in children)
        within.remove(id(one))
        return sizes[id(one)]

    return size(node)


def read_mapping(text: str, schema: str, where: str) -> dict[str, Any]:
    """Return the mapping in a YAML text of a given schema, without its `schema`.

    Raises an InputError for text that is no YAML, no mapping, or of another schema.
    """
    content = parse(text, where)
    if not isinstance(content, dict) or content.get("schema") != schema:
        found = f"has schema {content.get('schema')!r}" if isinstance(content, dict) else "holds no mapping"
        raise InputError(found, where=where, remedy=f"begin it with 'schema: {schema}'")
    return {key: value for key, value in content.items() if key != "schema"}


@functools.cache
def field_paths(kind: type, *, lists: bool = True) -> tuple[tuple[str, ...], ...]:
    """Paths of all fields of a dataclass and of nested ones, once each; by default with those of list items."""
    found: dict[tuple[str, ...], None] = {}
    hints = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        found[(field.name,)] = None
        for one in _inner(hints[field.name], lists):
            found |= {(field.name, *path): None for path in field_paths(one, lists=lists)}
    return tuple(found)


def _inner(hint: Any, lists: bool) -> Iterable[type]:
    if typing.get_origin(hint) is tuple and not lists:
        return
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        yield hint
    for one in typing.get_args(hint):
        yield from _inner(one, lists)
