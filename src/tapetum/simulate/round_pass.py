"""The double pass of a round lens before plane mirrors, gratings included: the fast engine.

Light that enters a round aperture, meets a plane mirror and returns to the lens is a round field F about a point that
the tilt displaces (docs/conventions.md, "The round pass"). With the tilt's sines s and its tangents t = s/cosθ:

    U3'(x) = √cosθ P(x) exp(ik x²(1/z - 1/f)/2) exp(ikz t²) F(|x - 2z t|)
    U5(q)  = √cosθ/(iλf_p) ∫ U3'(x) exp(-ik x·Mq/f_p) d²x

F is tabulated once for all gazes; a gaze costs one look-up for each sample of the pupil and one transform onto the
probe's pixels. A grating's order m of direction τ = mλ/p returns what a mirror would from the tangents t + τ/2. Every
plane has its own z, so pixel arrays and layers are sums of such terms.

One file of somewhat more than 400 lines: what is prepared for all gazes and what a gaze adds are read together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import torch

from tapetum.errors import InputError
from tapetum.optics.fourier import phasor
from tapetum.optics.grid import Grid
from tapetum.optics.pupil import DiscRows
from tapetum.optics.radial import FocusTables, RadialTable, focus_tables, returning_field
from tapetum.optics.sampling import DoublePassGeometry, RoundPlan
from tapetum.simulate.foreshortening import Tilts, flattest
from tapetum.simulate.probe_path import Band, ProbeAperture, ProbePath
from tapetum.simulate.surfaces import Order, PlaceSeries, Surface
from tapetum.simulate.true_paths import Leg, TruePaths, neglected_path

__all__ = ["Order", "PlaceSeries", "RoundPass", "Surface"]

# Samples of pupils that each processor looks up at a time: many enough to share what a gaze costs besides them, few
# enough that their memory fits its caches.
_SAMPLES_AT_ONCE = 1 << 21
# Bands of rows that the upper half is cut into, so that those near its edge are as short as their chords.
_BANDS = 3
# Samples up to which the lens's phase and weights are kept; larger pupils recompute them for each band.
_SAMPLES_KEPT = 1 << 24
# Degree of the pupil's end correction: with these few samples a higher one amplifies the faint steep light.
_END_ORDER = 3
# Share of the expected error, in radians, below which a path beyond the table is neglected.
_SHARE_MISSED = 0.25
# Bytes that automatic differentiation keeps for each pupil sample (some forty numbers), and may keep in all.
_BYTES_OF_GRAPH, _MOST_GRAPH = 800, 6 << 30
# Values [B, 2, rows, columns] at some rows of the pupil's upper half with their partners -y, and some columns.
_Part = Callable[[slice, slice], torch.Tensor]
_PARAMETERS = ("wavelength", "radius", "focal_length", "curvature", "probe_focal_length")


@dataclass(frozen=True)
class _Prepared:
    """Data of a surface for every gaze."""

    z: torch.Tensor
    tables: FocusTables
    bend: torch.Tensor
    orders: tuple[Order, ...]
    phase: float
    tilt: torch.Tensor
    moves: dict[str, torch.Tensor] = field(default_factory=dict[str, torch.Tensor])
    exit: torch.Tensor | None = None
    # Of a single order that is the same for every gaze; it is taken out of the order and put into `exit`.
    amplitude: complex = 1.0

    @property
    def tilted(self) -> bool:
        """Whether the plane's distance changes with the gaze."""
        return bool(self.tilt.any())


def _at_once() -> int:
    return _SAMPLES_AT_ONCE * torch.get_num_threads()


