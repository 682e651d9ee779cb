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
from tapetum.calibrate.sensor_checks import percent, sensor_checks
from tapetum.calibrate.verdict import Check, verdict
from tapetum.errors import InputError
from tapetum.files import atomic_file
from tapetum.progress import Progress, quiet
from tapetum.record.frames import open_frames
from tapetum.record.images import ImageSource, read_image
from tapetum.record.source import Frame, Source
from tapetum.report.figures._style import MODELS, QUIET, dress, legend, new_figure

__all__ = ["SensorCalibration", "calibrate_sensor"]


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
        return sensor_checks(self.measured, self.frames, self.kept, self.coloured)

    @property
    def verdict(self) -> str:
        """`good`, or which checks failed."""
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
            ("pattern of the sensitivity (PRNU)", f"{percent(one.sensitivity.value, one.sensitivity.error)}"),
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
        """Return the values that a scene's probe sensor takes; the pixel pitch, which no frame shows, as text."""
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
    fit = np.maximum(one.line[0] + one.line[1] * line, 1e-6)
    left.loglog(line, fit, color=QUIET, linewidth=1.2, label="fit")
    # Room for the legend above; what saturates without any noise stands at the lower edge.
    left.set_ylim(fit[0] / 5, 100 * fit[-1])
    for which, colour, mark, words in (
        (lit & used, blue, "o", "used"),
        (lit & ~used & ~one.saturated, blue, "x", "not used"),
        (lit & one.saturated, red, "s", "saturated"),
    ):
        if which.any():
            seen = np.maximum(one.variance[which], fit[0] / 4)
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
