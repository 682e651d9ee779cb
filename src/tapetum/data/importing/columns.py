"""Columns of tables and arrays, one value per image, in the units of a dataset."""

from __future__ import annotations

import csv
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tapetum.bench.quantity import to_si
from tapetum.data.dataset import DEVICE
from tapetum.data.importing.arrays import AGAIN, ARRAY_SUFFIXES, read_array
from tapetum.data.importing.mapping import Column, LabelsEntry
from tapetum.errors import InputError
from tapetum.files import read_text
from tapetum.record.source import existing

__all__ = ["TABLE_SUFFIXES", "Reader", "held_out", "label_values", "numbers", "read_text_table", "seconds", "texts"]

TABLE_SUFFIXES = (".csv", ".tsv", ".txt")
_EMPTY = ("", "nan", "na", "n/a", "null", "none", "-")
_TEST = ("test", "testing", "val", "validation", "1", "true")
_TRAIN = ("train", "training", "0", "false")
Parsed = TypeVar("Parsed")


def read_text_table(path: str | Path) -> dict[str, list[str]]:
    """Read a table separated by comma, semicolon, tab or blank; return every column's cells as text.

    The first line names the columns, unless it holds only numbers: then they are called 0, 1, 2 … Raises an InputError
    when the file is missing, empty, no text, or its lines differ in their number of cells.
    """
    file = existing(path)
    text = read_text(file, "save it as CSV in UTF-8", "utf-8-sig")
    if "\0" in text:
        raise InputError("holds bytes that are no text", where=file, remedy=AGAIN)
    head = text.partition("\n")[0]
    between = next((one for one in ",;\t" if one in head), " " if " " in head.strip() else ",")
    try:
        reader = csv.reader(text.splitlines(), delimiter=between, skipinitialspace=True, strict=True)
        lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if any(map(str.strip, row))]
    except csv.Error as error:
        raise InputError(f"is no table ({error})", where=file, remedy=AGAIN) from error
    if not lines:
        raise InputError("is empty", where=file, remedy=AGAIN)
    first = lines[0][1]
    named = not all(_parsed(float, cell) is not None for cell in first)
    names = first if named else [str(n) for n in range(len(first))]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"has two columns {twice!r}", where=file, remedy="rename one of them")
    rows = lines[1:] if named else lines
    if not rows:
        raise InputError("has no rows below its names", where=file, remedy=AGAIN)
    for number, cells in rows:
        if len(cells) != len(names):
            raise InputError(f"line {number} has {len(cells)} cells, the first {len(names)}", where=file, remedy=AGAIN)
    return {name: [cells[n] for _, cells in rows] for n, name in enumerate(names)}


class Reader:
    """Reads the columns of a mapping with paths relative to `root`, each table once."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._tables: dict[Path, dict[str, list[str]]] = {}

    def place(self, column: Column, images: str | None) -> Path:
        """Return the file of a column."""
        if column.file is None and (images is None or Path(images).suffix.lower() not in ARRAY_SUFFIXES):
            raise InputError(f"no file is named for {_told(column)}", where="mapping", remedy="add 'file: ...'")
        return self.root / str(column.file or images)

    def values(self, column: Column, count: int | None, images: str | None = None) -> NDArray[Any]:
        """Return a column [N] of numbers or text, by default from the file of the `images`.

        Raises an InputError when the file or column is missing, or the number of values is not `count`.
        """
        if column.value is not None:
            return np.full(1 if count is None else count, column.value)
        file = self.place(column, images)
        if file.suffix.lower() in TABLE_SUFFIXES:
            values: NDArray[Any] = np.array(self._cells(file, column))
        else:
            values = _of_array(file, column, count)
        if count is not None and len(values) != count:
            what = f"{_told(column)} has {len(values)} values for {count} pictures"
            raise InputError(what, where=file, remedy="copy it again, or give the table of these pictures")
        return values

    def _cells(self, file: Path, column: Column) -> list[str]:
        if file not in self._tables:
            self._tables[file] = read_text_table(file)
        table = self._tables[file]
        name = column.column if column.column is not None else column.array
        if name is None and len(table) == 1:
            return next(iter(table.values()))
        if str(name) in table:
            return table[str(name)]
        if isinstance(name, int) and name < len(table):
            return list(table.values())[name]
        raise InputError(f"has no column {str(name)!r}", where=file, remedy=f"it has {', '.join(table)}")


def _told(column: Column) -> str:
    name = column.column if column.column is not None else column.array
    return "the column" if name is None else f"column {name}"


def _of_array(file: Path, column: Column, count: int | None) -> NDArray[Any]:
    array = read_array(file, column.array)
    shape = " x ".join(map(str, array.shape))
    if column.column is None or (array.ndim == 2 and 1 in array.shape and column.column == 0):
        array = np.squeeze(array) if array.size > 1 else array.ravel()
        if array.ndim != 1:
            what = f"{column.array or 'the array'} has the shape {shape}"
            raise InputError(what, where=file, remedy="say which column by its number, 'column: 0'")
        return array
    if array.ndim != 2 or not isinstance(column.column, int):
        what = f"{column.array or 'the array'} of shape {shape} has no column {column.column!r}"
        raise InputError(what, where=file, remedy="count columns from 0")
    # MATLAB's v7.3 files are transposed: the axis with as many values as images decides.
    rows = array if count is None or array.shape[0] == count or array.shape[1] != count else array.T
    if not 0 <= column.column < rows.shape[1]:
        raise InputError(f"has {rows.shape[1]} columns, none is {column.column}", where=file, remedy="count from 0")
    return rows[:, column.column]


def numbers(values: NDArray[Any], where: str) -> NDArray[np.float64]:
    """Return values as numbers; empty ones and words for missing become NaN."""
    if values.dtype.kind in "biuf":
        return values.astype(np.float64)
    found = [np.nan if text.strip().casefold() in _EMPTY else _parsed(float, text) for text in map(str, values)]
    if None in found:
        row = found.index(None)
        raise InputError(f"row {row} holds {str(values[row])!r}, no number", where=where, remedy="correct it")
    return np.array(found, np.float64)


def texts(values: NDArray[Any]) -> list[str]:
    """Return values as text; whole numbers without a decimal point."""
    if values.dtype.kind == "f":
        return [f"{value:g}" for value in values]
    return [str(value).strip() for value in values]


def seconds(values: NDArray[Any], column: Column, where: str) -> NDArray[np.float64]:
    """Return times in seconds: numbers in the column's unit, or dates in ISO 8601 as seconds since 1970."""
    dates = [_parsed(datetime.fromisoformat, str(value)) for value in values] if values.dtype.kind == "U" else []
    if dates and dates[0] is not None and column.unit is None:
        if None in dates:
            raise InputError(f"row {dates.index(None)} holds no date", where=where, remedy="write them in ISO 8601")
        known = [date if date.tzinfo else date.replace(tzinfo=UTC) for date in dates if date is not None]
        return np.array([date.timestamp() for date in known])
    times = numbers(values, where) * _factor(column.unit, "s", where)
    if not np.isfinite(times).all():
        raise InputError(f"row {int(np.argmin(np.isfinite(times)))} holds no time", where=where, remedy="correct it")
    return times


