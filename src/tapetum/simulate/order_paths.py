"""The paths of an array's orders out of a traced lens, far out of focus, by rays.

The model's way out is exact to first order in v, the place of the spot, and a mirror's light is corrected where it
leaves (traced_return). An order of direction D sends the ray that meets v out by another place than a mirror does,
where that correction is another light's. So each order's light is turned on the sensor, where it meets v, by

    X(v, D) = E(v, e) - c(e),    e = e(v, d(v) + D)

d(v) are the direction cosines of the ray that enters, d + D those of the one that leaves, e where it crosses the
entrance pupil, E how much longer its path from v to e is than the model's, and c what the pupils of the light that
leaves already add to it there. E and e are polynomials fitted to rays of all places and directions: they hold for any
order at any azimuth of the tilt. Light that misses the pupil counts as that which v sends to the pupil's rim.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import torch
from scipy.stats import qmc  # pyright: ignore[reportMissingTypeStubs]

from tapetum.optics.focus import FocusedLens
from tapetum.optics.rays import trace_out
from tapetum.simulate.pupil_fits import (
    MAP_DEGREE,
    Fit,
    PupilFits,
    TiltNodes,
    basis,
    boxes,
    first_at,
    fit_functions,
    least_squares,
    values_at,
)
from tapetum.simulate.pupil_rim import leaving_by
from tapetum.simulate.traced_bundle import length, trace_bundle

__all__ = ["PLACES", "OrderPaths", "order_paths"]

# Places across the spot between which X is interpolated, and how far that is off for X ∝ v², over its largest value.
PLACES, _INTERPOLATED = 11, 0.01
# Degrees of E and e in v and in the other argument, of d(v), and of Ψ(e).
_PLACE_DEGREE, _WAY_DEGREE, _ENTERING_DEGREE, _PATH_DEGREE = 3, 5, 8, 16
# Places v and directions that are traced: to fit, and to check. Squared distance of those from a box's middle, in half
# widths.
_TRACED, _CHECKED, _NEAR = 2048, 512, 1.1
# The box about directions is wider than that of light from y0, by which it is found: places aside see the pupil aside.
_WIDER = 1.15
# Squared height over a rim's up to which rays are fitted.
_STRAY = 1.15


@dataclass(frozen=True)
class OrderPaths:
    """X(v, D) of the module, for tilts on `nodes`.

    `entering` holds d of places v: along the tilt, and across it as the odd function. `usual` is the pupil that light
    from y0 leaves by, Ψ(e), s along the tilt and across it, and `leaving` that of the pass, which adds c to Ψ. `centre`
    and `half` [T, 2] are coefficients in the tilt of the box about directions o; `excess` [T, M] those of E(v, e),
    `along` [T, M] and `across` [T, K] of e(v, o). `misfit` is the worst RMS error of X at tilts between the nodes,
    `departure` the worst RMS of X itself, both against a mirror's light, over all that leaves, in metres.
    """

    nodes: TiltNodes
    entering: Fit
    usual: Fit
    leaving: Fit
    centre: torch.Tensor
    half: torch.Tensor
    excess: torch.Tensor
    along: torch.Tensor
    across: torch.Tensor
    misfit: float = 0.0
    departure: float = 0.0

    def to(self, device: torch.device) -> OrderPaths:
        """The same on another device."""
        moved = {name: value.to(device) for name, value in vars(self).items() if isinstance(value, Fit | torch.Tensor)}
        return replace(self, **moved)

    @property
    def between(self) -> float:
        """What X is off by between the `PLACES` at which it is computed, in metres."""
        return _INTERPOLATED * self.departure

    def spot(self, tilt: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Middle and half widths [B, 2] of the box about the spot's rays at tilts given as `TiltNodes.terms` [B, T]."""
        return tilt @ self.entering.centre, tilt @ self.entering.half

    def at(self, tilt: torch.Tensor, places: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """X [B, M, N] in metres at places v [B, N, 2], across and along the tilt, of M orders' directions [B, M, 2]."""
        places = _within(places, *self.spot(tilt))
        way = self.enters(tilt, places)[:, None] + directions[:, :, None]
        return self.added(tilt, places, self.leaves_at(tilt, places, way))

    def enters(self, tilt: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        """d [B, N, 2] of light that meets places v [B, N, 2]: a mirror sends it out in the same direction across."""
        even, odd = values_at(self.entering, tilt, v)
        return torch.stack([odd[:, 0], even[:, 0]], -1)

    def leaves_at(self, tilt: torch.Tensor, v: torch.Tensor, way: torch.Tensor) -> torch.Tensor:
        """e [B, M, N, 2] of light that leaves places v [B, N, 2] in directions o [B, M, N, 2]."""
        box = tilt @ self.centre, tilt @ self.half
        place = _products(_scaled(v, *self.spot(tilt)), _PLACE_DEGREE)
        to = _products(_scaled(_within(way, *box), *box), _WAY_DEGREE)
        return torch.stack([_sum(tilt @ self.across, place, to, 1), _sum(tilt @ self.along, place, to, 0)], -1)

    def added(self, tilt: torch.Tensor, v: torch.Tensor, e: torch.Tensor) -> torch.Tensor:
        """E - c [B, M, N] of light from v [B, N, 2] that leaves at e [B, M, N, 2]."""
        e = _within(e, *self.pupil(tilt))
        place = _products(_scaled(v, *self.spot(tilt)), _PLACE_DEGREE)
        excess = _sum(tilt @ self.excess, place, _products(_scaled(e, *self.whole(tilt)), _WAY_DEGREE), 0)
        return excess - self.known(tilt, e)

    def pupil(self, tilt: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Middle and half widths [B, 2] of the box about the pupil, or the part of it, that light leaves by."""
        return tilt @ self.leaving.centre, tilt @ self.leaving.half

    def whole(self, tilt: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Middle and half widths [B, 2] of the box about all of the pupil."""
        return tilt @ self.usual.centre, tilt @ self.usual.half

    def known(self, tilt: torch.Tensor, e: torch.Tensor) -> torch.Tensor:
        """c [B, ...] at places [B, ..., 2] of the entrance pupil."""
        leaving, usual = (first_at(one, tilt, e.flatten(1, -2)) for one in (self.leaving, self.usual))
        return (leaving - usual).reshape(e.shape[:-1])


def order_paths(focused: FocusedLens, fits: PupilFits, *, curvature: float = 0.0) -> OrderPaths:
    """Fit the paths of orders to rays.

    Parameters
    ----------
    focused, fits
        The lens, and its pupils, those that `corrected` made where they are used.
    curvature
        Of the light that enters, in 1/m.
    """
    nodes = fits.nodes
    middle = nodes.terms(nodes.sines) @ fits.middle
    bundle = trace_bundle(focused, nodes.sines, curvature=curvature, middle=middle, sloped=False)
    way = bundle.direction
    entering, _ = fit_functions(
        nodes, bundle.beside, bundle, [(way[..., 1], _ENTERING_DEGREE)], [(way[..., 0], _ENTERING_DEGREE)]
    )
    # Light leaves where light of no curvature would enter.
    back = trace_bundle(focused, nodes.sines, middle=middle, sloped=False)
    usual, _ = fit_functions(
        nodes, back.e, back, [(back.psi, _PATH_DEGREE), (back.s[..., 1], MAP_DEGREE)], [(back.s[..., 0], MAP_DEGREE)]
    )
    ways = torch.where(back.near[..., None], -back.direction, 0.0)
    centre, half = (nodes.coefficients(one) for one in boxes(nodes, ways, back.passing))
    half = _WIDER * half
    none = torch.zeros(nodes.count, 0, dtype=torch.float64)
    found = OrderPaths(nodes, entering, usual, fits.leaving, centre, half, none, none, none)
    tilt = nodes.terms(nodes.sines)
    v, way = _points(found, tilt, 0, _TRACED)
    e, excess, far = _traced(focused, fits, found, nodes.sines, v, way)
    place, use = _scaled(v, *found.spot(tilt)), far <= _STRAY
    to = _scaled(way, tilt @ centre, tilt @ half)
    along = least_squares(_basis(place, to, 0), e[..., 1:], use)[..., 0]
    across = least_squares(_basis(place, to, 1), e[..., :1], use)[..., 0]
    more = least_squares(_basis(place, _scaled(e, *found.whole(tilt)), 0), excess[..., None], use)[..., 0]
    excess, along, across = (nodes.coefficients(one) for one in (more, along, across))
    found = replace(found, excess=excess, along=along, across=across)
    # Halfway between the nodes, where nothing was fitted.
    sines = (nodes.sines[1:] + nodes.sines[:-1]) / 2
    tilt = nodes.terms(sines)
    v, way = _points(found, tilt, _TRACED, _CHECKED)

    def checked(way: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """X of real rays and its error, [F, N], and which rays leave by the pupil."""
        e, excess, far = _traced(focused, fits, found, sines, v, way)
        own = excess - found.known(tilt, e)
        left = own - found.added(tilt, v, found.leaves_at(tilt, v, way[:, None]))[:, 0]
        return own, left, (far <= 1) & (length(_scaled(e, *found.pupil(tilt))) <= 1)

    own, left, some = checked(way)
    # A mirror's light is not turned, so what it has in common with that of orders is no error.
    own_mirror, left_mirror, mirrored = checked(found.enters(tilt, v))
    misfit, departure = (
        _rms(one - _mean(mirror, mirrored), some) for one, mirror in ((left, left_mirror), (own, own_mirror))
    )
    return replace(found, misfit=misfit, departure=departure)


def _points(found: OrderPaths, tilt: torch.Tensor, first: int, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Places v and directions o [F, N, 2] all over their boxes: `count` points of a sequence, from the `first` on."""
    points = qmc.Halton(4, scramble=False).fast_forward(first).random(count)
    u = 2 * torch.as_tensor(points, dtype=torch.float64) - 1
    u = u[((u[:, :2] ** 2).sum(-1) <= _NEAR) & ((u[:, 2:] ** 2).sum(-1) <= _NEAR)]
    centre, half = found.spot(tilt)
    v = centre[:, None] + half[:, None] * u[:, :2]
    return v, (tilt @ found.centre)[:, None] + (tilt @ found.half)[:, None] * u[:, 2:]


def _traced(
    focused: FocusedLens, fits: PupilFits, found: OrderPaths, sines: torch.Tensor, v: torch.Tensor, way: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """e [F, N, 2] and E [F, N] of rays that leave v in directions o [F, N, 2], and how far out these are at most.

    The last is the largest squared height over a rim's [F, N], infinite for rays that do not come through.
    """
    tilt = found.nodes.terms(sines)
    middle = tilt @ fits.middle
    at = torch.stack([v[..., 0], v[..., 1] + middle[:, None], torch.full_like(v[..., 0], float(focused.image))], -1)
    direction = torch.cat([way, -torch.sqrt(1 - (way**2).sum(-1, keepdim=True))], -1)
    back = trace_out(focused.lens, at, direction)
    e, more = leaving_by(focused, sines, back.position, back.direction)
    even, odd = values_at(found.usual, tilt, e)
    s = torch.stack([odd[:, 0], even[:, 1]], -1)
    model = even[:, 0] + (s * v).sum(-1) + fits.bend / 2 * (v**2).sum(-1)
    excess = back.path + more - model
    whole = back.good & torch.isfinite(excess)
    far = torch.where(whole, back.height.amax(-1), torch.inf)
    return torch.where(whole[..., None], e, 0.0), torch.where(whole, excess, 0.0), far


def _scaled(places: torch.Tensor, centre: torch.Tensor, half: torch.Tensor) -> torch.Tensor:
    """Places [B, ..., 2] in half widths of a box from its middle, [B, 2] each."""
    shape = len(places), *[1] * (places.ndim - 2), 2
    return (places - centre.reshape(shape)) / half.reshape(shape)


def _within(places: torch.Tensor, centre: torch.Tensor, half: torch.Tensor) -> torch.Tensor:
    """Places [B, ..., 2] moved into the ellipse of a box: polynomials are of no use beyond their rays."""
    beyond = length(_scaled(places, centre, half))[..., None].clamp_min(1)
    middle = centre.reshape(len(places), *[1] * (places.ndim - 2), 2)
    return middle + (places - middle) / beyond


def _terms(degree: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]


def _products(u: torch.Tensor, degree: int) -> torch.Tensor:
    """Products [..., M] of Chebyshev polynomials at scaled places u [..., 2]."""
    return basis(u, _terms(degree))


@functools.cache
def _paired(parity: int) -> list[int]:
    """Which pairs of a place's and a way's products are even or odd across the tilt, as numbers in a table."""
    place, way = _terms(_PLACE_DEGREE), _terms(_WAY_DEGREE)
    pairs = [(first, second) for first in range(len(place)) for second in range(len(way))]
    return [n for n, (first, second) in enumerate(pairs) if (place[first][0] + way[second][0]) % 2 == parity]


def _basis(place: torch.Tensor, way: torch.Tensor, parity: int) -> torch.Tensor:
    """Products [..., M] at scaled places and ways u [..., 2], even or odd across the tilt."""
    first, second = _products(place, _PLACE_DEGREE), _products(way, _WAY_DEGREE)
    return (first[..., :, None] * second[..., None, :]).flatten(-2)[..., _paired(parity)]


def _sum(coefficients: torch.Tensor, place: torch.Tensor, way: torch.Tensor, parity: int) -> torch.Tensor:
    """Sums [B, M, N] of the products of `_basis`, from those of places [B, N, P] and of ways [B, M, N, W].

    A place's part is the same for all orders.
    """
    table = coefficients.new_zeros(len(coefficients), place.shape[-1] * way.shape[-1])
    table[:, _paired(parity)] = coefficients
    part = place @ table.reshape(-1, place.shape[-1], way.shape[-1])
    return torch.einsum("bnw,bmnw->bmn", part, way)


def _mean(values: torch.Tensor, some: torch.Tensor) -> torch.Tensor:
    """Over some of each row's values [F, N], [F, 1]; 0 where there are none."""
    return torch.where(some, values, 0.0).sum(-1, keepdim=True) / some.sum(-1, keepdim=True).clamp_min(1)


def _rms(values: torch.Tensor, some: torch.Tensor) -> float:
    """The largest, over some of each row's values [F, N]."""
    return float(_mean(values**2, some).max().sqrt())
