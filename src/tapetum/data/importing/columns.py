"""One value for every picture, from a table or an array, in the units that a dataset keeps."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapetum.bench.quantity import to_si
from tapetum.data.dataset import DEVICE
from tapetum.data.importing.arrays import ARRAY_SUFFIXES, read_array
from tapetum.data.importing.fields import Column, Labels
from tapetum.data.importing.tables import TABLE_SUFFIXES, read_table
from tapetum.errors import InputError

__all__ = ["Reader", "held_out", "label_values", "numbers", "seconds", "texts"]

_EMPTY = ("", "nan", "na", "n/a", "null", "none", "-")
_TEST = ("test", "testing", "val", "validation", "1", "true")
_TRAIN = ("train", "training", "0", "false")


class Reader:
    """Reads the columns of a mapping, each table once.

    Parameters
    ----------
    root
        The folder that the mapping's paths start from.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._tables: dict[Path, dict[str, list[str]]] = {}

    def place(self, column: Column, images: str | None) -> Path:
        """The file that a column is in."""
        if column.file is None and (images is None or Path(images).suffix.lower() not in ARRAY_SUFFIXES):
            raise InputError(f"no file is named for {_told(column)}", where="mapping", remedy="add 'file: ...'")
        return self.root / str(column.file or images)

    def values(self, column: Column, count: int | None, images: str | None = None) -> NDArray[Any]:
        """Return a column as it stands, [N], numbers or text.

        Parameters
        ----------
        column
            What to read.
        count
            How many values there must be; None where anything goes.
        images
            The images' file, where the column may be in it.

        Raises
        ------
        InputError
            When the file or column is missing, or holds another number of values.
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
            self._tables[file] = read_table(file)
        table = self._tables[file]
        name = str(column.column if column.column is not None else column.array)
        if column.column is None and column.array is None and len(table) == 1:
            return next(iter(table.values()))
        if name not in table and isinstance(column.column, int) and column.column < len(table):
            return list(table.values())[column.column]
        if name not in table:
            raise InputError(f"has no column {name!r}", where=file, remedy=f"it has {', '.join(table)}")
        return table[name]


def _told(column: Column) -> str:
    name = column.column if column.column is not None else column.array
    return "the column" if name is None else f"column {name}"


def _of_array(file: Path, column: Column, count: int | None) -> NDArray[Any]:
    array = read_array(file, column.array)
    if column.column is None or (array.ndim == 2 and 1 in array.shape and column.column == 0):
        array = np.squeeze(array) if array.size > 1 else array.ravel()
        if array.ndim != 1:
            what = f"{column.array or 'the array'} has the shape {' x '.join(map(str, array.shape))}"
            raise InputError(what, where=file, remedy="say which column by its number, 'column: 0'")
        return array
    if array.ndim != 2 or not isinstance(column.column, int):
        what = f"{column.array or 'the array'} of shape {' x '.join(map(str, array.shape))}"
        raise InputError(f"{what} has no column {column.column!r}", where=file, remedy="count columns from 0")
    # MATLAB's v7.3 files show their arrays turned: values along the axis that is as long as there are pictures.
    rows = array if count is None or array.shape[0] == count or array.shape[1] != count else array.T
    if not 0 <= column.column < rows.shape[1]:
        raise InputError(f"has {rows.shape[1]} columns, none is {column.column}", where=file, remedy="count from 0")
    return rows[:, column.column]


def numbers(values: NDArray[Any], where: str) -> NDArray[np.float64]:
    """Return values as numbers; what is empty or says that there is none is NaN."""
    if values.dtype.kind in "biuf":
        return values.astype(np.float64)
    out = np.empty(len(values))
    for n, text in enumerate(values):
        try:
            out[n] = np.nan if str(text).strip().casefold() in _EMPTY else float(text)
        except ValueError as error:
            raise InputError(f"row {n} holds {str(text)!r}, no number", where=where, remedy="correct it") from error
    return out


def texts(values: NDArray[Any]) -> list[str]:
    """Return values as text; whole numbers without a point."""
    if values.dtype.kind == "f":
        return [f"{value:g}" for value in values]
    return [str(value).strip() for value in values]


def seconds(values: NDArray[Any], column: Column, where: str) -> NDArray[np.float64]:
    """Return times in seconds: numbers in the column's unit, or dates in ISO 8601 as seconds since 1970."""
    if values.dtype.kind == "U" and column.unit is None and len(values) and _date(str(values[0])) is not None:
        dates = [_date(str(value)) for value in values]
        if None in dates:
            raise InputError(f"row {dates.index(None)} holds no date", where=where, remedy="write them in ISO 8601")
        return np.array([date.timestamp() for date in dates if date is not None])
    times = numbers(values, where) * _factor(column.unit or "s", "s", where)
    if not np.isfinite(times).all():
        raise InputError(f"row {int(np.argmin(np.isfinite(times)))} holds no time", where=where, remedy="correct it")
    return times


