"""The spots of one frame: a small table that every step of tracking takes and returns."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from tapetum.errors import InputError
from tapetum.files import atomic_file

__all__ = ["Detections"]

_OTHERS = {"area": np.int64, "saturated": np.int64, "edge": np.bool_, "ghost": np.bool_}


@dataclass(frozen=True, eq=False)
class Detections:
    """Spots found in one frame, brightest first; all arrays have the shape [N].

    Parameters
    ----------
    x, y
        Centroid of the light above the background, as ISO 11146-1 defines a beam's position: pixels, (0, 0) at the
        centre of the first pixel, x right, y down.
    peak_x, peak_y
        Brightest point of the smoothed frame within the spot (`tapetum.data.crop.find_centre`), pixels: where the paper
        centres its crops. With fringes or two lobes it may be far from the centroid.
    snr
        Height of the smoothed spot over the noise of the smoothed background, the better of two scales.
    peak
        Height of the slightly smoothed spot (1.5 px) above the background, in the frame's own units.
    diameter
        From the second moments, ``2 sqrt(2) (var_x + var_y)^(1/2)``, pixels: four standard deviations of a round spot
        (D4 sigma of ISO 11146-1).
    area
        Pixels significantly above the background, within the spot.
    saturated
        Pixels of the spot at full scale.
    edge
        True where the spot touches the frame's edge, so that part of it may lie outside.
    ghost
        True where the spot looks like a reflection that accompanies a brighter one (see `tapetum.track.detector`).
    evidence
        How much the spot counts towards the number of its track (see `Tracker`): from 0, where it only continues one,
        to 1, which it is where the column is missing.
    motion
        [2, 3] matrix that takes places of the frame before to this one's, ``A @ (x, y, 1)``, where the detector knows
        how the picture moved between the two; no column.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    peak_x: NDArray[np.float64]
    peak_y: NDArray[np.float64]
    snr: NDArray[np.float64]
    peak: NDArray[np.float64]
    diameter: NDArray[np.float64]
    area: NDArray[np.int64]
    saturated: NDArray[np.int64]
    edge: NDArray[np.bool_]
    ghost: NDArray[np.bool_]
    evidence: NDArray[np.float64]
    motion: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        count = len(np.atleast_1d(self.x))
        for name, kind in self.types().items():
            array = np.asarray(getattr(self, name), dtype=kind)
            if array.ndim != 1 or len(array) != count:
                what = f"has the shape {array.shape}, x has {np.shape(self.x)}"
                raise InputError(what, where=f"Detections.{name}", remedy="give one value a spot")
            if kind is np.float64 and not np.isfinite(array).all():
                raise InputError("holds a value that is not finite", where=f"Detections.{name}")
            object.__setattr__(self, name, array)
        if wrong := [one for one in self.evidence.tolist() if not 0 <= one <= 1]:
            raise InputError(f"must be from 0 to 1, is {wrong[0]:g}", where="Detections.evidence")
        if self.motion is not None and (self.motion.shape != (2, 3) or not np.isfinite(self.motion).all()):
            raise InputError("must be a finite matrix of 2 x 3", where="Detections.motion")

    @classmethod
    def empty(cls, motion: NDArray[np.float64] | None = None) -> Detections:
        """Return a table without spots."""
        return cls.of(dict.fromkeys(cls.names(), np.empty(0)), motion)

    @classmethod
    def of(cls, columns: Mapping[str, Any], motion: NDArray[np.float64] | None = None) -> Detections:
        """Return the spots of columns by name: arrays or lists, [N] each; `evidence` may be missing."""
        given = {"evidence": np.ones(np.shape(columns["x"])), **columns}
        return cls(**{name: np.asarray(given[name]) for name in cls.names()}, motion=motion)

    @classmethod
    @cache
    def names(cls) -> tuple[str, ...]:
        """Return the names of the columns."""
        return tuple(field.name for field in fields(cls) if field.name != "motion")

    @classmethod
    def types(cls) -> dict[str, type[np.generic]]:
        """Return the type of each column, by name."""
        return {name: _OTHERS.get(name, np.float64) for name in cls.names()}

    def __len__(self) -> int:
        return len(self.x)

    def __getitem__(self, index: int | slice | NDArray[np.generic] | list[int]) -> Detections:
        """Return the spots that a number, slice, mask or list of numbers picks, in that order."""
        chosen = slice(index, index + 1 or None) if isinstance(index, (int, np.integer)) else index
        if isinstance(index, (int, np.integer)) and not -len(self) <= index < len(self):
            raise IndexError(f"spot {index} of {len(self)}")
        return self.of({name: getattr(self, name)[chosen] for name in self.names()}, self.motion)

    def __iter__(self) -> Iterator[Detections]:
        return (self[n] for n in range(len(self)))

    @property
    def without_ghosts(self) -> Detections:
        """The spots that are not ghosts."""
        return self[~self.ghost]

    def to_table(self) -> pa.Table:
        """Return the spots as an Arrow table, a row a spot."""
        return pa.table({name: pa.array(getattr(self, name)) for name in self.names()})

    @classmethod
    def from_table(cls, table: pa.Table) -> Detections:
        """The spots of an Arrow table; other columns are ignored.

        Raises
        ------
        InputError
            When a column is missing or holds a null.
        """
        # Tables of older versions lack `evidence`.
        names = [name for name in cls.names() if name != "evidence" or name in table.column_names]
        if missing := [name for name in names if name not in table.column_names]:
            remedy = "give a table that Tapetum wrote"
            raise InputError(f"no column {', '.join(missing)}", where="detections", remedy=remedy)
        for name in names:
            if table[name].null_count:
                raise InputError("holds an empty cell", where=f"detections, column {name}")
        return cls.of({name: table[name].to_numpy(zero_copy_only=False) for name in names})

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the spots to a Parquet file."""
        with atomic_file(path) as part:
            pq.write_table(self.to_table(), part)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Detections:
        """Read a file that `save` wrote.

        Raises
        ------
        InputError
            When the file is missing, damaged or not a table of detections.
        """
        if not Path(path).is_file():
            raise InputError("no such file", where=path, remedy="give a file that Detections.save wrote")
        try:
            table = pq.read_table(path)
        except (pa.ArrowException, OSError) as error:
            raise InputError("is not a readable Parquet file", where=path, remedy="write it again") from error
        return cls.from_table(table)
