"""A scene's traced lens: its pupils at each wavelength, and the passes of the planes behind it."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Sequence

import torch

from tapetum.bench import PrescriptionLens, Scene, at_wavelength
from tapetum.errors import InputError
from tapetum.optics.focus import FocusedLens, best_focus
from tapetum.optics.grid import Grid
from tapetum.optics.sampling import check_aperture
from tapetum.simulate.glints import Glints, GlintTable, glint_tables
from tapetum.simulate.probe_path import ProbeAperture
from tapetum.simulate.pupil_fits import PupilFits, TiltNodes, fit_pupils, rounded_up
from tapetum.simulate.pupil_rim import pupil_depth
from tapetum.simulate.radiometry import beam_radius, illumination_curvature
from tapetum.simulate.reflections import glinting
from tapetum.simulate.surfaces import Mask, Surface
from tapetum.simulate.traced_again import group_again
from tapetum.simulate.traced_bundle import trace_bundle
from tapetum.simulate.traced_light import Way, any_angle, return_angle
from tapetum.simulate.traced_plan import TracedGroup, TracedMask, traced_group, traced_mask

__all__ = ["TracedLens"]

_COUNT, _BISECTIONS = 21, 9
# Bytes that the samples of the probe's aperture may take.
_MOST_AT_APERTURE = 6 << 30


class TracedLens:
    """The target's lens of a scene, traced once for all wavelengths and passes.

    Parameters
    ----------
    scene
        With a `PrescriptionLens`.
    object_distance
        Where it is focused, in metres.
    steepest
        Sine of the steepest tilt that will be asked for, second beam and source included.

    Raises
    ------
    InputError
        For a lens that lets nothing through, and for what a traced lens does not support: beams narrower than the lens.
    """

    def __init__(self, scene: Scene, object_distance: float, steepest: float) -> None:
        lens = scene.target.lens
        assert isinstance(lens, PrescriptionLens)
        if beam_radius(scene) < lens.aperture_radius:
            raise InputError(
                f"a beam {2 * beam_radius(scene):.4g} m wide does not fill a traced lens",
                where="illumination",
                remedy=f"widen it to {2.2 * lens.aperture_radius:.4g} m",
            )
        self._scene, self._lens, self._object_distance = scene, lens, object_distance
        light = scene.illumination
        second = math.hypot(*light.second_beam.angle) if light.second_beam is not None else 0.0
        self._steepest = min(1.0, rounded_up(steepest + second + light.source_size / 2))
        self._curvature = illumination_curvature(scene)
        self._planned: TracedLens | None = None
        depths = [0.0] if scene.target.sensor.reflectance > 0 else []
        depths += [
            layer.depth / layer.index
            for layer in scene.target.sensor.layers
            if at_wavelength(layer.reflectance, light.wavelength) > 0
        ]
        angle = _return_angle(*self._asked(light.wavelength), tuple(depths or [0.0]))
        if scene.target.sensor.mask is not None:
            angle = max(angle, any_angle(self._at(light.wavelength)[1]))
        self.exit_angle = angle
        """Largest angle of returning light against its field's direction, by rays, in radians."""
        self.return_radius = lens.aperture_radius + self.exit_angle * scene.distance
        """Radius of the widest return at the probe, by rays, in metres."""

    def set_to(self, scene: Scene, object_distance: float) -> TracedLens:
        """The lens of a scene that differs by little, for pictures on the same samples (`again`)."""
        other = copy.copy(self)
        lens = scene.target.lens
        assert isinstance(lens, PrescriptionLens)
        other._scene, other._lens, other._object_distance = scene, lens, object_distance
        other._curvature, other._planned = illumination_curvature(scene), self
        return other

    def _at(self, wavelength: float) -> tuple[FocusedLens, PupilFits]:
        if self._planned is None:
            return _fitted(*self._asked(wavelength))
        planned = self._planned._at(wavelength)
        if self._is_planned:
            return planned
        return _fitted_on(self._lens, wavelength, self._object_distance, planned[1].nodes, self._curvature)

    @property
    def _is_planned(self) -> bool:
        """Whether the lens was not changed."""
        one = self._planned
        return one is not None and one._asked(0.0) == self._asked(0.0)

    def _asked(self, wavelength: float) -> tuple[PrescriptionLens, float, float, float, float]:
        return self._lens, wavelength, self._object_distance, self._steepest, self._curvature

    def aperture_sine(self, wavelength: float) -> float:
        """Largest half width of the pupil in direction sines."""
        return self._at(wavelength)[1].aperture[0]

    def thin_focal_length(self, wavelength: float) -> float:
        """Focal length, in metres, of the thin lens with the same defocus at a wavelength.

        The sensor stands where a thin lens of the design wavelength's focal length is sharp. Scattered light uses it.
        """
        focused, _ = self._at(wavelength)
        sensor = 1 / (1 / self._lens.focal_length - 1 / self._object_distance)
        shift = best_focus(focused.lens, self._object_distance) - focused.image
        return 1 / (1 / (sensor + shift) + 1 / self._object_distance)

    def group(
        self,
        surfaces: Sequence[Surface],
        output: Grid,
        wavelength: float,
        accuracy: float,
        distance: float | None,
        *,
        pictures: int,
        dtype: torch.dtype,
        device: torch.device,
    ) -> TracedGroup:
        """The passes of planes that interfere, over the `distance` through the probe's aperture or to the far field."""
        way = self._way(output, wavelength, accuracy, distance, dtype, device)
        return traced_group(*self._at(wavelength), surfaces, output, accuracy=accuracy, pictures=pictures, **way)

    def again(
        self,
        group: TracedGroup,
        surfaces: Sequence[Surface] | None,
        output: Grid,
        wavelength: float,
        accuracy: float,
        distance: float | None,
        *,
        dtype: torch.dtype,
        device: torch.device,
    ) -> TracedGroup:
        """As `group`, on the samples of one that was planned for the lens before it was set, or without `surfaces` for
        this lens and other pixels."""
        way = self._way(output, wavelength, accuracy, distance, dtype, device)
        return group_again(group, *self._at(wavelength), surfaces, output, same_lens=self._is_planned, **way)

    def mask(
        self,
        mask: Mask,
        output: Grid,
        wavelength: float,
        accuracy: float,
        *,
        dtype: torch.dtype,
        device: torch.device,
    ) -> TracedMask:
        """The passes of a mask on the sensor, to the far field."""
        focused, fits = self._at(wavelength)
        way = self._way(output, wavelength, accuracy, None, dtype, device)
        return traced_mask(focused, fits, Surface(focused.image), mask, output, accuracy=accuracy, **way)

    def _way(
        self,
        output: Grid,
        wavelength: float,
        accuracy: float,
        distance: float | None,
        dtype: torch.dtype,
        device: torch.device,
    ) -> Way:
        probe = self._scene.probe.lens
        aperture = None
        if distance is not None:
            window = math.hypot(output.width, output.height) / 2 / probe.focal_length
            # The distance counts from the entrance pupil, the light from where its rim is sharp.
            focused, fits = self._at(wavelength)
            away = distance + pupil_depth(focused)

            def of(radius: float) -> ProbeAperture:
                reach = fits.aperture[1]
                return ProbeAperture.behind_traced(away, radius, wavelength, window, reach=reach, accuracy=accuracy)

            check_aperture(
                lambda radius: (of(radius).columns, of(radius).rows),
                away,
                probe.aperture_radius,
                most=_MOST_AT_APERTURE,
                also="ask for less accuracy",
            )
            aperture = of(probe.aperture_radius)
        return {
            "wavelength": wavelength,
            "probe_focal_length": probe.focal_length,
            "curvature": self._curvature,
            "aperture": aperture,
            "rim_light": self._scene.sampling.rim_light,
            "dtype": dtype,
            "device": device,
        }

    def glints(
        self,
        output: Grid,
        wavelength: float,
        distance: float | None,
        dtype: torch.dtype = torch.float64,
        accuracy: float = 1e-2,
    ) -> Glints | None:
        """The glints of its surfaces; None where these are not said to reflect.

        Raises
        ------
        InputError
            Where all light is taken to reach the probe, `distance` None: glints spread over everything before the lens.
        """
        reflectance = glinting(self._scene, wavelength)
        if reflectance == 0:
            return None
        if distance is None:
            what = "glints of a coating spread far beyond any probe, and 'far field' would let all of them in"
            raise InputError(
                what, where="sampling.propagation", remedy="use 'finite', or leave target.lens.coating out"
            )
        probe = self._scene.probe.lens
        return Glints(
            _glint_tables(self._lens, wavelength, self._object_distance),
            reflectance,
            output,
            wavelength=wavelength,
            distance=distance,
            probe_radius=probe.aperture_radius,
            probe_focal_length=probe.focal_length,
            accuracy=accuracy,
            dtype=dtype,
        )


