"""Calibration of the probe's sensor: frames in, numbers, checks, a scene's sensor and a page out."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tapetum.bench.measured import SENSOR_SCHEMA
from tapetum.calibrate.levels import Level, gather, parts_of
from tapetum.calibrate.page import write_calibration
from tapetum.calibrate.photon_transfer import PhotonTransfer, good_pixels, photon_transfer
from tapetum.calibrate.verdict import Check, verdict
from tapetum.errors import InputError
from tapetum.files import atomic_file
from tapetum.progress import Progress, quiet
from tapetum.record.frames import open_frames
from tapetum.record.images import ImageSource, read_image
from tapetum.record.source import Frame, Source
from tapetum.report.figures._style import MODELS, QUIET, dress, legend, new_figure

__all__ = ["SensorCalibration", "calibrate_sensor"]

# Limits of the checks: what is asked of the frames, not of the camera.
_LEVELS, _REACH, _UNEVEN, _FLICKER, _ROWS = 5, 0.3, 0.3, 0.01, 0.003
_SHARED, _STRAIGHT, _DEFECTS, _KEPT, _DARK, _TILT, _LINEAR = 0.03, 0.05, 0.01, 0.8, 0.15, 0.01, 0.01
_RESOLVED, _ZEROS = 0.7, 1e-3


@dataclass(frozen=True, eq=False)
class SensorCalibration:
    """A calibrated sensor.

    Attributes
    ----------
    measured
        The numbers.
    frames, kept
        How many frames were read, and how many belong to a level.
    coloured
        Files whose colour was turned into grey.
    """

    measured: PhotonTransfer
    frames: int
    kept: int
    coloured: tuple[str, ...] = ()

    def checks(self) -> list[Check]:
        """Return what was checked."""
        return _checks(self)

    @property
    def verdict(self) -> str:
        """`good`, or what to mend."""
        return verdict(self.checks())

    def numbers(self) -> list[tuple[str, str]]:
        """Return what was measured, with standard uncertainties, as text."""
        one = self.measured
        well = {"clipped": "where the pixels clip", "converter": "where the converter clips: the pixels hold more"}
        below = "below " if one.read_noise_is == "hidden" else ""
        noise = f"below {one.read_noise.value:.3g} e⁻" if below else f"{one.read_noise} e⁻"
        linearity = "not measured: no exposure times" if not len(one.linearity) else f"{100 * self._bent():.2f} %"
        current = "not measured: needs dark frames of three exposures"
        return [
            ("gain", f"{one.gain} DN/e⁻"),
            ("read noise", noise),
            ("full well", f"{one.full_well} e⁻, {well.get(one.full_well_is, 'assumed: no level saturates')}"),
            ("offset", f"{one.offset} DN"),
            ("pattern of the offsets (DSNU)", f"{one.pattern} e⁻"),
            ("pattern of the sensitivity (PRNU)", f"{_percent(one.sensitivity.value, one.sensitivity.error)}"),
            ("linearity: largest deviation", linearity),
            ("dark current", f"{one.dark_current} e⁻/s" if one.dark_current is not None else current),
            ("dynamic range", _decibel(one)),
            ("bits", f"{one.bits}"),
            ("defects left out", f"{100 * one.defects:.3f} % of the pixels"),
            ("frames", f"{self.frames} in {len(one.darks)} dark and {len(one.flats)} flat levels"),
        ]

    def _bent(self) -> float:
        return float(np.nanmax(np.abs(self.measured.linearity)))

    def scene_values(self, pitch: str | None = None) -> dict[str, Any]:
        """Return the values that a scene's probe sensor takes; the pixel pitch, which no frame tells, as text."""
        one = self.measured
        rows, columns = one.dark.image.shape
        values: dict[str, Any] = {"pixels": [columns, rows]}
        if pitch is not None:
            values["pitch"] = pitch
        values |= {
            "bits": one.bits,
            "offset": max(0.0, _short(one.offset.value)),
            "gain": _short(one.gain.value),
            "read_noise": _short(one.read_noise.value),
            "full_well": _short(one.full_well.value),
        }
        if one.dark_current is not None:
            values["dark_current"] = _short(one.dark_current.value)
        return values

    def as_dict(self) -> dict[str, Any]:
        """Return everything measured as plain values: null where it was not."""
        one = self.measured
        names = ("gain", "offset", "read_noise", "full_well", "pattern", "sensitivity", "curvature", "dark_current")
        told: dict[str, Any] = {}
        for name in names:
            known = getattr(one, name)
            told[name] = None if known is None else {"value": _plain(known.value), "error": _plain(known.error)}
        return {
            **told,
            "units": "gain in DN per electron; offset in DN; sensitivity and curvature in parts of one; else electrons",
            "read_noise_is": one.read_noise_is,
            "full_well_is": one.full_well_is,
            "linearity": _plain(self._bent()) if len(one.linearity) else None,
            "defects": _plain(one.defects),
            "frames": self.frames,
            "levels": [
                {"name": level.name, "exposure": level.exposure, "frames": level.frames, "signal": _plain(signal)}
                | {"variance": _plain(variance), "used": _plain(used), "saturated": bool(saturated)}
                for level, signal, variance, used, saturated in zip(
                    one.flats, one.signal, one.variance, one.used, one.saturated, strict=True
                )
            ],
        }

    def save(self, path: str | os.PathLike[str], pitch: str | None = None) -> None:
        """Write the YAML file that a scene may name as its `probe.sensor`."""
        content = {"sensor": self.scene_values(pitch), "verdict": self.verdict, "measured": self.as_dict()}
        missing = "" if pitch is not None else "# Scenes ask for the pixel pitch too: add 'pitch: 3.45 um' to sensor.\n"
        text = f"# Written by tapetum calibrate probe.\nschema: {SENSOR_SCHEMA}\n{missing}"
        text += "# Not measured, and the scene's default where left out: exposure, quantum_efficiency, background.\n"
        with atomic_file(path) as part:
            part.write_text(
                text + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110), "utf-8"
            )

    def figure(self) -> Figure:
        """Draw the photon-transfer curve, its residuals, and the linearity."""
        return _figure(self.measured)

    def write_page(self, path: str | os.PathLike[str]) -> None:
        """Write the page: verdict, numbers, pictures and checks."""
        one = self.measured
        alt = f"Photon-transfer curve of {len(one.flats)} levels: gain {one.gain} DN per electron. {self.verdict}."
        caption = (
            "(a) Temporal variance over signal, with the fitted line: its slope is the gain, its start the readout. "
            "(b) How far each level used lies from the line. (c) How far the signal is from a straight line over "
            "exposure time."
        )
        notes = [
            "Uncertainties are standard ones (68 %), from the scatter over tiles of the frame and from rounding.",
            "The pixel pitch and the quantum efficiency cannot be measured this way: the data sheet has them.",
        ]
        write_calibration(
            path,
            "Calibration of a probe's sensor",
            self.checks(),
            self.numbers(),
            self.figure(),
            alt=alt,
            caption=caption,
            notes=notes,
        )


