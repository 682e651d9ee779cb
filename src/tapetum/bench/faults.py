"""The bench's dataclasses from plain values; pydantic's findings as errors with field, value and remedy."""

from __future__ import annotations

import dataclasses
import difflib
import functools
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from tapetum.bench.plain_yaml import field_paths
from tapetum.errors import InputError

__all__ = ["adapter", "build", "first_fault", "refuse_truths"]

T = TypeVar("T")

_UNKNOWN = ("unexpected_keyword_argument", "extra_forbidden", "invalid_key")
# Fields after whose path pydantic inserts the kind, and those kinds.
_TAGS = {("target",): ("camera", "phone"), ("target", "lens"): ("thin", "prescription")}
_RANGE = "{given!r} is out of range"
_WHOLE = ("must be a whole number{shown}", "give it without a fraction or a unit")
_NUMBER = ("must be a number{shown}", "give it without a unit")
_PAIR = ("must be a list of two values{shown}", "write it in brackets, for example [1, 2]")
# Message and remedy by pydantic's error type.
_SAID = {
    "greater_than": (_RANGE, "give more than {gt:g}"),
    "greater_than_equal": (_RANGE, "give at least {ge:g}"),
    "less_than": (_RANGE, "give less than {lt:g}"),
    "less_than_equal": (_RANGE, "give at most {le:g}"),
    "union_tag_invalid": ("unknown value {tag!r}", "use {expected_tags}"),
    "literal_error": ("unknown value {given!r}", "use {expected}"),
    "dataclass_type": ("must be a mapping of fields{shown}", ""),
    "finite_number": ("must be finite{shown}", "give a finite number"),
    **dict.fromkeys(("tuple_type", "too_long"), _PAIR),
    **dict.fromkeys(("int_from_float", "int_type", "int_parsing"), _WHOLE),
    **dict.fromkeys(("float_type", "float_parsing"), _NUMBER),
}


@functools.cache
def adapter(kind: type[T]) -> TypeAdapter[T]:
    """Pydantic's adapter of a dataclass: validation, serialisation and schema."""
    return TypeAdapter(kind)


def build(kind: type[T], content: Mapping[str, Any], where: str, *, unit: float = 1.0) -> T:
    """Return a dataclass of nested plain values; `unit`, in metres, is that of a lens file's bare numbers.

    Raises an InputError that names `where`, the field's path, its value and the remedy.
    """
    try:
        built: T = adapter(kind).validate_python(dict(content), context={"unit": unit})
    except ValidationError as error:
        raise first_fault(error, where, field_paths(kind)) from error
    refuse_truths(content, built, where)
    return built


def refuse_truths(content: object, built: object, where: str, steps: tuple[str, ...] = ()) -> None:
    """Refuse true and false where what was built of them is a number: pydantic takes them for 1 and 0.

    Raises an InputError with the path of the first one.
    """
    if isinstance(content, bool):
        if isinstance(built, int | float) and not isinstance(built, bool):
            place = ": ".join(filter(None, (where, ".".join(steps))))
            raise InputError(f"must be a number, is {str(content).lower()}", where=place, remedy="give a number")
    elif isinstance(content, Mapping):
        for key, value in content.items():
            refuse_truths(value, getattr(built, str(key), None), where, (*steps, str(key)))
    elif isinstance(content, list | tuple) and isinstance(built, list | tuple):
        for number, (value, one) in enumerate(zip(content, built, strict=False)):
            refuse_truths(value, one, where, (*steps, str(number)))


def first_fault(error: ValidationError, where: str, paths: Sequence[tuple[str, ...]]) -> InputError:
    """Return the first of pydantic's findings, an unknown key before all others, as an InputError.

    `where` is the file or argument that the values came from, `paths` are all fields that an unknown key may mean.
    """
    found = error.errors(include_url=False)
    # A misspelt key also makes its field missing; report the key.
    first = next((one for one in found if one["type"] in _UNKNOWN), found[0])
    steps = _plain(first["loc"])
    kind, given, context = first["type"], first.get("input"), first.get("ctx", {})
    if kind in ("missing", "missing_argument") and steps and isinstance(steps[-1], int):
        # For a list that is too short, name the list, not the absent item.
        count = steps.pop()
        what, remedy = f"has {count} of the values it needs, is {given!r}", "give all of them in brackets"
    elif kind in ("missing", "missing_argument"):
        what, remedy = "is missing", f"add '{steps[-1]}: ...'"
    elif kind in _UNKNOWN:
        what, remedy = "unknown key", _nearest(steps, paths)
    else:
        what, remedy = _value_fault(kind, str(first["msg"]), given, context)
        if kind == "union_tag_invalid":
            steps.append("kind")
        elif kind == "dataclass_type" and tuple(steps) in _TAGS:
            remedy = f"give it a kind, {' or '.join(_TAGS[tuple(map(str, steps))])}, and the fields of that"
        elif kind == "dataclass_type":
            inner = sorted({path[len(steps)] for path in paths if len(path) > len(steps) and _at(path, steps)})
            remedy = f"give it the fields {', '.join(inner)}"
    return InputError(what, where=": ".join(filter(None, (where, ".".join(map(str, steps))))), remedy=remedy)


def _plain(steps: Sequence[int | str]) -> list[int | str]:
    """A path as written in the file, without the union kinds and validators that pydantic inserts."""
    found: list[int | str] = []
    tagged: int | None = None
    for step in steps:
        if str(step).startswith(("function-", "tuple[")):
            continue
        # The key after a kind may have the same name.
        if tagged != len(found) and step in _TAGS.get(tuple(map(str, found)), ()):
            tagged = len(found)
            continue
        found.append(step)
    return found


def _value_fault(kind: str, message: str, given: object, context: dict[str, Any]) -> tuple[str, str]:
    """Message and remedy for a value."""
    if kind == "value_error":
        what, _, remedy = message.removeprefix("Value error, ").partition("; ")
        return what, remedy or "correct it"
    shown = "" if isinstance(given, dict) or dataclasses.is_dataclass(given) else f", is {given!r}"
    if kind not in _SAID:
        return message.replace("Input should", "must").replace("must be a valid", "must be a") + shown, "correct it"
    what, remedy = (words.format(given=given, shown=shown, **context) for words in _SAID[kind])
    return what, remedy.replace(",", " or") if kind == "union_tag_invalid" else remedy


def _at(path: tuple[str, ...], steps: Sequence[object]) -> bool:
    return all(one == other for one, other in zip(path, steps, strict=False))


def _nearest(steps: Sequence[object], paths: Sequence[tuple[str, ...]]) -> str:
    """Guess which field an unknown key meant: its neighbours first, then the same word anywhere."""
    steps = [step for step in steps if not isinstance(step, int)]
    if not steps:
        return "remove it"
    if tuple(steps) in paths:
        whole = ".".join(map(str, steps[:-1]))
        return f"it belongs to another kind; give the whole {whole} of that kind"
    last = str(steps[-1])
    beside = [path for path in paths if len(path) == len(steps) and _at(path, steps[:-1])]
    near = difflib.get_close_matches(last, [path[-1] for path in beside], n=1)
    same = sorted((path for path in paths if path[-1] == last), key=len)
    found = [path for path in beside if path[-1] in near] or [path for path in same if len(path) == len(same[0])]
    if found:
        return f"did you mean {' or '.join('.'.join(path) for path in found)}?"
    return f"use {', '.join(sorted(path[-1] for path in beside))}" if beside else "remove it"
