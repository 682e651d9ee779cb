"""Requirements on the frames that a sensor is calibrated with, and checks of the numbers that follow from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tapetum.calibrate.photon_transfer import PhotonTransfer
from tapetum.calibrate.verdict import Check

__all__ = ["percent", "sensor_checks"]

# Limits of the checks: requirements on the frames, not on the camera.
_LEVELS, _REACH, _UNEVEN, _FLICKER, _ROWS = 5, 0.3, 0.3, 0.01, 0.003
_SHARED, _STRAIGHT, _DEFECTS, _KEPT, _DARK, _TILT, _LINEAR = 0.03, 0.05, 0.01, 0.8, 0.15, 0.01, 0.01
_RESOLVED, _ZEROS = 0.7, 1e-3


def sensor_checks(one: PhotonTransfer, frames: int, kept: int, coloured: Sequence[str] = ()) -> list[Check]:
    """Return the checks of a sensor measured with so many `frames`, of which `kept` belong to a level.

    `coloured` are files whose colour was turned into grey.
    """
    flats, signal = one.flats, one.signal
    used = one.used > 0.5
    bright = used & (signal >= 0.05 * one.capacity)
    reach = float(signal[used].max()) / one.capacity if used.any() else 0.0
    uneven = [float(np.ptp(flats[n].mean - one.dark.mean) / signal[n]) for n in np.flatnonzero(bright)]
    flicker = [math.sqrt(max(flats[n].flicker, 0.0)) / float(signal[n]) for n in np.flatnonzero(bright)]
    in_rows = [flats[n].row_spread / float(signal[n]) for n in np.flatnonzero(bright)]
    shared = [max(np.abs(flats[n].neighbours)) for n in np.flatnonzero(bright)]
    repeated = sum(level.repeated for level, gone in zip(flats, one.saturated, strict=True) if not gone)
    noise = math.sqrt(max(one.dark.mean_of(one.dark.variance), 0.0))
    zeros = one.dark.mean_of(one.dark.zero)
    share = one.dark.mean_of(one.dark.mean) / (2**one.bits - 1)
    slope = float(np.ptp(one.dark.mean)) / one.capacity
    bend = one.curvature
    straight = abs(bend.value) <= max(_STRAIGHT, 3 * bend.error) or not math.isfinite(bend.value)
    checks = [
        Check(
            "levels for the line",
            f"{int(used.sum())} of {len(flats)}",
            f"{_LEVELS} or more, not saturated and with noise above {_RESOLVED:g} steps",
            int(used.sum()) >= _LEVELS,
            "take flat frames at more brightnesses between dark and saturation",
        ),
        Check(
            "range of the levels",
            f"up to {100 * reach:.0f} % of saturation",
            f"{100 * _REACH:.0f} % or more",
            reach >= _REACH,
            "add brighter levels that do not saturate yet",
        ),
        Check(
            "saturation",
            "reached" if one.full_well_is != "not reached" else "not reached: the full well is assumed",
            "one level that saturates",
            one.full_well_is != "not reached",
            f"add a level of twice the brightest one's light; if the camera has more than {one.bits} bits, give --bits",
        ),
        Check(
            "dark noise",
            f"{noise / one.step:.2f} steps of the converter",
            f"{_RESOLVED:g} or more, or the read noise measured all the same",
            one.read_noise_is == "measured",
            "use more gain or more bits, and a black level above the noise: rounding hides the read noise",
        ),
        Check(
            "dark frames at zero",
            f"{100 * zeros:.2g} % of the readings",
            f"{100 * _ZEROS:g} % or less",
            zeros <= _ZEROS,
            "raise the camera's black level (offset) until no dark pixel reads 0",
        ),
        Check(
            "dark level",
            f"{100 * share:.1f} % of the range",
            f"below {100 * _DARK:.0f} %",
            share < _DARK,
            "dark frames are not dark: put the cap on and darken the room",
        ),
        Check(
            "dark frames even",
            f"{100 * slope:.2f} % of the range from tile to tile",
            f"below {100 * _TILT:.0f} %",
            slope < _TILT,
            "light leaks into the dark frames, or the sensor glows: put the cap on and darken the room",
        ),
        Check(
            "evenness of the light",
            _worst(uneven),
            f"below {100 * _UNEVEN:.0f} %",
            not uneven or max(uneven) < _UNEVEN,
            "light the bare sensor through a diffuser from farther away",
        ),
        Check(
            "flicker between frames",
            _worst(flicker),
            f"below {100 * _FLICKER:.0f} %",
            not flicker or max(flicker) < _FLICKER,
            "use a lamp on direct current, and switch automatic exposure and gain off",
        ),
        Check(
            "flicker of rows",
            _worst(in_rows),
            f"below {100 * _ROWS:g} %",
            not in_rows or max(in_rows) < _ROWS,
            "the light pulsates at the mains' frequency: use a lamp on direct current",
        ),
        Check(
            "noise shared by neighbours",
            _worst(shared),
            f"below {100 * _SHARED:.0f} %",
            not shared or float(np.median(shared)) < _SHARED,
            "the frames were sharpened, smoothed, demosaiced or compressed: take raw, uncompressed ones",
        ),
        Check(
            "straightness of the variance",
            f"a square term adds {percent(bend.value, bend.error)}",
            f"within {100 * _STRAIGHT:.0f} %, or three errors",
            straight,
            "switch gamma and tone curves off, and keep the light and the gain fixed",
        ),
        Check(
            "frames in levels",
            f"{kept} of {frames}",
            f"{100 * _KEPT:.0f} % or more",
            kept >= _KEPT * frames,
            "keep the light still: frames during a change belong to no level",
        ),
        Check(
            "repeated frames",
            str(repeated),
            "0",
            not repeated,
            "the camera or a converter doubles frames: take each once",
        ),
        Check(
            "step of the numbers",
            str(one.step),
            "1",
            one.step == 1,
            "the low bits are empty: take right-aligned counts, or divide the frames by the step",
        ),
        Check(
            "defects",
            f"{100 * one.defects:.2g} % of the pixels",
            f"{100 * _DEFECTS:.0f} % or less",
            one.defects <= _DEFECTS,
            "many pixels stand out in the dark frames: look at them, and cool the camera",
        ),
    ]
    if len(one.linearity):
        worst = float(np.nanmax(np.abs(one.linearity)))
        good, remedy = worst <= _LINEAR, "switch gamma off, and check that exposure times and light are what they say"
        checks.append(Check("linearity", f"{100 * worst:.2f} %", f"within {100 * _LINEAR:.0f} %", good, remedy))
    if coloured:
        names = ", ".join(Path(name).name for name in coloured)
        remedy = "take grey or raw frames: luma mixes the noise of three channels"
        checks.append(Check("colour", f"{names} turned to grey", "none", False, remedy))
    return checks


def _worst(shares: Sequence[float]) -> str:
    return f"{100 * max(shares):.2f} %" if shares else "no bright level"


def percent(value: float, error: float) -> str:
    """Return a share with its error in percent, as text."""
    if not (math.isfinite(value) and math.isfinite(error)):
        return "not measured"
    return f"({100 * value:.3f} ± {100 * error:.3f}) %"
