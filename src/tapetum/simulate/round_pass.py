"""The double pass of a round lens before plane mirrors, gratings included: the fast engine.

Light that enters a round aperture, meets a plane mirror and returns to the lens is a round field F about a point that
the tilt displaces (docs/conventions.md, "The round pass"). With the tilt's sines s and its tangents t = s/cosθ:

    U3'(x) = √cosθ P(x) exp(ik x²(1/z - 1/f)/2) exp(ikz t²) F(|x - 2z t|)
    U5(q)  = √cosθ/(iλf_p) ∫ U3'(x) exp(-ik x·Mq/f_p) d²x

F is tabulated once for all gazes; a gaze costs one look-up for each sample of the pupil and one transform onto the
probe's pixels. A grating's order m of direction τ = mλ/p returns what a mirror would from the tangents t + τ/2. Every
plane has its own z, so pixel arrays and layers are sums of such terms.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch

from tapetum.errors import InputError
from tapetum.optics.fourier import phasor
from tapetum.optics.grid import Grid
from tapetum.optics.pupil import DiscRows
from tapetum.optics.radial import FocusTables, RadialTable, focus_tables, returning_field
from tapetum.optics.sampling import DoublePassGeometry, RoundPlan
from tapetum.simulate.foreshortening import cosines, foreshortens, tangents, twisted
from tapetum.simulate.probe_path import ProbeAperture, ProbePath
from tapetum.simulate.surfaces import Order, PlaceSeries, Surface
from tapetum.simulate.true_paths import Leg, TruePaths, neglected_path

__all__ = ["Order", "PlaceSeries", "RoundPass", "Surface"]

# Samples of pupils looked up at a time: their memory fits the processor's caches.
_SAMPLES_AT_ONCE = 1 << 18
# Samples up to which the lens's phase and weights are kept; larger pupils recompute them for each band.
_SAMPLES_KEPT = 1 << 24
# Degree of the pupil's end correction: with these few samples a higher one amplifies the faint steep light.
_END_ORDER = 3
# Share of the expected error, in radians, below which a path beyond the table is neglected.
_SHARE_MISSED = 0.25
# Bytes that automatic differentiation keeps for each pupil sample (some forty numbers), and may keep in all.
_BYTES_OF_GRAPH, _MOST_GRAPH = 800, 6 << 30
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
        self._probe_radius = probe_radius
        self._paths = TruePaths(
            self._k,
            values["radius"] if self._lit is None else self._lit,
            values["focal_length"],
            values["curvature"],
            None if self._distance is None or distance is None else self._scalar(distance),
            probe_radius,
        )
        self._surfaces = [self._prepare(one) for one in surfaces]

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
            prepared = replace(prepared, exit=self._leaving(prepared, slice(0, self.plan.rows)))
        return prepared

    def _leaving(self, one: _Prepared, rows: slice) -> torch.Tensor:
        """Factor of the lens on the way out: weight, phase, constants, a single order's amplitude; [rows, columns]."""
        if one.exit is not None:
            return one.exit[rows]
        across = phasor(one.bend * self._x**2).to(self.dtype)
        down = (phasor(one.bend * self._y[rows] ** 2) * self._path.constant * one.amplitude).to(self.dtype)
        weights = self._disc.weights(rows, torch.float64 if self.differentiable else self._real)
        return (weights * self._values["radius"] ** 2).to(self._real) * down[:, None] * across[None, :]

    def __call__(self, sines: torch.Tensor, centres: torch.Tensor | None = None) -> torch.Tensor:
        """Irradiance [B, H, W] on the probe's pixels, in W/m² for 1 W/m² at the target and the surfaces' amplitudes.

        `sines` [B, 2] are those of the tilt along x and y; `centres` [B, 2] place the RR's own centre on the probe's
        sensor, in metres, by default in the middle.
        """
        u = self.field(sines, centres)
        return torch.addcmul(u.real.square(), u.imag, u.imag)

    def field(self, sines: torch.Tensor, centres: torch.Tensor | None = None) -> torch.Tensor:
        """Complex amplitude U5 on the probe's pixels, [B, H, W], in W^½/m; arguments as for the call."""
        sines = sines.to(self.device, torch.float64)
        if centres is not None:
            centres = centres.to(self.device, torch.float64)
        if self.differentiable or sines.requires_grad:
            return self._field(sines, centres)
        size = max(1, _SAMPLES_AT_ONCE // (self.plan.columns * self.plan.rows))
        parts = [
            self._field(sines[i : i + size], None if centres is None else centres[i : i + size])
            for i in range(0, len(sines), size)
        ]
        return torch.cat(parts) if len(parts) != 1 else parts[0]

    def exit_pupil(self, sines: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Field that leaves the lens, tilt removed, [B, rows, columns], with x [columns], y [rows] and weights.

        Its squared modulus is the power through a unit area of the lens, for 1 W/m² across the incoming light.
        """
        sines = sines.to(self.device, torch.float64)
        weights = self._disc.weights(slice(0, self.plan.rows)) * self._values["radius"] ** 2
        rho_squared = self._x[None, :] ** 2 + self._y[:, None] ** 2
        known = weights * phasor(self._path.chirp * rho_squared) * self._path.constant
        inside = weights != 0
        field = self._pupil(sines, slice(0, self.plan.rows), False)
        field = torch.where(inside, field / torch.where(inside, known, torch.ones_like(known)).to(self.dtype), 0)
        return field * torch.sqrt(cosines(sines))[:, None, None].to(self._real), self._x, self._y, weights

    def _field(self, sines: torch.Tensor, centres: torch.Tensor | None) -> torch.Tensor:
        twist = foreshortens(self, sines)
        # Pupils too large for the caches are computed in bands of rows.
        whole = self.differentiable or sines.requires_grad
        if whole:
            self._check_graph(len(sines))
        band = self.plan.rows if whole else max(1, 4 * _SAMPLES_AT_ONCE // (len(sines) * self.plan.columns))
        gathered: torch.Tensor | None = None
        for start in range(0, self.plan.rows, band):
            rows = slice(start, start + band)
            part = self._path.gather(self._pupil(sines, rows, twist), rows, sines if twist else None, centres)
            gathered = part if gathered is None else gathered + part
        assert gathered is not None
        # The tilted lens receives cosθ of the light, and its return spreads over a foreshortened picture.
        gathered = gathered * cosines(sines)[:, None, None].to(self._real)
        return self._path.to_image(gathered, centres)

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

    def _pupil(self, sines: torch.Tensor, rows: slice, twist: bool) -> torch.Tensor:
        """Rows of the field that leaves the lens, with weights and constants: [B, rows, columns]."""
        total: torch.Tensor | None = None
        slopes = tangents(sines)
        for one in self._surfaces:
            of_orders: torch.Tensor | None = None
            followed = self._follows(one, sines)
            # Where the gaze's chief ray meets the plane.
            z = one.z / (1 - slopes @ one.tilt) if one.tilted else one.z.expand(len(sines))
            for order in one.orders:
                tau = torch.tensor(order.direction, dtype=torch.float64, device=self.device)
                if followed:
                    value = self._followed(one, sines, slopes, tau, z, rows, twist)
                else:
                    seen = slopes + tau / 2
                    value = self._looked_up(one, twisted(seen, sines) if twist else seen, rows)
                amplitude = order.at(z[:, None] * slopes)
                if self._interferes:
                    # The mirror's phase k z t², and the order's: k z (t + τ/2)² - k z τ²/4.
                    phase = self._k * z * ((slopes**2).sum(-1) + (slopes * tau).sum(-1)) + one.phase
                    value = value * (phasor(phase) * amplitude).to(self.dtype)[:, None, None]
                elif isinstance(amplitude, torch.Tensor):
                    value = value * amplitude.to(self.dtype)[:, None, None]
                elif amplitude != 1:
                    value = value * amplitude
                of_orders = value if of_orders is None else of_orders + value
            if of_orders is not None:
                leaving = self._leaving(one, rows)
                kept = of_orders.requires_grad or leaving.requires_grad
                term = of_orders * leaving if kept else of_orders.mul_(leaving)
                total = term if total is None else total + term
        if total is None:
            shape = (len(sines), len(self._y[rows]), len(self._x))
            return torch.zeros(shape, dtype=self.dtype, device=self.device)
        return total

    def _follows(self, one: _Prepared, sines: torch.Tensor) -> bool:
        """Whether these gazes need paths beyond the table."""
        if one.tilted:
            return True
        if sines.requires_grad and (self.geometry.curvature or self._distance is not None):
            return True
        steepest = float((sines.detach() ** 2).sum(-1).max().sqrt()) if len(sines) else 0.0
        missed = neglected_path(
            self.geometry, steepest, distance=self._distance, probe_radius=self._probe_radius or 0.0
        )
        return float(self._k.detach()) * missed > _SHARE_MISSED * min(self.plan.expected_error, 1e-2)

    def _followed(
        self,
        one: _Prepared,
        sines: torch.Tensor,
        slopes: torch.Tensor,
        tau: torch.Tensor,
        z: torch.Tensor,
        rows: slice,
        twist: bool,
    ) -> torch.Tensor:
        """As `_looked_up`, along the light's true paths."""
        tilt = one.tilt.expand(len(sines), -1)
        # Along a tilted plane the path to it grows by less than the plane's own a·v.
        turn = tau - (slopes**2).sum(-1, keepdim=True) * tilt
        vectors = (sines, slopes, turn, tilt)
        if twist:
            vectors = tuple(twisted(vector, sines) for vector in vectors)
        leg = Leg(vectors[0], vectors[1], vectors[2], z, vectors[3] if one.tilted else None)
        across, down, factor = self._paths(self._x, self._y[rows], leg, one.z)
        value = one.tables.at(torch.sqrt((across**2 + down**2).clamp_min(1e-24)), z, one.moves)
        return value.to(self.dtype) * factor.to(self.dtype)

    def _looked_up(self, one: _Prepared, seen: torch.Tensor, rows: slice) -> torch.Tensor:
        """F(|x - 2z t|) at the pupil's samples, [B, rows, columns], for the tangents seen [B, 2]."""
        offset = 2 * one.z * seen
        table = one.tables.only
        across = ((self._x[None, :] - offset[:, 0:1]) / table.step) ** 2
        down = ((self._y[None, rows] - offset[:, 1:2]) / table.step) ** 2
        if self.differentiable or seen.requires_grad or self.dtype == torch.complex128:
            # The root has no gradient at zero: a zero distance counts as a billionth of a step.
            steps = torch.sqrt((down[:, :, None] + across[:, None, :]).clamp_min(1e-18))
            return table.smooth(steps, **one.moves).to(self.dtype)
        steps = (down.to(self._real)[:, :, None] + across.to(self._real)[:, None, :]).sqrt_()
        return table.nearest(steps)
