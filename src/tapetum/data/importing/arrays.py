"""Arrays in files: what is in them, and slices of them, without ever running what a file holds.

NumPy's `.npy` and `.npz`, HDF5 (`.h5`, `.hdf5`, MATLAB's `.mat` from v7.3) and older `.mat`. Objects are refused: a
pickle is a program. So are HDF5 datasets that keep their values in other files.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError
from tapetum.files import told_when_full
from tapetum.record.source import existing

__all__ = ["ARRAY_SUFFIXES", "ArrayInfo", "Sliced", "list_arrays", "open_array", "read_array"]

ARRAY_SUFFIXES = (".npy", ".npz", ".h5", ".hdf5", ".hdf", ".mat")
_AGAIN = "copy it again"
_NUMBERS = "biuf"
_NPY_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class Sliced(Protocol):
    """What numpy's and HDF5's arrays have in common."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    @property
    def dtype(self) -> np.dtype[Any]: ...

    def __getitem__(self, key: Any) -> Any: ...


@dataclass(frozen=True)
class ArrayInfo:
    """An array in a file: its name there (empty in `.npy`), shape and type (`text` for strings)."""

    name: str
    shape: tuple[int, ...]
    dtype: str

    @property
    def text(self) -> str:
        """The array for a list that people read."""
        return f"{self.name or 'array'} {' x '.join(map(str, self.shape)) or 'one value'} {self.dtype}"


def _damaged(file: Path, error: Exception) -> InputError:
    told = " ".join(str(error).split()) or type(error).__name__
    return InputError(f"is truncated, damaged or of another kind ({told})", where=file, remedy=_AGAIN)


def _kind(file: Path) -> str:
    """Which reader a file needs, by its suffix and first bytes."""
    if not file.stat().st_size:
        raise InputError("is empty", where=file, remedy=_AGAIN)
    suffix = file.suffix.lower()
    if suffix == ".mat":
        # From v7.3 on a .mat is HDF5 behind 512 bytes of MATLAB's own.
        with file.open("rb") as stream:
            head = stream.read(520)
        return "hdf5" if head.startswith(b"MATLAB 7.3") or b"\x89HDF\r\n" in head else "mat"
    if suffix not in ARRAY_SUFFIXES:
        raise InputError(f"is no file of arrays ({suffix})", where=file, remedy=f"use {', '.join(ARRAY_SUFFIXES)}")
    return suffix[1:] if suffix in (".npy", ".npz") else "hdf5"


def _type(dtype: np.dtype[Any]) -> str:
    return "text" if dtype.kind in "US" else str(dtype)


def _npy_header(stream: Any, file: Path) -> tuple[tuple[int, ...], np.dtype[Any]]:
    version = np.lib.format.read_magic(stream)
    if version not in _NPY_HEADERS:
        raise InputError(f"has version {version} of the .npy format", where=file, remedy="save it with numpy.save")
    shape, _, dtype = _NPY_HEADERS[version](stream)
    return shape, dtype


def _npz_members(file: Path) -> list[ArrayInfo]:
    found = []
    with zipfile.ZipFile(file) as archive:
        for member in archive.infolist():
            if member.filename.endswith(".npy"):
                with archive.open(member) as stream:
                    shape, dtype = _npy_header(stream, file)
                found.append(ArrayInfo(member.filename.removesuffix(".npy"), shape, _type(dtype)))
    return found


def _hdf5_members(file: Path) -> list[ArrayInfo]:
    import h5py

    found: list[ArrayInfo] = []

    def visit(name: str, item: object) -> None:
        # MATLAB keeps what its cells point to under #refs#.
        if isinstance(item, h5py.Dataset) and not name.startswith("#"):
            text = h5py.check_string_dtype(item.dtype) is not None
            if text or item.dtype.kind in _NUMBERS:
                found.append(ArrayInfo(name, item.shape or (), "text" if text else str(item.dtype)))

    with h5py.File(file, "r") as opened:
        opened.visititems(visit)
    return found


def _mat_members(file: Path) -> list[ArrayInfo]:
    from scipy.io import whosmat

    kinds = {"double": "float64", "single": "float32", "logical": "bool", "char": "text", "cell": "text"}
    numbers = {f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)}
    return [
        ArrayInfo(name, tuple(shape), kinds.get(str(kind), str(kind)))
        for name, shape, kind in whosmat(file, appendmat=False)
        if kind in kinds or kind in numbers
    ]


