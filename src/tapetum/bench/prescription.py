"""The lens of a target by its prescription: which one, at what focal length and F-number, and how it is focused."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

from pydantic import Field, SerializerFunctionWrapHandler, WrapValidator, model_serializer, model_validator
from pydantic.dataclasses import dataclass

from tapetum.bench.layers import Layer, Spectrum
from tapetum.bench.lens_data import LensState, Prescription, Surface, build_lens, clearance
from tapetum.bench.lens_file import lens_names, load_lens
from tapetum.bench.quantity import Length
from tapetum.bench.strict import STRICT, Positive
from tapetum.bench.zoom import focal_range, surfaces_at
from tapetum.errors import InputError

if TYPE_CHECKING:
    from tapetum.optics.focus import FocusedLens
    from tapetum.optics.rays import Lens

__all__ = ["LensState", "Prescription", "PrescriptionLens", "Surface", "lens_names", "load_lens"]

# Without a focal length, the file's own is filled in when the lens is built, so readers get a number.
FocalLength = Annotated[Positive, WrapValidator(lambda value, handler: None if value is None else handler(value))]
# F-numbers are stated with two digits.
_ROUNDED = 5e-3
# Trial positions of a group that bracket its focus.
_STEPS = 40


@dataclass(frozen=True, config=STRICT)
class PrescriptionLens:
    """A real lens, traced ray by ray.

    Parameters
    ----------
    name
        Of the catalogue, or the path of a `.yaml` or `.zmx` file.
    focal_length
        In metres, at the design wavelength, by default the prescription's own. A prime lens is scaled to it; a zoom
        requires it, and is set to it.
    f_number
        F-number to stop down to: focal length over the diameter of the axial beam that passes.
    design_wavelength
        At which it is focused, in metres: a phone focuses in visible light, and is then out of focus at 785 nm.
    focus
        `unit` moves the whole lens against the sensor, `group` the prescription's group; by default as it says.
    coating
        Power reflectance of each surface between glass and air, one number or by wavelength. Plane plates have their
        own. It gives the lens's ghost reflections (0 for none) and does not dim transmitted light.
    """

    name: str
    kind: Literal["prescription"] = "prescription"
    focal_length: FocalLength = cast(float, None)
    f_number: Annotated[float, Field(gt=0.3, lt=200)] | None = None
    design_wavelength: Annotated[Length, Field(ge=405e-9, le=1e-6)] = 587.56e-9
    focus: Literal["unit", "group"] | None = None
    coating: Spectrum = 0.0

    @model_validator(mode="after")
    def _can_be_built(self) -> PrescriptionLens:
        prescription = load_lens(self.name)
        if cast(Any, self.focal_length) is None:
            surfaces_at(prescription, None, self.design_wavelength)
            object.__setattr__(self, "focal_length", focal_range(prescription, self.design_wavelength)[0])
        if self.focus == "group" and prescription.focus == "unit":
            raise ValueError(f"{self.name} names no group that focuses; use 'focus: unit'")
        if self.f_number is not None:
            # Torch takes a second to import; a command's help must not wait for it.
            from tapetum.optics.focus import pupil_height

            own = self.focal_length / (2 * pupil_height(_wide_open(self, prescription)))
            if self.f_number < own * (1 - _ROUNDED):
                raise ValueError(f"f_number {self.f_number:g} is wider than {self.name} opens; give {own:.3g} or more")
        # Tracing shows that the lens passes light.
        _sensor(self, prescription)
        return self

    @model_serializer(mode="wrap")
    def _as_given(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # Omit the file's own focal length, or a lens of another name put into the scene would be scaled to it.
        plain = handler(self)
        own = focal_range(load_lens(self.name), self.design_wavelength)
        if len(own) == 1 and self.focal_length == own[0]:
            del plain["focal_length"]
        return plain

    @property
    def aperture_radius(self) -> float:
        """Radius of the axial beam of parallel light that passes the lens, in metres, by real rays."""
        return _aperture(self, load_lens(self.name))

    @property
    def glass(self) -> None:
        """None: the prescription gives its glasses."""

    def focused(self, wavelength: float, object_distance: float) -> FocusedLens:
        """Return the lens at a wavelength, with the sensor in focus at the design wavelength.

        Parameters
        ----------
        wavelength, object_distance
            In metres; the distance is from the object to the entrance pupil, `inf` allowed.

        Raises
        ------
        InputError
            For a distance that it cannot focus on, and a wavelength at which a glass has no index.
        """
        return _focused(self, load_lens(self.name), float(wavelength), float(object_distance))


def check_layers(lens: PrescriptionLens, layers: tuple[Layer, ...], object_distance: float) -> None:
    """Raise a ValueError for a layer that would lie inside a lens focused at a distance in metres."""
    if not layers:
        return
    focused = lens.focused(lens.design_wavelength, object_distance)
    # Plates may stand behind the last refracting surface.
    bends = (focused.lens.curvature != 0) | (focused.lens.asphere != 0).any(-1)
    room = focused.image - float(focused.lens.z[bends].max())
    for number, layer in enumerate(layers):
        if layer.depth >= room:
            what = f"sensor.layers.{number}: a layer {layer.depth:g} m before the sensor lies in the lens"
            raise ValueError(f"{what}, which ends {room:.3g} m before it; move it nearer")


# The prescription is a part of the cache key below, because its file may change.


@functools.lru_cache(maxsize=256)
def _wide_open(lens: PrescriptionLens, prescription: Prescription) -> Lens:
    surfaces, scale = surfaces_at(prescription, lens.focal_length, lens.design_wavelength)
    return build_lens(surfaces, lens.design_wavelength, scale)


@functools.lru_cache(maxsize=256)
def _design(lens: PrescriptionLens, prescription: Prescription) -> Lens:
    """The lens at the design wavelength, stopped down to `f_number` and focused at infinity."""
    from tapetum.optics.focus import pupil_height, stopped_down

    wide = _wide_open(lens, prescription)
    if lens.f_number is None or lens.f_number <= lens.focal_length / (2 * pupil_height(wide)):
        return wide
    return stopped_down(wide, lens.f_number)


@functools.lru_cache(maxsize=256)
def _sensor(lens: PrescriptionLens, prescription: Prescription) -> float:
    """z of the sensor at which infinity is in focus, in metres."""
    from tapetum.optics.focus import best_focus

    return best_focus(_design(lens, prescription), math.inf)


@functools.lru_cache(maxsize=256)
def _aperture(lens: PrescriptionLens, prescription: Prescription) -> float:
    from tapetum.optics.focus import pupil_height

    return pupil_height(_design(lens, prescription))


@functools.lru_cache(maxsize=512)
def _focused(
    lens: PrescriptionLens, prescription: Prescription, wavelength: float, object_distance: float
) -> FocusedLens:
    import torch

    from tapetum.optics.focus import FocusedLens, best_focus
    from tapetum.optics.paraxial import paraxial

    design, sensor = _design(lens, prescription), _sensor(lens, prescription)
    if lens.focus != "unit" and prescription.focus != "unit":
        design, image = _with_group(design, prescription.focus, sensor, object_distance)
    else:
        image = sensor if math.isinf(object_distance) else best_focus(design, object_distance)
    surfaces = prescription.surfaces
    index = torch.tensor([1.0, *(one.index_at(wavelength) for one in surfaces)], dtype=torch.float64)
    real = replace(design, index=index)
    cardinal = paraxial(real)
    return FocusedLens(
        lens=real,
        image=image,
        entrance_pupil=cardinal.entrance_pupil,
        exit_pupil=cardinal.exit_pupil,
        entrance_radius=cardinal.entrance_radius,
        focal_length=cardinal.focal_length,
    )


def _with_group(lens: Lens, group: tuple[int, int], sensor: float, distance: float) -> tuple[Lens, float]:
    """The lens with its group moved so that an object is in focus on the sensor position of infinity."""
    from tapetum.optics.focus import best_focus, moved_group, paraxial_image
    from tapetum.optics.paraxial import paraxial

    if math.isinf(distance):
        return lens, sensor
    from scipy.optimize import newton

    first, last = group
    low, high = -clearance(lens, first - 1, first)[0], clearance(lens, last, last + 1)[0]
    places = [low + (high - low) * i / _STEPS for i in range(_STEPS + 1)]
    misses = [paraxial_image(moved_group(lens, group, at), distance) - paraxial(lens).focus for at in places]
    found = [i for i in range(_STEPS) if math.isfinite(misses[i] + misses[i + 1]) and misses[i] * misses[i + 1] <= 0]
    if found:
        # Take the solution nearest to the group's position at infinity.
        i = min(found, key=lambda i: abs(places[i] + places[i + 1]))

        def miss(at: float) -> float:
            return best_focus(moved_group(lens, group, at), distance) - sensor

        shift = float(newton(miss, places[i], x1=places[i + 1], tol=1e-13, maxiter=30, disp=False))
        if low <= shift <= high:
            return moved_group(lens, group, shift), sensor
    what = f"the group of surfaces {first} to {last} would collide before {distance:g} m are in focus"
    raise InputError(what, where="object_distance", remedy="focus farther away, or use 'focus: unit'")
