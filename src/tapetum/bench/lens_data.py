"""A lens by its patent's data: surfaces, the media behind them, and the states of a zoom."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationInfo, model_validator
from pydantic.dataclasses import dataclass

from tapetum.bench.quantity import Angle, Length, to_si
from tapetum.bench.strict import STRICT, Positive
from tapetum.optics.glass import index_from_abbe, refractive_index

if TYPE_CHECKING:
    from tapetum.optics.rays import Lens

__all__ = ["LensState", "Prescription", "Surface", "build_lens", "clearance", "with_moves"]

# Published semi-diameters may overlap slightly at the rims: by at most 0.35 % in the catalogue.
_TOUCHING = 5e-3


def _unit(info: ValidationInfo) -> float:
    return (info.context or {}).get("unit", 1.0)


def _in_metres(value: Any, info: ValidationInfo) -> Any:
    """A bare number is in the file's unit; a text may have its own."""
    try:
        return float(value) * _unit(info)
    except (TypeError, ValueError):
        return value
    except OverflowError as error:
        raise ValueError("is out of range; give a length") from error


def _moves(value: Any, info: ValidationInfo) -> Any:
    """A file gives changed gaps as a mapping from a surface's number to its new length."""
    if not isinstance(value, dict):
        return value
    moves: list[tuple[Any, float]] = []
    for number, length in value.items():
        try:
            moves.append((number, to_si(_in_metres(length, info), "m")))
        except ValueError as error:
            raise ValueError(f"surface {number}: {error}") from error
    return moves


def _terms(value: Any, info: ValidationInfo) -> Any:
    """A file gives an asphere as a mapping from powers to coefficients, in its unit^(1 - power)."""
    if not isinstance(value, dict):
        return value
    terms: list[tuple[int, float]] = []
    for power, coefficient in value.items():
        if not str(power).isdigit() or isinstance(coefficient, bool):
            raise ValueError(f"{power!r}: {coefficient!r} is no term; write it as {{4: -1.2e-3, 6: 3.4e-5}}")
        try:
            # YAML reads 1e-5, without a point, as text.
            terms.append((int(power), float(coefficient) * _unit(info) ** (1 - int(power))))
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"coefficient {coefficient!r} of r^{power} is no number; give one, as 1.2e-3") from error
    return terms


InFile = BeforeValidator(_in_metres)
Opening = Annotated[Positive, InFile]
Number = Annotated[int, Field(ge=0)]
Power = Annotated[int, Field(ge=2, le=16)]


@dataclass(frozen=True, config=STRICT)
class Surface:
    """A surface and the medium behind it, which is air unless a glass is named.

    Parameters
    ----------
    semi_diameter, stop
        Clear semi-diameter in metres, and whether the surface is the aperture stop.
    radius
        Of curvature, in metres, positive with the centre behind the surface; None for a plane.
    thickness
        To the next surface along the axis, in metres. The last one's is unused: focusing sets it.
    nd, vd, index, glass
        Index and Abbe number of the medium behind, or its index at all wavelengths, or one of the bench's glasses.
    conic, asphere
        Conic constant, and pairs (power, coefficient) of Σ a r^power, in m^(1 - power); powers from 2 to 16.
    """

    semi_diameter: Opening
    radius: Annotated[Length | None, InFile] = None
    thickness: Annotated[Length, InFile] = 0.0
    nd: Annotated[float, Field(gt=1, lt=5)] | None = None
    vd: Annotated[float, Field(ge=10, le=120)] | None = None
    index: Annotated[float, Field(ge=1, lt=5)] | None = None
    glass: str | None = None
    conic: float = 0.0
    asphere: Annotated[tuple[tuple[Power, float], ...], BeforeValidator(_terms)] = ()
    stop: bool = False

    @model_validator(mode="after")
    def _has_one_medium(self) -> Surface:
        if self.radius is not None and abs(self.radius) < 1e-6:
            raise ValueError(f"a radius of {self.radius:g} m is that of no lens; leave it out for a flat surface")
        if (self.nd is None) != (self.vd is None):
            raise ValueError("nd and vd belong together; give both, or the index alone")
        if sum(one is not None for one in (self.nd, self.index, self.glass)) > 1:
            raise ValueError("two media behind one surface; give nd and vd, or index, or glass")
        if self.glass is not None:
            refractive_index(self.glass, 587.562e-9)
        powers = [power for power, _ in self.asphere]
        if len(set(powers)) != len(powers):
            raise ValueError(f"asphere gives a power twice, {powers}; give each one once")
        return self

    @property
    def air(self) -> bool:
        """Whether air lies behind it."""
        return self.nd is None and self.index is None and self.glass is None

    def index_at(self, wavelength: float) -> float:
        """Refractive index behind it, at a wavelength in metres."""
        if self.nd is not None and self.vd is not None:
            return index_from_abbe(self.nd, self.vd, wavelength)
        if self.glass is not None:
            return refractive_index(self.glass, wavelength)
        return 1.0 if self.index is None else self.index


@dataclass(frozen=True, config=STRICT)
class LensState:
    """A state of a lens, by its differences from the list of surfaces: a zoom has several, a prime lens one (`prime`).

    `f_number` and `half_field` (half of the field of view, radians) are as the source states them. `thickness` and
    `semi_diameter` are pairs (number of a surface, value in metres): the gaps that move, and the opening of the stop.
    """

    name: str
    f_number: Annotated[float, Field(gt=0.3, lt=200)] | None = None
    half_field: Annotated[Angle, Field(gt=0, lt=math.pi / 2)] | None = None
    thickness: Annotated[tuple[tuple[Number, Length], ...], BeforeValidator(_moves)] = ()
    semi_diameter: Annotated[tuple[tuple[Number, Positive], ...], BeforeValidator(_moves)] = ()


