"""The parts of a bench's plan, with their descriptions: geometry, sampling, eye safety."""

from __future__ import annotations

import math
import textwrap
from dataclasses import asdict, dataclass
from typing import Any

from tapetum.simulate.eye_safety import NOT_A_CERTIFICATE, AtDistance, EyeSafety

__all__ = ["LABEL", "EyeCheck", "Geometry", "Rows", "SamplingChoice", "in_si", "row", "within", "wrapped"]

LABEL = 18  # characters
_WIDTH = 100
_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"), (1e-12, "p"))

Rows = list[tuple[str, str]]


def within(error: float, *, rim_light: bool) -> str:
    """A picture's stated error in words, and whether it counts the light of the pupil's rim, see `bench.Sampling`."""
    return f"within {error:.1e} of the peak" + (
        "" if rim_light else ", but for what the rim sends (sampling.rim_light)"
    )


@dataclass(frozen=True)
class Geometry:
    """Positions, and the wave that meets the target. SI units, angles in degrees where the name says so.

    `wavelengths` and `powers` list the illumination's lines, `wave_curvature` is 1/R at the target (0 for a plane wave,
    positive from a source at R), `second_beam_angle` is in radians against the first beam. `camera` names the
    prescription or the phone's camera; `image_distance` is approximate for a traced lens. `field_deg` holds full angles
    across and down, by real rays for a traced lens, None where its field does not reach the sensor's edges.
    `rotation_deg` is about y and about x, `gaze` in fractions of the field. `probe_aperture` is a diameter,
    `probe_pixels` columns and rows, `exposure` seconds a frame.
    """

    mode: str
    wavelengths: tuple[float, ...]
    powers: tuple[float, ...]
    wave_curvature: float
    second_beam_ratio: float | None
    second_beam_angle: tuple[float, float] | None
    distance: float
    object_distance: float
    camera: str | None
    focal_length: float
    f_number: float
    image_distance: float
    field_deg: tuple[float, float] | None
    rotation_deg: tuple[float, float]
    gaze: tuple[float, float]
    probe_focal_length: float
    probe_aperture: float
    probe_pixels: tuple[int, int]
    probe_pitch: float
    exposure: float

    def rows(self) -> Rows:
        """Label and text of each line."""
        lines = [f"{in_si(p, 'W')} at {w * 1e9:g} nm" for w, p in zip(self.wavelengths, self.powers, strict=True)]
        wave = "plane wave"
        if self.wave_curvature:
            way = "diverging from" if self.wave_curvature > 0 else "converging to"
            wave = f"wave {way} a point {in_si(abs(1 / self.wave_curvature), 'm')} away"
        rows = [("illumination", f"{self.mode}, {', '.join(lines)}, {wave}")]
        if self.second_beam_ratio is not None and self.second_beam_angle is not None:
            x, y = (1e3 * angle for angle in self.second_beam_angle)
            rows.append(("second beam", f"{self.second_beam_ratio:g} of the power, ({x:.4g}, {y:.4g}) mrad aside"))
        focus = "infinity" if math.isinf(self.object_distance) else in_si(self.object_distance, "m")
        field = "field smaller than its sensor"
        if self.field_deg is not None:
            field = f"field {self.field_deg[0]:.3g} x {self.field_deg[1]:.3g} deg"
        columns, down = self.probe_pixels
        rows += [
            (
                "target",
                f"{'' if self.camera is None else f'{self.camera}, '}"
                f"{in_si(self.distance, 'm')} away, f = {in_si(self.focal_length, 'm')}, f/{self.f_number:.3g}, "
                f"focused at {focus}, {field}",
            ),
            (
                "rotation",
                f"({self.rotation_deg[0]:.4g}, {self.rotation_deg[1]:.4g}) deg about y and x: "
                f"gaze ({self.gaze[0]:.4g}, {self.gaze[1]:.4g}) of the field",
            ),
            (
                "probe",
                f"f = {in_si(self.probe_focal_length, 'm')}, aperture {in_si(self.probe_aperture, 'm')} wide, "
                f"{columns} x {down} pixels of {in_si(self.probe_pitch, 'm')}, {in_si(self.exposure, 's')} a frame",
            ),
        ]
        return rows


