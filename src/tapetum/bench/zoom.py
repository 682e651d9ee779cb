"""A prescription at a given focal length: scaled, or interpolated between states of a zoom."""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import replace

from tapetum.bench.lens_data import Prescription, Surface, build_lens, with_moves
from tapetum.errors import InputError

__all__ = ["focal_range", "surfaces_at"]

# Focal lengths are typed with few digits: a value this little beyond an end means the end.
_SLACK = 1e-3


@functools.lru_cache(maxsize=256)
def focal_range(prescription: Prescription, wavelength: float) -> tuple[float, ...]:
    """Return the paraxial focal length of every state, in metres, at a wavelength.

    Refuses a lens without a positive focal length, and states that are not in the order of theirs.
    """
    from tapetum.optics.paraxial import paraxial

    lenses = [build_lens(prescription.state(k), wavelength) for k in range(len(prescription.states))]
    found = tuple(paraxial(lens).focal_length for lens in lenses)
    if not all(math.isfinite(one) and one > 0 for one in found):
        shown = ", ".join(f"{one:.4g} m" for one in found)
        raise InputError(f"has the focal length {shown}", where=prescription.name, remedy="use a converging lens")
    if any(b <= a for a, b in itertools.pairwise(found)):
        shown = ", ".join(f"{one:.4g}" for one in found)
        raise InputError(f"has states of f = {shown} m", where=prescription.name, remedy="sort them by focal length")
    return found


@functools.lru_cache(maxsize=256)
def surfaces_at(
    prescription: Prescription, focal_length: float | None, wavelength: float
) -> tuple[tuple[Surface, ...], float]:
    """Return the surfaces for a focal length, and the factor on all of their lengths.

    A prime lens is scaled. In a zoom the gaps that move, and the stop's opening, are interpolated over the logarithm of
    the focal length by monotone cubics, so that no two groups meet between states. Refuses a zoom without a focal
    length, or one beyond its range.
    """
    own = focal_range(prescription, wavelength)
    if len(own) == 1:
        return prescription.state(0), 1.0 if focal_length is None else focal_length / own[0]
    spoken = f"{own[0] * 1e3:.4g} to {own[-1] * 1e3:.4g} mm"
    if focal_length is None:
        raise InputError("a zoom needs a focal_length", where=prescription.name, remedy=f"give one of {spoken}")
    if not own[0] * (1 - _SLACK) <= focal_length <= own[-1] * (1 + _SLACK):
        what = f"focal_length {focal_length * 1e3:.4g} mm is beyond this zoom"
        raise InputError(what, where=prescription.name, remedy=f"give one of {spoken}")
    import numpy as np
    import torch
    from scipy.interpolate import PchipInterpolator
    from scipy.optimize import brentq

    from tapetum.optics.paraxial import paraxial

    logs = [math.log(one) for one in own]
    states = [prescription.state(k) for k in range(len(own))]
    gaps, openings = (
        PchipInterpolator(logs, [[getattr(surface, length) for surface in state] for state in states])
        for length in ("thickness", "semi_diameter")
    )
    base = build_lens(states[0], wavelength)

    def miss(t: float) -> float:
        lens = replace(base, z=torch.from_numpy(np.cumsum([0.0, *gaps(t)[:-1]])))
        return math.log(paraxial(lens).focal_length) - wanted

    wanted = min(max(math.log(focal_length), logs[0]), logs[-1])
    # At the ends rounding may leave no sign change.
    ends = miss(logs[0]), miss(logs[-1])
    if ends[0] >= 0 or ends[1] <= 0:
        return states[0 if ends[0] >= 0 else -1], 1.0
    t = float(brentq(miss, logs[0], logs[-1], xtol=1e-14, rtol=1e-14))  # pyright: ignore[reportArgumentType]
    return with_moves(states[0], *(dict(enumerate(curve(t).tolist())) for curve in (gaps, openings))), 1.0