@functools.lru_cache(maxsize=32)
def _glint_tables(lens: PrescriptionLens, wavelength: float, object_distance: float) -> list[GlintTable]:
    return glint_tables(lens.focused(wavelength, object_distance), wavelength)


@functools.lru_cache(maxsize=16)
def _fitted(
    lens: PrescriptionLens, wavelength: float, object_distance: float, steepest: float, curvature: float
) -> tuple[FocusedLens, PupilFits]:
    focused = lens.focused(wavelength, object_distance)
    return focused, fit_pupils(focused, _covered(focused, steepest, curvature), curvature=curvature)


@functools.lru_cache(maxsize=16)
def _fitted_on(
    lens: PrescriptionLens, wavelength: float, object_distance: float, nodes: TiltNodes, curvature: float
) -> tuple[FocusedLens, PupilFits]:
    focused = lens.focused(wavelength, object_distance)
    return focused, fit_pupils(focused, nodes.steepest, curvature=curvature, nodes=nodes)


@functools.lru_cache(maxsize=16)
def _return_angle(
    lens: PrescriptionLens,
    wavelength: float,
    object_distance: float,
    steepest: float,
    curvature: float,
    depths: tuple[float, ...],
) -> float:
    focused, fits = _fitted(lens, wavelength, object_distance, steepest, curvature)
    return return_angle(focused, fits, depths, curvature)


def _covered(focused: FocusedLens, steepest: float, curvature: float) -> float:
    """Sine of the steepest tilt, up to `steepest`, at which a lens lets light through; beyond it nothing returns."""

    def passes(sine: float) -> bool:
        try:
            at = torch.tensor([sine], dtype=torch.float64)
            trace_bundle(focused, at, curvature=curvature, count=_COUNT, sloped=False)
        except InputError:
            return False
        return True

    if passes(steepest):
        return steepest
    low, high = 0.0, steepest
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if passes(middle) else (low, middle)
    if low == 0:
        # This raises with the reason.
        trace_bundle(focused, torch.zeros(1, dtype=torch.float64), curvature=curvature, count=_COUNT)
    # At the very edge of the field the pupil is narrow.
    return 0.97 * low
