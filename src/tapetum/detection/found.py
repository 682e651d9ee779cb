"""What was found in a frame or a pair: a row a candidate, the likeliest camera first."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

__all__ = ["Found"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Found:
    """Candidates, the likeliest camera first; all arrays have the shape [N].

    Parameters
    ----------
    x, y
        Centroid in the lit frame, in pixels, sub-pixel: (0, 0) at the centre of the first pixel, x right, y down.
    probability
        That it is a camera or another optic that looks at the probe.
    false_alarms
        How many candidates that are none score as high, expected in a frame.
    snr
        Height over the spread of the surroundings and, in a pair, over what the registration may have left.
    flux
        Light above the surroundings within the spot, in grey levels times pixels.
    diameter
        Full width of the best-fitting Gaussian's 1/e² level, 4 sigma, in pixels.
    elongation
        Ratio of the long to the short axis.
    peak
        Highest level of the lit frame within a pixel of the place.
    saturated
        Whether that is full scale: the true flux is then larger.
    swapped
        Whether what is bright in the dark frame alone looks far more like cameras: the two may be swapped.
    """

    x: Array
    y: Array
    probability: Array
    false_alarms: Array
    snr: Array
    flux: Array
    diameter: Array
    elongation: Array
    peak: Array
    saturated: NDArray[np.bool_]
    swapped: bool = False

    def __len__(self) -> int:
        return len(self.x)

    def __getitem__(self, chosen: int | slice | NDArray[np.generic]) -> Found:
        """The candidates that a number, slice, mask or array of numbers picks; iteration yields them one by one."""
        picked = {name: np.atleast_1d(getattr(self, name)[chosen]) for name in self.columns()}
        return Found(**picked, swapped=self.swapped)

    @classmethod
    def columns(cls) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(field.name for field in fields(cls) if field.name != "swapped")

    def to_table(self) -> pa.Table:
        """As an Arrow table, a row a candidate."""
        return pa.table({name: pa.array(getattr(self, name)) for name in self.columns()})
