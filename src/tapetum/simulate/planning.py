"""The plan of a bench before the first image: geometry, link budget, sampling, limits, eye safety."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, cast

import torch

from tapetum.bench import PhoneTarget, PrescriptionLens, Scene, as_scene
from tapetum.errors import InputError
from tapetum.optics.grid import lens_numbers
from tapetum.progress import Progress, quiet
from tapetum.simulate.budget import LinkBudget, link_budget
from tapetum.simulate.eye_safety import NOT_A_CERTIFICATE, beam_of, eye_safety
from tapetum.simulate.gaze import gaze_of, tilt_of_gaze
from tapetum.simulate.information import FisherInformation, checked_parameters, fisher, not_told
from tapetum.simulate.phone import open_camera
from tapetum.simulate.plan_parts import LABEL, EyeCheck, Geometry, SamplingChoice, in_si, row, within, wrapped
from tapetum.simulate.radiometry import illumination_curvature
from tapetum.simulate.reflections import glinting

__all__ = ["LABEL_ERRORS", "PARAMETERS", "Plan", "eye_check", "label_lines", "plan_bench"]

PARAMETERS = ("gaze_x", "gaze_y", "object_distance", "focal_length", "distance", "power")

LABEL_ERRORS = {"15 Hz": 3.5e-4, "30 Hz": 5.1e-5, "60 Hz": 3.5e-5, "triggered": 5.2e-5}
"""RMS error of gaze labels, in fractions of the field, by the frame rate of the target's own camera, or where a trigger
takes its frames together with the probe's. Measured by scripts/measure_labels.py (seeds 300 to 305) for a tremor of
0.002 of the field at 8 to 12 Hz, a rolling shutter, and spots that are found to 0.05 of 968 pixels; a trigger leaves
this error alone, of one frame."""

_LIMIT = "Cramér-Rao limit of one frame: standard deviation of the best unbiased estimate"
_PREFIXED_UNITS = ("m", "W")


@dataclass(frozen=True)
class Plan:
    """Result of [`plan_bench`][tapetum.simulate.planning.plan_bench].

    Parameters
    ----------
    geometry, sampling, eye
        See their classes.
    budgets
        One of each wavelength, the illumination's first one first.
    limit
        Fisher information and Cramér-Rao limits of one frame; None where no parameter has one.
    left_out
        Which of `PARAMETERS` have no limit in this scene, and why.
    """

    geometry: Geometry
    budgets: tuple[LinkBudget, ...]
    sampling: SamplingChoice
    limit: FisherInformation | None
    left_out: dict[str, str]
    eye: EyeCheck

    def as_dict(self) -> dict[str, Any]:
        """Everything as plain JSON values in SI units; None for what is absent or not finite."""
        limit = self.limit
        return _finite(
            {
                "geometry": asdict(self.geometry),
                "link_budget": [budget.as_dict() for budget in self.budgets],
                "sampling": asdict(self.sampling),
                "limit": {
                    "parameters": list(limit.parameters) if limit else [],
                    "units": dict(limit.units) if limit else {},
                    "bounds": dict(limit.bounds) if limit else {},
                    "alone": dict(limit.alone) if limit else {},
                    "left_out": dict(self.left_out),
                    "information": [[float(one) for one in line] for line in limit.information] if limit else [],
                },
                "labels": {"rms_error": dict(LABEL_ERRORS)},
                "eye_safety": self.eye.as_dict(),
            }
        )

    def lines(self) -> list[str]:
        """The plan as text of 100 columns; the last line states that eye safety is no certificate."""
        first, *further = self.budgets
        budget = [part for line in first.lines() for part in wrapped(line)]
        for one in further:
            arrives = f"{in_si(one.sensor_watts, 'W')} on its sensor, {one.electrons:.4g} electrons"
            budget += row(f"{one.wavelength * 1e9:g} nm", f"{arrives}, SNR {one.snr:.4g} a frame")
        return [
            "Bench",
            *(line for one in self.geometry.rows() for line in row(*one)),
            "Link budget",
            *budget,
            "Sampling",
            *(line for one in self.sampling.rows() for line in row(*one)),
            *self._limit_lines(),
            "Eye safety",
            *(line for one in self.eye.rows() for line in row(*one)),
            NOT_A_CERTIFICATE,
        ]

    def _limit_lines(self) -> list[str]:
        limit = self.limit
        if limit is None:
            reasons = list(dict.fromkeys(self.left_out.values()))
            return [f"{_LIMIT}, RR's place known", *(line for why in reasons for line in row("left out", why))]
        rows = [("", "all others unknown", "all others known")]
        for name in limit.parameters:
            unit = limit.units[name]
            rows.append((name, _estimate(limit.bounds[name], unit), _estimate(limit.alone[name], unit)))
        wide = 2 + max(len(bound) for _, bound, _ in rows)
        placed = "" if {"place_x", "place_y"} & set(limit.parameters) else ", RR's place known"
        return [
            f"{_LIMIT}{placed}",
            *(f"  {name:<{LABEL}}{bound:<{wide}}{alone}" for name, bound, alone in rows),
            *(line for name, why in self.left_out.items() for line in row(name, f"left out: {why}")),
        ]


def label_lines() -> list[str]:
    """How labels improve with a faster target camera, or with one whose frames a trigger takes together with the
    probe's."""
    said = ", ".join(f"{how} {error:.1e}" for how, error in LABEL_ERRORS.items())
    return [
        "Gaze labels of a hand-held target, by its own camera's frame rate",
        *row("RMS error", f"{said} of the field"),
    ]