def _date(text: str) -> datetime | None:
    try:
        date = datetime.fromisoformat(text)
    except ValueError:
        return None
    return date if date.tzinfo else date.replace(tzinfo=UTC)


def _factor(unit: str, si: str, where: str) -> float:
    try:
        return to_si(f"1 {unit}", si)
    except ValueError as error:
        raise InputError(f"unit {unit!r} cannot be turned into {si}", where=where, remedy=f"use {si}") from error


def held_out(values: NDArray[Any], where: str) -> NDArray[np.bool_]:
    """Return which rows test, from the words or numbers of a column.

    Raises
    ------
    InputError
        For any other word.
    """
    words = [word.casefold() for word in texts(values)]
    strange = next((word for word in words if word not in (*_TEST, *_TRAIN)), None)
    if strange is not None:
        raise InputError(f"{strange!r} is neither train nor test", where=where, remedy="use train and test, or 0 and 1")
    return np.array([word in _TEST for word in words])


def label_values(
    labels: Labels, reader: Reader, count: int, images: str | None = None
) -> tuple[dict[str, NDArray[np.float64]], list[str]]:
    """Read labels as a dataset keeps them.

    Returns
    -------
    values
        Name to [count] values in SI units, gaze in fractions of the field from its centre; NaN where there is none.
        A device is a number.
    classes
        Names of these numbers, sorted; empty without a device.
    """
    found: dict[str, NDArray[np.float64]] = {}
    classes: list[str] = []
    for name, column in labels.given().items():
        where = _where(reader, column, images, name)
        given = reader.values(column, count, images)
        if name == DEVICE:
            names = _device_names(given, column, where)
            classes = sorted({one for one in names if one})
            number = {one: float(n) for n, one in enumerate(classes)}
            found[name] = np.array([number.get(one, np.nan) for one in names])
        elif name.startswith("gaze"):
            found[name] = _gaze(numbers(given, where), column, where)
        else:
            found[name] = _length(given, column, where)
    return found, classes


def _where(reader: Reader, column: Column, images: str | None, name: str) -> str:
    return name if column.value is not None else f"{reader.place(column, images)}: {name}"


def _device_names(values: NDArray[Any], column: Column, where: str) -> list[str]:
    if not column.names:
        return ["" if name.casefold() in _EMPTY else name for name in texts(values)]
    given = numbers(values, where)
    whole = given[np.isfinite(given)]
    if len(whole) and (whole.min() < 0 or whole.max() >= len(column.names) or (whole % 1).any()):
        what = f"holds {whole.min():g} to {whole.max():g}, names are given for 0 to {len(column.names) - 1}"
        raise InputError(what, where=where, remedy="name every number, in order")
    return [column.names[int(value)] if np.isfinite(value) else "" for value in given]


def _gaze(values: NDArray[np.float64], column: Column, where: str) -> NDArray[np.float64]:
    """Gaze in fractions of the field from its centre; in pixels it counts from the first pixel's centre."""
    unit = column.unit or "fraction"
    if unit not in ("fraction", "px"):
        raise InputError(f"unit {unit!r} is none of gaze", where=where, remedy="use fraction or px")
    if unit == "px":
        if column.size is None:
            raise InputError("pixels need the size of the target's frame", where=where, remedy="add 'size: 1936'")
        if (column.origin or "corner") == "corner":
            values = values - (column.size - 1) / 2
        values = values / column.size
    elif column.origin == "corner":
        values = values - 0.5
    values = -values if column.flip else values
    far = float(np.nanmax(np.abs(values), initial=0.0))
    if far > 0.75:
        what = f"lies up to {far:.3g} of the field from its centre, the picture's edge is at 0.5"
        raise InputError(what, where=where, remedy="correct unit, size or origin of this label in the mapping")
    return values


def _length(values: NDArray[Any], column: Column, where: str) -> NDArray[np.float64]:
    if column.value is not None and isinstance(column.value, str):
        try:
            metres = np.full(len(values), to_si(column.value, "m"))
        except ValueError as error:
            raise InputError(str(error), where=where) from error
    else:
        metres = numbers(values, where) * _factor(column.unit or "m", "m", where)
    if (metres <= 0).any():
        raise InputError(f"must be more than 0, is {np.nanmin(metres):g} m", where=where, remedy="correct it")
    return metres
