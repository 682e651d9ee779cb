"""Arrays in files: their list, and slices of them, without executing anything.

NumPy's `.npy` and `.npz`, HDF5 (`.h5`, `.hdf5`, MATLAB's `.mat` from v7.3) and older `.mat`. Objects are refused,
because a pickle is a program, and so are HDF5 datasets that keep their values in other files.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError
from tapetum.files import told_when_full
from tapetum.record.source import existing

__all__ = ["AGAIN", "ARRAY_SUFFIXES", "ArrayInfo", "list_arrays", "open_array", "read_array"]

ARRAY_SUFFIXES = (".npy", ".npz", ".h5", ".hdf5", ".hdf", ".mat")
AGAIN = "copy or export it again"
_NPY_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
_MAT_TYPES = {"double": "float64", "single": "float32", "logical": "bool", "char": "text", "cell": "text"}
_MAT_TYPES |= {f"{sign}int{bits}": f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)}


@dataclass(frozen=True)
class ArrayInfo:
    """An array in a file: its name there (empty in `.npy`), shape and type (`text` for strings)."""

    name: str
    shape: tuple[int, ...]
    dtype: str

    def __str__(self) -> str:
        return f"{self.name or 'array'} {' x '.join(map(str, self.shape)) or 'one value'} {self.dtype}"


@contextlib.contextmanager
def _refused(file: Path) -> Iterator[None]:
    """Report any error of a reader as an InputError in one line."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:
        told = " ".join(str(error).split()) or type(error).__name__
        what = f"is truncated, damaged or of another kind ({told})"
        raise InputError(what, where=file, remedy=AGAIN) from error


def _kind(file: Path) -> str:
    """Return the reader that a file needs, by its suffix and first bytes."""
    if not file.stat().st_size:
        raise InputError("is empty", where=file, remedy=AGAIN)
    suffix = file.suffix.lower()
    if suffix == ".mat":
        # From v7.3 on a .mat is HDF5 after a header of 512 bytes.
        with file.open("rb") as stream:
            head = stream.read(520)
        return "hdf5" if head.startswith(b"MATLAB 7.3") or b"\x89HDF\r\n" in head else "mat"
    if suffix not in ARRAY_SUFFIXES:
        raise InputError(f"is no file of arrays ({suffix})", where=file, remedy=f"use {', '.join(ARRAY_SUFFIXES)}")
    return suffix[1:] if suffix in (".npy", ".npz") else "hdf5"


def _type(dtype: np.dtype[Any]) -> str:
    return "text" if dtype.kind in "US" else str(dtype)


def _npz_members(file: Path) -> Iterator[ArrayInfo]:
    with zipfile.ZipFile(file) as archive:
        for member in archive.namelist():
            if not member.endswith(".npy"):
                continue
            with archive.open(member) as stream:
                version = np.lib.format.read_magic(stream)
                if version not in _NPY_HEADERS:
                    what = f"has version {version} of the .npy format"
                    raise InputError(what, where=file, remedy="save it with numpy.save")
                shape, _, dtype = _NPY_HEADERS[version](stream)
            yield ArrayInfo(member.removesuffix(".npy"), shape, _type(dtype))


def _hdf5_members(file: Path) -> list[ArrayInfo]:
    import h5py

    found: list[ArrayInfo] = []

    def visit(name: str, item: object) -> None:
        # MATLAB keeps the content of cells under #refs#.
        if isinstance(item, h5py.Dataset) and not name.startswith("#"):
            text = h5py.check_string_dtype(item.dtype) is not None
            if text or item.dtype.kind in "biuf":
                found.append(ArrayInfo(name, item.shape or (), "text" if text else str(item.dtype)))

    with h5py.File(file, "r") as opened:
        opened.visititems(visit)
    return found


def list_arrays(path: str | Path) -> list[ArrayInfo]:
    """List the arrays of numbers and text in a file, without reading them.

    Raises an InputError when the file is missing, empty, truncated or damaged, or of an unknown kind.
    """
    file = existing(path)
    kind = _kind(file)
    with _refused(file):
        if kind == "npy":
            array = np.load(file, mmap_mode="r", allow_pickle=False)
            return [ArrayInfo("", array.shape, _type(array.dtype))]
        if kind == "mat":
            from scipy.io import whosmat

            found = whosmat(file, appendmat=False)
            return [ArrayInfo(name, tuple(shape), _MAT_TYPES[t]) for name, shape, t in found if t in _MAT_TYPES]
        return list(_npz_members(file) if kind == "npz" else _hdf5_members(file))


def _chosen(file: Path, name: str | None) -> str:
    """Return the name of the array called `name`, or of the only one in the file."""
    names = [one.name for one in list_arrays(file)]
    have = ", ".join(names)
    if name is None and len(names) != 1:
        what = f"holds {len(names)} arrays" if names else "holds no array of numbers"
        raise InputError(what, where=file, remedy=f"say which by 'array': {have}" if names else "give another file")
    if name is None or names == [""]:
        return names[0]
    if name not in names:
        raise InputError(f"holds no array {name!r}", where=file, remedy=f"it has {have}" if have else None)
    return name


@contextlib.contextmanager
def open_array(path: str | Path, name: str | None = None) -> Iterator[Any]:
    """Open one array of a file for slicing: it has `shape` and `dtype`, like arrays of NumPy and HDF5.

    A `.npy` is memory-mapped, a member of an `.npz` is unpacked to a temporary file and mapped, HDF5 is read slice by
    slice; an older `.mat` is read whole. The only array of a file needs no name. Raises an InputError when there is no
    such array, it holds objects, or the file is damaged.
    """
    file = existing(path)
    name, kind = _chosen(file, name), _kind(file)
    with contextlib.ExitStack() as stack:
        with _refused(file):
            if kind == "npy":
                array: Any = np.load(file, mmap_mode="r", allow_pickle=False)
            elif kind == "npz":
                array = _unpacked(file, name, Path(stack.enter_context(tempfile.TemporaryDirectory())))
            elif kind == "mat":
                from scipy.io import loadmat

                array = loadmat(file, appendmat=False, variable_names=[name])[name]
            else:
                import h5py

                array = stack.enter_context(h5py.File(file, "r"))[name]
                assert isinstance(array, h5py.Dataset)  # `_hdf5_members` lists nothing else
                if array.is_virtual or array.external:
                    raise InputError(
                        f"{name} keeps its values in other files", where=file, remedy="save it in one file"
                    )
                if h5py.check_string_dtype(array.dtype):
                    array = array.asstr()
        yield array


def _unpacked(file: Path, name: str, folder: Path) -> NDArray[Any]:
    """Unpack a member of an `.npz` to a folder and memory-map it."""
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
    """Read one array of a file whole, for labels; text comes as str. See `open_array`."""
    with open_array(path, name) as array, _refused(Path(path)):
        values = np.asarray(array[...])
    if values.dtype.kind == "O":
        # A MATLAB cell of texts is an object array of arrays of one text each.
        values = np.array([str(np.ravel(one)[0]) if np.size(one) == 1 else str(one) for one in values.ravel()])
    elif values.dtype.kind == "S":
        values = np.char.decode(values, "utf-8")
    return values