_FOCUS = ("object_distance", "focal_length")


def plan_bench(
    scene: Scene | str | os.PathLike[str], parameters: Sequence[str] | None = None, *, progress: Progress = quiet
) -> Plan:
    """Plan a bench: the results to expect of a scene, before it is simulated or built.

    Parameters
    ----------
    scene
        A scene, its name or its path; its own rotation counts.
    parameters
        Whose Cramér-Rao limits are wanted, as [`fisher`][tapetum.simulate.information.fisher] names them, all estimated
        from one frame. Default: those of `PARAMETERS` that have a limit in this scene, except the focus of a traced
        lens, which takes four more traced lenses; the plan says why the others have none.
    progress
        Shown over the two steps that may take long: sampling and limits.

    Raises
    ------
    InputError
        When the simulator refuses the scene, or for parameters unknown, given twice or missing. What eye safety refuses
        does not raise: the plan says why.
    """
    scene = as_scene(scene)
    left_out: dict[str, str] = {}
    if parameters is None:
        reasons = {name: not_told(scene, name) or _costly(scene, name) for name in PARAMETERS}
        left_out = {name: why for name, why in reasons.items() if why is not None}
        parameters = [name for name in PARAMETERS if name not in left_out]
    else:
        # A real lens takes long to plan: refuse bad names first.
        parameters = checked_parameters(scene, parameters)
    light = scene.illumination
    wavelengths = (light.wavelength, *(line.wavelength for line in light.lines))
    budgets = tuple(link_budget(scene, wavelength) for wavelength in wavelengths)
    sampling: SamplingChoice | None = None
    limit: FisherInformation | None = None
    # The planner refuses before the costly derivatives.
    for step in progress(("sampling", "limits"), "planning", total=2):
        if step == "sampling":
            sampling = _sampling(scene, budgets[0])
        elif parameters or not left_out:
            # Parameters named by the user are refused, not left out.
            limit = fisher(scene, parameters)
    assert sampling is not None
    return Plan(
        geometry=_geometry(scene),
        budgets=budgets,
        sampling=sampling,
        limit=limit,
        left_out=left_out,
        eye=eye_check(scene),
    )


def _costly(scene: Scene, name: str) -> str | None:
    """Why a limit is computed only where asked for by name."""
    traced = not isinstance(scene.target, PhoneTarget) and isinstance(scene.target.lens, PrescriptionLens)
    return "takes four more lenses to trace: ask for it by name" if traced and name in _FOCUS else None