@dataclass(frozen=True, config=STRICT)
class Prescription:
    """A lens of the catalogue.

    Parameters
    ----------
    name, patent, source, use
        Its name here, where its numbers come from, and which lens it represents.
    surfaces, states
        In the order in which light meets them; one state, or those of a zoom by rising focal length.
    assumed
        What its sources do not say.
    focus
        What moves to focus: `unit` for the whole lens against the sensor, or the numbers of the first and the last
        surface of a group.
    """

    name: str
    source: str
    surfaces: Annotated[tuple[Surface, ...], Field(min_length=1, max_length=200)]
    states: Annotated[tuple[LensState, ...], Field(min_length=1, max_length=20)]
    patent: str | None = None
    use: str | None = None
    assumed: tuple[str, ...] = ()
    focus: Literal["unit"] | tuple[Number, Number] = "unit"

    @model_validator(mode="after")
    def _can_be_built(self) -> Prescription:
        stops = [i for i, surface in enumerate(self.surfaces) if surface.stop]
        if len(stops) != 1:
            found = "no surface is" if not stops else f"surfaces {stops} are"
            raise ValueError(f"{found} the aperture stop; give one surface 'stop: true'")
        if not self.surfaces[-1].air:
            raise ValueError("glass behind the last surface; end with a surface that has air behind it")
        last = len(self.surfaces) - 1
        for state in self.states:
            for number, _ in (*state.thickness, *state.semi_diameter):
                if number > last:
                    raise ValueError(f"state {state.name!r} names surface {number}; count from 0 to {last}")
        if self.focus != "unit" and not 0 < self.focus[0] <= self.focus[1] < last:
            raise ValueError(f"a group {list(self.focus)} cannot move; name surfaces from 1 to {last - 1}")
        for k in range(len(self.states)):
            self._check_gaps(k)
        return self

    def state(self, number: int) -> tuple[Surface, ...]:
        """The surfaces of one state."""
        state = self.states[number]
        return with_moves(self.surfaces, dict(state.thickness), dict(state.semi_diameter))

    def _check_gaps(self, number: int) -> None:
        """Refuse a surface that crosses the one before it; planes between equal media, such as a stop, are exempt."""
        lens = build_lens(self.state(number), 587.562e-9)
        n = lens.index.tolist()
        solid = [i for i in range(len(lens)) if n[i] != n[i + 1]]
        for a, b in itertools.pairwise(solid):
            gap, height = clearance(lens, a, b)
            if gap < -_TOUCHING * height:
                what = f"surfaces {a} and {b} cross {height:.4g} m from the axis, by {-gap:.2g} m"
                name = self.states[number].name
                raise ValueError(f"state {name!r}: {what}; mend the thickness or the semi_diameter")


def with_moves(
    surfaces: tuple[Surface, ...], thickness: dict[int, float], semi_diameter: dict[int, float]
) -> tuple[Surface, ...]:
    """The surfaces with other gaps behind some of them, and other openings."""
    return tuple(
        replace(one, thickness=thickness.get(i, one.thickness), semi_diameter=semi_diameter.get(i, one.semi_diameter))
        if i in thickness or i in semi_diameter
        else one
        for i, one in enumerate(surfaces)
    )


def build_lens(surfaces: tuple[Surface, ...], wavelength: float, scale: float = 1.0) -> Lens:
    """The tensors that rays are traced through, at a wavelength in metres, with all lengths times `scale`."""
    # Torch takes a second to import; a command's help must not wait for it.
    import torch

    from tapetum.optics.rays import Lens

    places = [0.0, *itertools.accumulate(one.thickness for one in surfaces[:-1])]
    highest = max((power for surface in surfaces for power, _ in surface.asphere), default=2)
    asphere = torch.zeros(len(surfaces), highest - 1, dtype=torch.float64)
    for i, surface in enumerate(surfaces):
        for power, coefficient in surface.asphere:
            asphere[i, power - 2] = coefficient * scale ** (1 - power)

    def tensor(values: list[float]) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.float64)

    return Lens(
        z=tensor(places) * scale,
        curvature=tensor([0.0 if one.radius is None else 1 / one.radius for one in surfaces]) / scale,
        conic=tensor([one.conic for one in surfaces]),
        asphere=asphere,
        semi_diameter=tensor([one.semi_diameter for one in surfaces]) * scale,
        index=tensor([1.0, *(one.index_at(wavelength) for one in surfaces)]),
        stop=next(i for i, one in enumerate(surfaces) if one.stop),
    )


def clearance(lens: Lens, first: int, second: int) -> tuple[float, float]:
    """The narrowest gap between two surfaces over their common aperture, and its distance from the axis."""
    import torch

    from tapetum.optics.rays import sag

    edge = float(torch.minimum(lens.semi_diameter[first], lens.semi_diameter[second]))
    r_squared = torch.linspace(0, 1, 65, dtype=torch.float64) * edge**2
    gap = lens.z[second] + sag(lens, second, r_squared)[0] - lens.z[first] - sag(lens, first, r_squared)[0]
    at = int(gap.argmin())
    return float(gap[at]), math.sqrt(float(r_squared[at]))