class RoundPass:
    """The retro-reflection of a thin lens, for any number of gazes; its tables are computed once, with the instance.

    Parameters
    ----------
    geometry
        Lengths of the scene, as numbers.
    plan
        Its sampling.
    output
        Pixels of the probe's sensor.
    surfaces
        Planes that reflect, summed coherently. Default: one mirror at the geometry's image distance.
    distance, probe_radius
        Both given, the light travels the distance and through the probe's round aperture, in metres; the plan must be
        made for it (`optics.sampling.through_aperture`). Default: all light reaches the probe's sensor.
    lit_radius
        Of a beam narrower than the aperture, in metres.
    interferes
        Whether the field meets others', so that even a single plane needs its phase.
    aside
        A coarser plan for gazes of squared sines above a number, from `optics.sampling.plan_aside`.
    parameters
        Tensors that carry gradients, in place of the geometry's numbers: `focal_length`, `radius`, `wavelength`,
        `curvature`, `probe_focal_length`; a surface carries its own image distance.
    dtype
        complex64 or complex128.
    device
        Where to compute.
    """

    def __init__(
        self,
        geometry: DoublePassGeometry,
        plan: RoundPlan,
        output: Grid,
        surfaces: Sequence[Surface] = (),
        *,
        distance: torch.Tensor | float | None = None,
        probe_radius: float | None = None,
        lit_radius: float | None = None,
        interferes: bool = False,
        aside: tuple[RoundPlan, float] | None = None,
        dtype: torch.dtype = torch.complex64,
        device: torch.device | str = "cpu",
        **parameters: torch.Tensor | float,
    ) -> None:
        self.geometry, self.plan, self.output, self.dtype = geometry, plan, output, dtype
        self.device = torch.device(device)
        self._real = torch.float32 if dtype == torch.complex64 else torch.float64
        numbers: dict[str, torch.Tensor | float] = {**vars(geometry), **parameters}
        values = {name: self._scalar(numbers[name]) for name in _PARAMETERS}
        surfaces = tuple(surfaces) or (Surface(geometry.image_distance),)
        lengths = [self._scalar(one.image_distance) for one in surfaces]
        if distance is not None:
            lengths.append(self._scalar(distance))
        self.differentiable = any(value.requires_grad for value in (*values.values(), *lengths))
        self._values = values
        self._k = 2 * math.pi / values["wavelength"]
        self._wavenumber = float(self._k.detach())
        self._disc = DiscRows(1.0, plan.columns, plan.rows, _END_ORDER, self.device)
        self._x, self._y = self._disc.x * values["radius"], self._disc.y * values["radius"]
        aperture = None
        if distance is not None and probe_radius is not None:
            aperture = ProbeAperture.behind_thin(geometry, distance, probe_radius)
        self._path = ProbePath(
            output,
            self._x,
            self._y,
            wavelength=values["wavelength"],
            probe_focal_length=values["probe_focal_length"],
            aperture=aperture,
            dtype=dtype,
            device=self.device,
        )
        directions = [math.hypot(*order.direction) for one in surfaces for order in one.orders]
        self._steepest = geometry.tangent + max(directions, default=0.0) / 2
        # A single plane needs no phase: nothing interferes with it.
        self._interferes = interferes or sum(len(one.orders) for one in surfaces) > 1
        self._lit: torch.Tensor | None = None
        if lit_radius is not None and lit_radius < geometry.radius:
            self._lit = self._scalar(lit_radius)
        self._distance = None if distance is None or probe_radius is None else float(self._scalar(distance).detach())
        self._paths = TruePaths(
            self._k,
            values["radius"] if self._lit is None else self._lit,
            values["focal_length"],
            values["curvature"],
            None if self._distance is None or distance is None else self._scalar(distance),
        )
        self._given, self._aside_plan = surfaces, aside
        options: dict[str, Any] = {"probe_radius": probe_radius, "lit_radius": lit_radius, "interferes": interferes}
        options |= {"distance": distance, "dtype": dtype, "device": device, **parameters}
        self._again = partial(RoundPass, geometry, output=output, surfaces=surfaces, **options)

    @cached_property
    def _surfaces(self) -> list[_Prepared]:
        """The planes with their tables, computed for the first gaze."""
        return [self._prepare(one) for one in self._given]

    @cached_property
    def _aside(self) -> RoundPass:
        assert self._aside_plan is not None
        return self._again(plan=self._aside_plan[0])

    def _scalar(self, value: torch.Tensor | float) -> torch.Tensor:
        return torch.as_tensor(value, dtype=torch.float64, device=self.device)

    def _prepare(self, surface: Surface) -> _Prepared:
        values, z = self._values, self._scalar(surface.image_distance)
        lit = values["radius"] if self._lit is None else self._lit
        wavelength, radius, z_now = (float(v.detach()) for v in (values["wavelength"], values["radius"], z))
        vergence = values["curvature"] - 1 / values["focal_length"]
        tilt = torch.tensor(surface.tilt, dtype=torch.float64, device=self.device)

        def table(image_distance: float) -> RadialTable:
            # Light along the tilt is read where a round lens's would be: slightly farther out.
            moved = 1 + 1.5 * abs(self.geometry.curvature) * self.geometry.sine**2 * 2 * self.geometry.focal_length
            return returning_field(
                wavelength,
                float(lit.detach()),
                image_distance,
                float(vergence.detach()),
                # Only the end correction reads beyond the pupil's edge: a few samples.
                moved * (1.05 * radius + 2 * image_distance * self._steepest * (1 + 1e-6)),
                (self.plan.flat_slope, self.plan.end_slope),
                partials=self.differentiable,
            ).to(self.device, self.dtype)

        reach = math.hypot(*surface.tilt) * self.geometry.tangent
        error = 1e-6 if self.dtype == torch.complex128 else 0.03 * min(self.plan.expected_error, 1e-2)
        if self.differentiable:
            # In a derivative by the focal length what the tables' weights change and what the tables themselves change
            # nearly cancel.
            error = 1e-12
        tables = focus_tables(table, z_now, reach, float(self._k.detach()) * float(lit.detach()) ** 2, error)
        moving = {"image_distance": z, "vergence": vergence, "radius": lit, "wavenumber": self._k}
        if len(tables.nodes) > 1:
            # Each table keeps its own distance; the weights between tables follow the gaze's.
            del moving["image_distance"]
        moves = {name: value - value.detach() for name, value in moving.items() if value.requires_grad}
        bend = self._k / 2 * (1 / z - 1 / values["focal_length"]) + self._path.chirp
        orders, amplitude = surface.orders, 1.0 + 0j
        if len(orders) == 1 and orders[0].series is None:
            amplitude, orders = orders[0].amplitude, (replace(orders[0], amplitude=1.0),)
        prepared = _Prepared(z, tables, bend, orders, surface.phase, tilt, moves, amplitude=amplitude)
        if self.plan.columns * self.plan.rows <= _SAMPLES_KEPT:
            prepared = replace(prepared, exit=self._leaving(prepared, slice(0, self.plan.rows), slice(None)))
        return prepared

    def _leaving(self, one: _Prepared, rows: slice, columns: slice) -> torch.Tensor:
        """Factor of the lens on the way out: weight, phase, constants, a single order's amplitude; [rows, columns]."""
        if one.exit is not None:
            return one.exit[rows, columns]
        across = phasor(one.bend * self._x[columns] ** 2).to(self.dtype)
        down = (phasor(one.bend * self._y[rows] ** 2) * self._path.constant * one.amplitude).to(self.dtype)
        weights = self._disc.weights(rows, torch.float64 if self.differentiable else self._real)[:, columns]
        return (weights * self._values["radius"] ** 2).to(self._real) * down[:, None] * across[None, :]

    def __call__(self, sines: torch.Tensor, centres: torch.Tensor | None = None) -> torch.Tensor:
        """Irradiance [B, H, W] on the probe's pixels, in W/m² for 1 W/m² at the target and the surfaces' amplitudes.

        `sines` [B, 2] are those of the tilt along x and y; `centres` [B, 2] place the RR's own centre on the probe's
        sensor, in metres, by default in the middle.
        """
        return self._images(sines, centres, squared=True)

    def field(self, sines: torch.Tensor, centres: torch.Tensor | None = None) -> torch.Tensor:
        """Complex amplitude U5 on the probe's pixels, [B, H, W], in W^½/m; arguments as for the call."""
        return self._images(sines, centres, squared=False)

    def _images(self, sines: torch.Tensor, centres: torch.Tensor | None, *, squared: bool) -> torch.Tensor:
        gazes, flat = self._gazes(sines, centres), 0.0 if self._precise else flattest(self)
        if self.differentiable or sines.requires_grad or (centres is not None and centres.requires_grad):
            return self._some(gazes.some(slice(None), flat), squared)
        if self._aside_plan is not None and max(gazes.size, default=0.0) > self._aside_plan[1]:
            least = self._aside_plan[1]
            return self._split(gazes, self._aside, [one > least for one in gazes.size], squared)
        # Each gaze by itself, so that its image is the same whichever gazes are drawn with it: a fit compares them.
        tests: tuple[Callable[[float], bool], ...] = (lambda size: size > flat, self._beyond_table)
        for steep in tests:
            if gazes.size and steep(max(gazes.size)) and not steep(min(gazes.size)):
                return self._split(gazes, self, [steep(one) for one in gazes.size], squared)
        count = max(1, _at_once() // (self.plan.columns * self.plan.rows))
        dtype = self._real if squared else self.dtype
        images = torch.empty(len(sines), *self._path.shape, dtype=dtype, device=self.device)
        for i in range(0, len(sines), count):
            images[i : i + count] = self._some(gazes.some(slice(i, i + count), flat), squared)
        return images

    def _split(self, gazes: Tilts, other: RoundPass, which: Sequence[bool], squared: bool) -> torch.Tensor:
        """The same, some of the gazes apart by the other pass."""
        some = torch.tensor(which, device=self.device)
        if bool(some.all()):
            return other._images(gazes.sines, gazes.centres, squared=squared)
        dtype = self._real if squared else self.dtype
        images = torch.empty(len(gazes.size), *self._path.shape, dtype=dtype, device=self.device)
        for one, part in ((other, some), (self, ~some)):
            centres = None if gazes.centres is None else gazes.centres[part]
            images[part] = one._images(gazes.sines[part], centres, squared=squared)
        return images

    def _gazes(self, sines: torch.Tensor, centres: torch.Tensor | None = None) -> Tilts:
        if centres is not None:
            centres = centres.to(self.device, torch.float64)
        return Tilts.of(sines.to(self.device, torch.float64), centres)

    def exit_pupil(self, sines: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Field that leaves the lens, tilt removed, [B, rows, columns], with x [columns], y [rows] and weights.

        Its squared modulus is the power through a unit area of the lens, for 1 W/m² across the incoming light.
        """
        gazes = self._gazes(sines).some(slice(None), math.inf)
        weights = self._disc.weights(slice(0, self.plan.rows)) * self._values["radius"] ** 2
        rho_squared = self._x[None, :] ** 2 + self._y[:, None] ** 2
        known = weights * phasor(self._path.chirp * rho_squared) * self._path.constant
        inside = weights != 0
        half, columns = slice(0, (self.plan.rows + 1) // 2), slice(0, self.plan.columns)
        upper, lower = self._pupil(self._terms(gazes), len(gazes.sines), half, columns).unbind(1)
        field = torch.cat([upper, lower[:, : self.plan.rows // 2].flip(1)], 1)
        field = torch.where(inside, field / torch.where(inside, known, torch.ones_like(known)).to(self.dtype), 0)
        return field * torch.sqrt(gazes.cosines)[:, None, None].to(self._real), self._x, self._y, weights

    def _some(self, gazes: Tilts, squared: bool) -> torch.Tensor:
        """Irradiance or field of gazes computed at once."""
        # Pupils too large for the caches are computed in bands of rows.
        whole = self.differentiable or gazes.sines.requires_grad
        if whole:
            self._check_graph(len(gazes.sines))
        half, terms = (self.plan.rows + 1) // 2, self._terms(gazes)
        band = min(_at_once() // (2 * len(gazes.sines) * self.plan.columns), math.ceil(half / _BANDS))
        band = half if whole else max(1, band)

        def bands() -> Iterator[Band]:
            for start in range(0, half, band):
                rows = slice(start, min(start + band, half))
                columns = slice(0, self.plan.columns) if whole else self._disc.spanned(rows)
                upper, lower = self._pupil(terms, len(gazes.sines), rows, columns).unbind(1)
                yield self._path.pairs(upper, lower, rows, columns, gazes.centres, gazes.triangle)

        # The tilted lens receives cosθ of the light, and its return spreads over a foreshortened picture.
        gathered = self._path.gather(bands(), gazes.triangle) * gazes.cosines[:, None, None].to(self._real)
        return self._path.to_image(gathered, gazes.centres, squared=squared)

    def _check_graph(self, batch: int) -> None:
        """Refuse gradients that exceed the memory: they keep every step of every sample."""
        needed = _BYTES_OF_GRAPH * batch * self.plan.columns * self.plan.rows
        if needed > _MOST_GRAPH:
            raise InputError(
                f"gradients over {self.plan.columns} x {self.plan.rows} samples and {batch} gazes need some "
                f"{needed / 2**30:.0f} GiB, above the {_MOST_GRAPH / 2**30:.0f} GiB allowed",
                where="sampling",
                remedy="take fewer gazes at a time, ask for less accuracy, or stop the target's aperture down",
            )

    def _pupil(self, terms: Sequence[tuple[_Prepared, _Part]], count: int, rows: slice, columns: slice) -> torch.Tensor:
        """The field that leaves the lens, with weights and constants: [B, 2, rows, columns].

        Of some columns, and some rows of the upper half with their partners -y, in the same order.
        """
        total: torch.Tensor | None = None
        for one, part in terms:
            value, leaving = part(rows, columns), self._leaving(one, rows, columns)
            kept = value.requires_grad or leaving.requires_grad
            value = value * leaving if kept else value.mul_(leaving)
            total = value if total is None else total + value
        if total is None:
            shape = count, 2, len(self._y[rows]), len(self._x[columns])
            return torch.zeros(shape, dtype=self.dtype, device=self.device)
        return total

    def _terms(self, gazes: Tilts) -> list[tuple[_Prepared, _Part]]:
        """Each plane's light before it passes the lens again, for any part of the pupil."""
        return [(one, self._returning(one, gazes)) for one in self._surfaces if one.orders]

    def _returning(self, one: _Prepared, gazes: Tilts) -> _Part:
        """All orders of a plane."""
        slopes, followed = gazes.slopes, self._follows(one, gazes)
        # Where the gaze's chief ray meets the plane.
        z = one.z / (1 - slopes @ one.tilt) if one.tilted else one.z.expand(len(slopes))
        found: list[tuple[_Part, torch.Tensor | complex]] = []
        for order in one.orders:
            tau = torch.tensor(order.direction, dtype=torch.float64, device=self.device)
            if followed:
                part = self._followed(one, gazes, tau, z)
            else:
                part = self._looked_up(one, gazes.framed(slopes + tau / 2))
            amplitude = order.at(z[:, None] * slopes)
            if self._interferes:
                # The mirror's phase k z t², and the order's: k z (t + τ/2)² - k z τ²/4.
                phase = self._k * z * ((slopes**2).sum(-1) + (slopes * tau).sum(-1)) + one.phase
                amplitude = phasor(phase) * amplitude
            if isinstance(amplitude, torch.Tensor):
                amplitude = amplitude.to(self.dtype)[:, None, None, None]
            found.append((part, amplitude))

        def all_orders(rows: slice, columns: slice) -> torch.Tensor:
            total: torch.Tensor | None = None
            for part, amplitude in found:
                value = part(rows, columns)
                if isinstance(amplitude, torch.Tensor) or amplitude != 1:
                    value = value * amplitude
                total = value if total is None else total + value
            assert total is not None
            return total

        return all_orders

    @property
    def _precise(self) -> bool:
        """Whether nothing is left out for speed: in double precision, in which fits compare images and differentiate.

        What is left out within the asked error changes by a jump where the tilt passes a threshold, and biases a fit of
        what the images hardly show.
        """
        return self.dtype == torch.complex128

    def _follows(self, one: _Prepared, gazes: Tilts) -> bool:
        """Whether these gazes need paths beyond the table."""
        if one.tilted:
            return True
        if gazes.sines.requires_grad:
            return bool(self.geometry.curvature) or self._distance is not None
        return self._beyond_table(max(gazes.size, default=0.0))

    def _beyond_table(self, size: float) -> bool:
        """Whether a gaze with this square of its sines needs paths beyond the table."""
        if self._precise:
            return True
        missed = neglected_path(self.geometry, math.sqrt(size), distance=self._distance)
        return self._wavenumber * missed > _SHARE_MISSED * min(self.plan.expected_error, 1e-2)

    def _followed(self, one: _Prepared, gazes: Tilts, tau: torch.Tensor, z: torch.Tensor) -> _Part:
        """As `_looked_up`, along the light's true paths."""
        tilt = one.tilt.expand(len(z), -1)
        # Along a tilted plane the path to it grows by less than the plane's own a·v.
        turn = tau - (gazes.slopes**2).sum(-1, keepdim=True) * tilt
        vectors = tuple(gazes.framed(vector) for vector in (gazes.sines, gazes.slopes, turn, tilt))
        leg = Leg(vectors[0], vectors[1], vectors[2], z, vectors[3] if one.tilted else None)

        def part(rows: slice, columns: slice) -> torch.Tensor:
            y = torch.cat([self._y[rows], -self._y[rows]])
            across, down, factor = self._paths(self._x[columns], y, leg, one.z)
            value = one.tables.at(torch.sqrt((across**2 + down**2).clamp_min(1e-24)), z, one.moves)
            value = value.to(self.dtype) * factor.to(self.dtype)
            return value.reshape(len(z), 2, -1, value.shape[-1])

        return part

    def _looked_up(self, one: _Prepared, seen: torch.Tensor) -> _Part:
        """F(|x - 2z t|) for the tangents seen [B, 2]."""
        offset, table = 2 * one.z * seen, one.tables.only
        half = self._y[: (self.plan.rows + 1) // 2]
        across = ((self._x - offset[:, 0:1]) / table.step) ** 2
        down = ((torch.stack([half, -half]) - offset[:, 1:2, None]) / table.step) ** 2
        if self.differentiable or seen.requires_grad or self.dtype == torch.complex128:

            def smooth(rows: slice, columns: slice) -> torch.Tensor:
                square = down[:, :, rows, None] + across[:, None, None, columns]
                # The root has no gradient at zero: a zero distance counts as a billionth of a step.
                return table.smooth(torch.sqrt(square.clamp_min(1e-18)), **one.moves).to(self.dtype)

            return smooth
        down, across = down.to(self._real)[..., None], across.to(self._real)[:, None, None]

        def nearest(rows: slice, columns: slice) -> torch.Tensor:
            return table.nearest((down[:, :, rows] + across[..., columns]).sqrt_())

        return nearest