def _parsed(parse: Callable[[str], Parsed], text: str) -> Parsed | None:
    """Return the value of a text; None where it cannot be parsed."""
    try:
        return parse(text)
    except ValueError:
        return None


def _factor(unit: str | None, si: str, where: str) -> float:
    try:
        return to_si(f"1 {unit or si}", si)
    except ValueError as error:
        raise InputError(f"unit {unit!r} cannot be turned into {si}", where=where, remedy=f"use {si}") from error


def held_out(values: NDArray[Any], where: str) -> NDArray[np.bool_]:
    """Return which rows test, from a column of words or numbers; raise an InputError for any other value."""
    words = [word.casefold() for word in texts(values)]
    strange = next((word for word in words if word not in (*_TEST, *_TRAIN)), None)
    if strange is not None:
        raise InputError(f"{strange!r} is neither train nor test", where=where, remedy="use train and test, or 0 and 1")
    return np.isin(words, _TEST)


def label_values(labels: LabelsEntry, reader: Reader, count: int, images: str | None = None) -> dict[str, NDArray[Any]]:
    """Return labels by name, [count] values in a dataset's units; NaN where missing.

    Lengths are in metres, gaze in fractions of the field from its centre; devices are names, empty where missing.
    """
    found: dict[str, NDArray[Any]] = {}
    for name, column in labels.given().items():
        where = name if column.value is not None else f"{reader.place(column, images)}: {name}"
        given = reader.values(column, count, images)
        if name == DEVICE:
            found[name] = _device_names(given, column, where)
        elif name.startswith("gaze"):
            found[name] = _gaze(numbers(given, where), column, where)
        else:
            found[name] = _length(given, column, where)
    return found


def _device_names(values: NDArray[Any], column: Column, where: str) -> NDArray[Any]:
    if not column.names:
        return np.array(["" if name.casefold() in _EMPTY else name for name in texts(values)])
    given = numbers(values, where)
    whole = given[np.isfinite(given)]
    if len(whole) and (whole.min() < 0 or whole.max() >= len(column.names) or (whole % 1).any()):
        what = f"holds {whole.min():g} to {whole.max():g}, names are given for 0 to {len(column.names) - 1}"
        raise InputError(what, where=where, remedy="name every number, in order")
    return np.array([column.names[int(value)] if np.isfinite(value) else "" for value in given])


def _gaze(values: NDArray[np.float64], column: Column, where: str) -> NDArray[np.float64]:
    """Return gaze in fractions of the field from its centre; pixels count from the first pixel's centre."""
    unit = column.unit or "fraction"
    if unit not in ("fraction", "px"):
        raise InputError(f"unit {unit!r} is no unit of gaze", where=where, remedy="use fraction or px")
    if unit == "px":
        if column.size is None:
            raise InputError("pixels need the size of the target's frame", where=where, remedy="add 'size: 1936'")
        corner = (column.size - 1) / 2 if column.origin != "centre" else 0.0
        values = (values - corner) / column.size
    elif column.origin == "corner":
        values = values - 0.5
    values = -values if column.flip else values
    far = float(np.nanmax(np.abs(values), initial=0.0))
    if far > 0.75:
        what = f"lies up to {far:.3g} of the field from its centre, the picture's edge is at 0.5"
        raise InputError(what, where=where, remedy="correct unit, size or origin of this label in the mapping")
    return values


def _length(values: NDArray[Any], column: Column, where: str) -> NDArray[np.float64]:
    if isinstance(column.value, str):
        try:
            metres = np.full(len(values), to_si(column.value, "m"))
        except ValueError as error:
            raise InputError(str(error), where=where) from error
    else:
        metres = numbers(values, where) * _factor(column.unit, "m", where)
    if (metres <= 0).any():
        raise InputError(f"must be more than 0, is {np.nanmin(metres):g} m", where=where, remedy="correct it")
    return metres