def calibrate_sensor(
    darks: Sequence[str | os.PathLike[str]],
    flats: Sequence[str | os.PathLike[str]],
    *,
    bits: int | None = None,
    exposures: Sequence[float] | None = None,
    progress: Progress = quiet,
) -> SensorCalibration:
    """Measure a sensor from dark and flat frames.

    Parameters
    ----------
    darks, flats
        Videos, folders of images, `.npy` stacks and recordings; a folder of such counts for what is in it. Frames of
        one light and exposure are a level. Exposure times are those of recordings, or in names such as `flat-2.5ms`.
    bits
        Depth of the frames; by default the least of 8, 10, 12, 14 and 16 that holds all numbers.
    exposures
        Exposure time of every flat level in seconds, in the order given, where names do not state it.
    progress
        Shown over the frames.

    Raises
    ------
    InputError
        When a source cannot be read, frames differ in size, or too few levels are found.
    """
    reader = _Reader(progress)
    dark, _ = reader.read(darks, None, None)
    if not dark:
        remedy = "give two or more, taken with the cap on"
        raise InputError("no two dark frames were found", where="dark frames", remedy=remedy)
    mask = good_pixels(min(dark, key=lambda one: one.mean_of(one.mean)))
    if not mask.mean() > 0.5:
        raise InputError("half of the pixels stand out", where="dark frames", remedy="take them with the cap on")
    dark, of_darks = reader.read(darks, None, mask)
    zero = min(level.mean_of(level.mean) for level in dark)
    found, of_flats = reader.read(flats, zero, mask)
    if exposures is not None:
        if len(exposures) != len(found):
            what = f"{len(exposures)} times for {len(found)} flat levels"
            raise InputError(what, where="--exposures", remedy="give one for each level, in the order of the frames")
        found = [_with_exposure(level, time) for level, time in zip(found, exposures, strict=True)]
    frames = of_darks + of_flats
    kept = sum(level.frames for level in (*dark, *found))
    return SensorCalibration(photon_transfer(dark, found, bits=bits), frames, kept, tuple(reader.coloured))


def _with_exposure(level: Level, time: float) -> Level:
    return Level(**{**{name: getattr(level, name) for name in Level.__dataclass_fields__}, "exposure": time})