def _geometry(scene: Scene) -> Geometry:
    light, target, probe = scene.illumination, scene.target, scene.probe
    lens = target.lens
    z, _ = lens_numbers(lens.focal_length, target.object_distance)
    sines = torch.tensor([math.sin(angle) for angle in target.rotation], dtype=torch.float64)
    gaze = gaze_of(scene, sines)
    second = light.second_beam
    return Geometry(
        mode=light.mode,
        wavelengths=(light.wavelength, *(line.wavelength for line in light.lines)),
        powers=(light.power, *(line.power for line in light.lines)),
        wave_curvature=illumination_curvature(scene),
        second_beam_ratio=second.ratio if second else None,
        second_beam_angle=second.angle if second else None,
        distance=scene.distance,
        object_distance=target.object_distance,
        camera=_camera(scene),
        focal_length=lens.focal_length,
        f_number=lens.focal_length / (2 * lens.aperture_radius),
        image_distance=z,
        field_deg=_field(scene),
        rotation_deg=(math.degrees(target.rotation[0]), math.degrees(target.rotation[1])),
        gaze=(float(gaze[0]), float(gaze[1])),
        probe_focal_length=probe.lens.focal_length,
        probe_aperture=2 * probe.lens.aperture_radius,
        probe_pixels=probe.sensor.pixels,
        probe_pitch=probe.sensor.pitch,
        exposure=probe.sensor.exposure,
    )


def _camera(scene: Scene) -> str | None:
    target = scene.target
    if isinstance(target, PhoneTarget):
        return f"{target.name} ({target.unit.name}: {target.lens.name})"
    return target.lens.name if isinstance(target.lens, PrescriptionLens) else None


def _field(scene: Scene) -> tuple[float, float] | None:
    """Full angles of the field across and down, in degrees."""
    try:
        edges = tilt_of_gaze(scene, torch.tensor([[0.5, 0.0], [0.0, 0.5]], dtype=torch.float64))
    except InputError:
        return None
    return math.degrees(2 * math.asin(edges[0, 0])), math.degrees(2 * math.asin(edges[1, 1]))


def _sampling(scene: Scene, budget: LinkBudget) -> SamplingChoice:
    camera = open_camera(scene, math.hypot(*(math.sin(angle) for angle in scene.target.rotation)))
    known, plan, pixels = camera.metadata(), camera.plan, camera.sampled
    error, returning = float(known["expected_error"]), float(known["return_radius_at_probe"])
    claim = within(error, rim_light=bool(known["rim_light"]))
    if not math.isfinite(error):
        # Three reasons: unknown, or without meaning.
        claim = "no claim: some of the light is past the cut-off"
        if not any(one.returning for one in budget.reflections):
            claim = "no light returns past the cut-off"
        elif scene.sampling.pupil is not None or scene.sampling.sensor is not None:
            claim = "unknown: sampled by hand more coarsely than planned"
    aperture = scene.probe.lens.aperture_radius
    reason = (
        f"the return, {in_si(2 * returning, 'm')} wide at the probe, "
        f"{'fits' if returning <= aperture else 'overfills'} its {in_si(2 * aperture, 'm')} aperture"
    )
    if scene.target.sensor.mask is not None:
        reason += "; a mask on the target's sensor allows no other"
    elif scene.sampling.propagation != "auto":
        reason += "; sampling.propagation asks for it"
    elif returning <= aperture and glinting(scene):
        reason += "; the glints of the lens's surfaces overfill it"
    elif returning <= aperture and str(known["propagation"]).startswith("finite"):
        reason += ", which cuts off rings that count"
    if cut := float(known["cut_by_aperture"]):
        reason += f"; the error is mostly rings that it cuts off, {cut:.1g}" if cut > error / 2 else ""
    return SamplingChoice(
        plan=plan.as_dict(),
        expected_error=error,
        claim=claim,
        memory_bytes=plan.bytes_needed(1, pixels),
        propagation=str(known["propagation"]),
        reason=reason,
        wavelengths=tuple(known["wavelengths"]),
        planes=int(known["planes"]),
        return_radius_at_probe=returning,
        probe_aperture_radius=aperture,
    )


def eye_check(scene: Scene) -> EyeCheck:
    """Eye safety of a scene at its distance, or why it is not computed."""
    try:
        return EyeCheck(eye_safety(beam_of(scene), (scene.distance,)), None)
    except InputError as error:
        return EyeCheck(None, str(error))


def _estimate(value: float, unit: str) -> str:
    if not math.isfinite(value):
        return "no information"
    # "m on the probe's sensor": the prefix belongs to the first word.
    symbol, _, of_what = unit.partition(" ")
    number = in_si(value, symbol) if symbol in _PREFIXED_UNITS else f"{value:.4g}"
    return f"{number} {of_what}".rstrip()


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _finite(one) for key, one in cast("dict[str, Any]", value).items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in cast("list[Any]", value)]
    return None if isinstance(value, float) and not math.isfinite(value) else value