def list_arrays(path: str | Path) -> list[ArrayInfo]:
    """List the arrays of numbers and text in a file, without reading them.

    Raises
    ------
    InputError
        When the file is missing, empty, truncated or damaged, or of an unknown kind.
    """
    file = existing(path)
    kind = _kind(file)
    try:
        if kind == "npy":
            array = np.load(file, mmap_mode="r", allow_pickle=False)
            return [ArrayInfo("", array.shape, _type(array.dtype))]
        return {"npz": _npz_members, "hdf5": _hdf5_members, "mat": _mat_members}[kind](file)
    except (InputError, MemoryError):
        raise
    except Exception as error:
        # The readers raise whatever their parsing trips over.
        raise _damaged(file, error) from error


def _chosen(file: Path, name: str | None) -> ArrayInfo:
    arrays = list_arrays(file)
    have = ", ".join(one.name for one in arrays)
    if name is None:
        if len(arrays) == 1:
            return arrays[0]
        what = f"holds {len(arrays)} arrays" if arrays else "holds no array of numbers"
        raise InputError(what, where=file, remedy=f"say which by 'array': {have}" if arrays else "give another file")
    found = next((one for one in arrays if one.name == name or (one.name == "" and len(arrays) == 1)), None)
    if found is None:
        raise InputError(f"holds no array {name!r}", where=file, remedy=f"it has {have}" if have else None)
    return found


@contextlib.contextmanager
def open_array(path: str | Path, name: str | None = None) -> Iterator[Sliced]:
    """Open one array of a file for slicing.

    A `.npy` is mapped into memory, a member of an `.npz` unpacked to a temporary file and mapped, HDF5 read slice by
    slice; an older `.mat` can only be read whole.

    Parameters
    ----------
    path
        The file.
    name
        Which array; None where there is only one.

    Raises
    ------
    InputError
        When there is no such array, it holds objects, or the file is damaged.
    """
    file = existing(path)
    info, kind = _chosen(file, name), _kind(file)
    with contextlib.ExitStack() as stack:
        try:
            if kind == "npy":
                array: Any = np.load(file, mmap_mode="r", allow_pickle=False)
            elif kind == "npz":
                array = _unpacked(file, info.name, Path(stack.enter_context(tempfile.TemporaryDirectory())))
            elif kind == "mat":
                from scipy.io import loadmat

                array = loadmat(file, appendmat=False, variable_names=[info.name])[info.name]
            else:
                array = stack.enter_context(_hdf5(file, info.name))
        except (InputError, MemoryError):
            raise
        except Exception as error:
            raise _damaged(file, error) from error
        yield array


@contextlib.contextmanager
def _hdf5(file: Path, name: str) -> Iterator[Any]:
    import h5py

    with h5py.File(file, "r") as opened:
        dataset = opened[name]
        assert isinstance(dataset, h5py.Dataset)  # `_hdf5_members` lists nothing else
        if dataset.is_virtual or dataset.external:
            raise InputError(f"{name} keeps its values in other files", where=file, remedy="save it in one file")
        yield dataset.asstr() if h5py.check_string_dtype(dataset.dtype) else dataset


def _unpacked(file: Path, name: str, folder: Path) -> NDArray[Any]:
    """Unpack a member of an `.npz`, which cannot be read at random, and map it."""
    part = folder / "array.npy"
    with (
        told_when_full(part),
        zipfile.ZipFile(file) as archive,
        archive.open(f"{name}.npy") as packed,
        part.open("wb") as stream,
    ):
        shutil.copyfileobj(packed, stream, 1 << 20)  # zipfile checks the sum at the end
    return np.load(part, mmap_mode="r", allow_pickle=False)


def read_array(path: str | Path, name: str | None = None) -> NDArray[Any]:
    """Read one array of a file whole: labels, not pictures. Text comes as str; see `open_array`."""
    with open_array(path, name) as array:
        try:
            values = np.asarray(array[...])
        except (OSError, ValueError, zlib.error) as error:
            raise _damaged(Path(path), error) from error
    if values.dtype.kind == "O":
        # A MATLAB cell of texts is an object array of arrays of one text each.
        values = np.array([str(np.ravel(one)[0]) if np.size(one) == 1 else str(one) for one in values.ravel()])
    elif values.dtype.kind == "S":
        values = np.char.decode(values, "utf-8")
    return values