class _Reader:
    """Reads sources into levels, and counts frames."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self.coloured: dict[str, None] = {}

    def read(
        self, sources: Sequence[str | os.PathLike[str]], dark: float | None, mask: NDArray[np.bool_] | None
    ) -> tuple[list[Level], int]:
        levels: list[Level] = []
        count = 0
        for name in (part for source in sources for part in parts_of(str(source))):
            source = open_frames(name)
            if source.live:
                source.close()
                remedy = "record it first: tapetum record SOURCE -o dark.rec --seconds 2"
                raise InputError("is a camera", where=name, remedy=remedy)
            self._see(source)
            frames = self.progress(_counted(source, tally := [0]), f"reading {Path(name).name}", total=source.count)
            levels += gather(frames, source, dark=dark, mask=mask)
            count += tally[0]
        return levels, count

    def _see(self, source: Source) -> None:
        """Note a source of colour images, whose grey mixes the noise of three channels."""
        if isinstance(source, ImageSource) and read_image(source.files[0], colour=True)[0].ndim == 3:
            self.coloured[source.name] = None


def _counted(source: Source, tally: list[int]) -> Iterator[Frame]:
    for frame in source:
        tally[0] += 1
        yield frame


def _checks(calibration: SensorCalibration) -> list[Check]:
    one = calibration.measured
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
            f"a square term adds {_percent(bend.value, bend.error)}",
            f"within {100 * _STRAIGHT:.0f} %, or three errors",
            straight,
            "switch gamma and tone curves off, and keep the light and the gain fixed",
        ),
        Check(
            "frames in levels",
            f"{calibration.kept} of {calibration.frames}",
            f"{100 * _KEPT:.0f} % or more",
            calibration.kept >= _KEPT * calibration.frames,
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
    if calibration.coloured:
        names = ", ".join(Path(name).name for name in calibration.coloured)
        remedy = "take grey or raw frames: luma mixes the noise of three channels"
        checks.append(Check("colour", f"{names} turned to grey", "none", False, remedy))
    return checks


def _worst(shares: Sequence[float]) -> str:
    return f"{100 * max(shares):.2f} %" if shares else "no bright level"


def _percent(value: float, error: float) -> str:
    if not (math.isfinite(value) and math.isfinite(error)):
        return "not measured"
    return f"({100 * value:.3f} ± {100 * error:.3f}) %"


def _decibel(one: PhotonTransfer) -> str:
    ratio = one.full_well.value / one.read_noise.value
    more = "more than " if one.read_noise_is == "hidden" else ""
    return f"{more}{20 * math.log10(ratio):.0f} dB"


def _short(value: float) -> float:
    return float(f"{value:.6g}")


def _plain(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _figure(one: PhotonTransfer) -> Figure:
    figure = new_figure(10.5, 3.4)
    left, middle, right = figure.subplots(1, 3)
    lit = one.signal > 0
    used = one.used > 0.5
    blue, red = MODELS[0], MODELS[1]
    line = np.geomspace(max(one.signal[lit].min() / 2, 1e-3), one.capacity, 100)
    left.loglog(line, one.line[0] + one.line[1] * line, color=QUIET, linewidth=1.2, label="fit")
    for which, colour, mark, words in (
        (lit & used, blue, "o", "used"),
        (lit & ~used & ~one.saturated, blue, "x", "not used"),
        (lit & one.saturated, red, "s", "saturated"),
    ):
        if which.any():
            seen = np.maximum(one.variance[which], 1e-3)
            left.plot(one.signal[which], seen, mark, color=colour, markersize=4, label=words)
    dress(left, title="Photon transfer", x="signal above dark, DN", y="variance, DN²", letter="a")
    legend(left, loc="upper left")
    expected = one.line[0] + one.line[1] * one.signal[used]
    middle.axhline(0, color=QUIET, linewidth=0.8)
    middle.plot(one.signal[used], 100 * (one.variance[used] / expected - 1), "o", color=blue, markersize=4)
    dress(middle, title="Off the line", x="signal above dark, DN", y="variance / fit − 1, %", letter="b")
    dress(right, title="Linearity", x="exposure, s", y="signal / line − 1, %", letter="c")
    if len(one.linearity):
        times = [level.exposure or math.nan for level in one.flats]
        right.axhline(0, color=QUIET, linewidth=0.8)
        right.plot(times, 100 * one.linearity, "o", color=blue, markersize=4)
    else:
        right.text(0.5, 0.5, "no exposure times", ha="center", va="center", transform=right.transAxes, color=QUIET)
        right.set_xticks([])
        right.set_yticks([])
    return figure