@dataclass(frozen=True)
class SamplingChoice:
    """How the simulator would compute the scene.

    `plan` holds the planner's numbers by name, `expected_error` the largest error of the irradiance in fractions of the
    peak (infinite where no claim is made), `claim` that error in words. `memory_bytes` is for one image at a time.
    `wavelengths` and `planes` count what is computed separately and summed: spectral samples (metres), and reflecting
    or scattering planes or groups of planes that interfere. `propagation` from target to probe follows, for the stated
    `reason`, from the two radii, in metres.
    """

    plan: dict[str, Any]
    expected_error: float
    claim: str
    memory_bytes: int
    wavelengths: tuple[float, ...]
    planes: int
    propagation: str
    reason: str
    return_radius_at_probe: float
    probe_aperture_radius: float

    def rows(self) -> Rows:
        """Label and text of each line."""
        shown = {k: v for k, v in self.plan.items() if k not in ("method", "expected_error")}
        numbers = ", ".join(f"{k.replace('_', ' ')} {v:.4g}" for k, v in shown.items() if isinstance(v, int | float))
        counts = {"wavelengths": len(self.wavelengths), "planes": self.planes}
        summed = " and ".join(f"{count} {name}" for name, count in counts.items() if count > 1)
        return [
            (str(self.plan.get("method", "samples")), numbers + (f", summed over {summed}" if summed else "")),
            ("expected error", self.claim),
            ("memory", f"{in_si(self.memory_bytes, 'B')} an image"),
            ("propagation", f"{self.propagation}: {self.reason}"),
        ]


@dataclass(frozen=True)
class EyeCheck:
    """The eye safety, or in `refused` why it is not evaluated: one of the two is None."""

    found: EyeSafety | None
    refused: str | None

    def rows(self) -> Rows:
        """Label and text of each line."""
        found = self.found
        if found is None:
            return [("not computed", self.refused or "")]
        # Eye safety words the class itself.
        meaning = next(line for line in found.lines() if line.startswith(f"Class {found.laser_class} by calc"))
        naked, aided = (in_si(found.emission[condition], "W") for condition in ("3", "1"))
        return [
            ("class", meaning.removeprefix("Class ").rstrip(".")),
            *((f"at {place.distance:g} m", _exposed(place)) for place in dict.fromkeys((found.nearest, *found.at))),
            ("passes", f"7 mm pupil {naked}, 50 mm telescope {aided}"),
            ("NOHD", f"naked eye {_reach(found.nohd)}, 50 mm telescope {_reach(found.aided_nohd)}"),
            ("assumed", f"continuous light, exposure {found.exposure:g} s, nothing lost on the way"),
        ]

    def as_dict(self) -> dict[str, Any]:
        """All numbers by name; the same names with None where nothing was computed."""
        found = self.found
        places = [] if found is None else list(dict.fromkeys((found.nearest, *found.at)))
        return {
            "computed": found is not None,
            "reason": self.refused,
            "laser_class": found and found.laser_class,
            "beam": found and asdict(found.beam),
            "exposure": found and found.exposure,
            "class_exposure": found and found.class_exposure,
            "at": [{**asdict(place), "safe": place.safe} for place in places],
            "emission": found and found.emission,
            "limits": found and found.limits,
            "telescope_limits": found and found.telescope_limits,
            "nohd": found and found.nohd,
            "aided_nohd": found and found.aided_nohd,
            "lines": found.lines() if found else [],
            "notice": NOT_A_CERTIFICATE,
        }


def _exposed(place: AtDistance) -> str:
    verdict = "within" if place.safe else "TOO MUCH for"
    limit = f"the limit (MPE) of {in_si(place.mpe, 'W/m²')}, {place.irradiance / place.mpe:.3g} times it"
    return f"{in_si(place.irradiance, 'W/m²')} over 7 mm: {verdict} {limit}"


def _reach(distance: float) -> str:
    return "no end" if math.isinf(distance) else in_si(distance, "m")


def in_si(value: float, unit: str) -> str:
    """A number with four digits and a prefix, 509.3 mW/m² for 0.5093 W/m²."""
    for factor, prefix in _PREFIXES:
        # A number that rounds up to the next prefix takes that prefix.
        if abs(value) >= 0.99995 * factor:
            return f"{value / factor:.4g} {prefix}{unit}"
    return f"{value:.4g} {unit}"


def row(label: str, text: str) -> list[str]:
    """A labelled line, or several where the text is long."""
    return wrapped(f"{label:<{LABEL - 1}} {text}")


def wrapped(line: str) -> list[str]:
    """A line with its label, indented and no wider than 100 columns."""
    return textwrap.wrap(line, _WIDTH, initial_indent="  ", subsequent_indent=" " * (LABEL + 2), break_on_hyphens=False)
