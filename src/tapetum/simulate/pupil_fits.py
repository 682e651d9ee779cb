"""The pupil of a real lens as smooth functions of the place in it and of the field angle, fitted to traced bundles.

A lens under tilt is not symmetric along the tilt (y of the bundles) but is across it, so functions are even or odd
across. They are polynomials in a box about the pupil, fitted to its rays by least squares; between traced field angles
all their coefficients are Chebyshev polynomials of the tilt. One file of more than 400 lines, because fitting and
evaluating share terms, boxes and parities.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from tapetum.optics.focus import FocusedLens
from tapetum.simulate.traced_bundle import Bundle, Passing, length, limiting_surfaces, trace_bundle

__all__ = [
    "Fit",
    "Part",
    "PupilFits",
    "TiltNodes",
    "basis",
    "boxes",
    "chebyshev",
    "edge_weights",
    "first_at",
    "fit_functions",
    "fit_leaving",
    "fit_pupils",
    "least_squares",
    "narrowed",
    "on_grid",
    "on_tilt_grid",
    "open_share",
    "part_of",
    "reach_of_rays",
    "rounded_up",
    "values_at",
    "with_heights",
]

# Degrees of the polynomials: a phase needs many, an edge must not oscillate between its rays.
PHASE_DEGREE, MAP_DEGREE, SMOOTH_DEGREE = 12, 10, 8
# Degree in the tilt of the box about a pupil, and its enlargement.
_BOX_DEGREE, _BOX_MARGIN = 6, 1.03
# Half widths of the pupil between two directions that meet it, and a little.
_MEETS = 2.05
# Rays farther out than this are not fitted, in half widths of the box.
_FITTED = 1.15
# Fields a radian of tilt: the interpolation between them is far better than the fits (tests). Far out of focus it is
# not, and so many more are added.
_FIELDS_A_SINE, _LEAST_FIELDS, _MOST_FIELDS, _DENSER = 33, 5, 21, 4
# Weights of a sample's share and of those beside it, see `edge_weights`: 1 + x/6 and two more terms in
# x = sin²(q/2), fitted to the wanted ratio up to q = 2.5, where they err by 0.2 %.
_UNDAMPING = (1.15547279, -0.09611839, 0.02456734, -0.00787828, 0.00169293)
# Places evaluated at a time: their memory fits the processor's caches.
_PLACES_AT_ONCE = 1 << 15


def rounded_up(value: float) -> float:
    """Round up by at most 1 in 256, so that a lens is traced once for scenes that differ by little."""
    mantissa, exponent = math.frexp(value)
    return math.ldexp(math.ceil(512 * mantissa) / 512, exponent)


@dataclass(frozen=True)
class TiltNodes:
    """The field angles that are traced: Chebyshev nodes of the tilt's sine from 0 to `steepest`."""

    steepest: float
    count: int

    @classmethod
    def up_to(cls, steepest: float) -> TiltNodes:
        """As many nodes as the range of tilts asks for."""
        steepest = max(steepest, 1e-3)
        return cls(steepest, min(_MOST_FIELDS, _LEAST_FIELDS + math.ceil(_FIELDS_A_SINE * steepest)))

    def denser(self) -> TiltNodes:
        """More nodes over the same tilts, for what changes faster with the tilt than a lens's pupils do."""
        return replace(self, count=self.count + _DENSER)

    @property
    def places(self) -> torch.Tensor:
        """[T] in -1 … 1."""
        return torch.cos(torch.pi * (torch.arange(self.count, dtype=torch.float64) + 0.5) / self.count)

    @property
    def sines(self) -> torch.Tensor:
        """[T] sines of the tilts."""
        return self.steepest * (self.places + 1) / 2

    def coefficients(self, values: torch.Tensor) -> torch.Tensor:
        """Values at the nodes [T, ...] to Chebyshev coefficients [T, ...]: a discrete cosine transform."""
        matrix = 2 / self.count * chebyshev(self.places, self.count).T
        matrix[0] /= 2
        return (matrix @ values.reshape(self.count, -1)).reshape(values.shape)

    def terms(self, size: torch.Tensor) -> torch.Tensor:
        """Chebyshev polynomials [B, T] at tilts of these sines [B]."""
        return chebyshev(2 * size / self.steepest - 1, self.count)


@dataclass(frozen=True)
class Fit:
    """Functions of the tilt and of a place in the pupil, scaled to a box.

    `centre` and `half` [T, 2] are coefficients in the tilt of the box's middle and half widths, across and along the
    tilt; `even` and `odd` [K, T, M] those of the functions even and odd across the tilt; `degrees` their largest
    degrees.
    """

    centre: torch.Tensor
    half: torch.Tensor
    even: torch.Tensor
    odd: torch.Tensor
    degrees: tuple[int, int]

    def to(self, device: torch.device) -> Fit:
        """The same on another device."""
        centre, half = self.centre.to(device), self.half.to(device)
        return Fit(centre, half, self.even.to(device), self.odd.to(device), self.degrees)


@dataclass(frozen=True)
class Part:
    """The part of a pupil whose light reaches the picture, where that is not all of it.

    Its rays meet the plane within `landing` metres of y0 + `centre`, which is along the tilt, coefficients [T] in it.
    `sine` is half the part's width in s, `apart` how far at most, in s, it lies from the chief ray mirrored.
    """

    centre: torch.Tensor
    landing: float
    sine: float
    apart: float


@dataclass(frozen=True)
class PupilFits:
    """The pupils of a lens at one wavelength, for tilts on `nodes`. Lengths are in metres.

    `entering` holds functions of s: Ψ, |∂e/∂s|, and the height at each surface that stops rays; `leaving` functions of
    e: Ψ, s along the tilt, |∂s/∂e|, heights, and the odd s across. `middle` and `radius` [T] are coefficients of y0 and
    R, `bend` is C in 1/m. `spread` is the largest distance of a ray's landing from y0. Landings about y0 are linear in
    s, with slope `defocus` about the middle of s, and depart from it by at most `aberration`. `misfit` is the worst RMS
    of Ψ against the rays that pass; `aperture` the pupil's largest half width in s and reach in e. `corrected_from`:
    where the light that leaves has the paths of rays that a mirror returns, the tilts that were fitted before; else
    None. `part`: where `leaving` covers but a part of the pupil.
    """

    nodes: TiltNodes
    entering: Fit
    leaving: Fit
    middle: torch.Tensor
    radius: torch.Tensor
    bend: float
    spread: float
    defocus: float
    aberration: float
    misfit: float
    aperture: tuple[float, float]
    corrected_from: TiltNodes | None = None
    part: Part | None = None

    def to(self, device: torch.device) -> PupilFits:
        """The same on another device: lenses are traced on the CPU, fields computed anywhere."""
        middle = self.middle.to(device)
        if middle is self.middle:
            return self
        entering, leaving, radius = self.entering.to(device), self.leaving.to(device), self.radius.to(device)
        part = self.part and replace(self.part, centre=self.part.centre.to(device))
        return replace(self, entering=entering, leaving=leaving, middle=middle, radius=radius, part=part)

    def meets(self, farthest: float) -> float:
        """Distance of an order's direction from the pupil's within which some of its light returns.

        From the place v of the spot, up to `farthest` metres from its middle, the pupil is seen under directions that
        lie C v elsewhere: light that misses it from the middle may meet it from there, on its way in and out.
        """
        return _MEETS * self.aperture[0] + 2 * self.bend * farthest


def fit_pupils(
    focused: FocusedLens, steepest: float, *, curvature: float = 0.0, nodes: TiltNodes | None = None
) -> PupilFits:
    """Trace bundles at tilts from 0 to `steepest` (a sine), and fit them.

    `curvature`, in 1/m, is that of the light that enters; light that leaves is seen by a probe focused at infinity.
    Raises InputError where no ray gets through the lens.
    """
    nodes = nodes or TiltNodes.up_to(steepest)
    entering = trace_bundle(focused, nodes.sines, curvature=curvature)
    leaving = entering if curvature == 0 else trace_bundle(focused, nodes.sines, middle=entering.middle)
    into, in_misfit = fit_functions(
        nodes,
        entering.s,
        entering,
        [
            (entering.psi, PHASE_DEGREE),
            (1 / entering.jacobian, SMOOTH_DEGREE),
            *((entering.height[..., i], SMOOTH_DEGREE) for i in limiting_surfaces(entering)),
        ],
    )
    out, out_misfit = fit_leaving(nodes, leaving)
    spread, defocus, aberration = _landings(entering)
    at_nodes = chebyshev(nodes.places, nodes.count)
    return PupilFits(
        nodes,
        into,
        out,
        nodes.coefficients(entering.middle),
        nodes.coefficients(entering.radius),
        entering.bend,
        spread,
        defocus,
        aberration,
        max(in_misfit, out_misfit),
        (float((at_nodes @ into.half).max()), float(((at_nodes @ out.centre).abs() + at_nodes @ out.half).max())),
    )


def reach_of_rays(fits: PupilFits) -> float:
    """Largest distance from the axis, in metres, of a ray that leaves the pupil: its box without what surrounds it."""
    at = chebyshev(fits.nodes.places, fits.nodes.count)
    return float(((at @ fits.leaving.centre).abs() + at @ fits.leaving.half / _BOX_MARGIN).max())


def narrowed(fits: PupilFits, focused: FocusedLens, nodes: TiltNodes, curvature: float = 0.0) -> PupilFits:
    """The same pupils for the tilts of other nodes within `fits.nodes`, with the errors of their own rays.

    A polynomial of the tilt stays one on a part of its range, so nothing is fitted again. `misfit` is that of the light
    that enters alone.
    """
    tilt = fits.nodes.terms(nodes.sines)
    bundle = trace_bundle(focused, nodes.sines, curvature=curvature, middle=tilt @ fits.middle, sloped=False)
    misfit = values_at(fits.entering, tilt, bundle.s)[0][:, 0] - bundle.psi
    u = (bundle.s - (tilt @ fits.entering.centre)[:, None]) / (tilt @ fits.entering.half)[:, None]
    inside = bundle.passing & (u.abs() <= 1).all(-1)
    square = torch.where(inside, misfit**2, torch.zeros_like(misfit)).sum(-1) / inside.sum(-1)
    spread, defocus, aberration = _landings(bundle)
    entering, leaving = (_narrowed(one, nodes, tilt) for one in (fits.entering, fits.leaving))
    at_nodes = chebyshev(nodes.places, nodes.count)
    return PupilFits(
        nodes,
        entering,
        leaving,
        nodes.coefficients(tilt @ fits.middle),
        nodes.coefficients(tilt @ fits.radius),
        fits.bend,
        spread,
        defocus,
        aberration,
        float(square.max().sqrt()),
        (float((at_nodes @ entering.half).max()), fits.aperture[1]),
    )


def with_heights(fit: Fit, nodes: TiltNodes, places: torch.Tensor, near: torch.Tensor, more: torch.Tensor) -> Fit:
    """`PupilFits.entering` with `more` [T, K, N] added to its K heights at places [T, N, 2], of those that are near."""
    tilt = nodes.terms(nodes.sines)
    u = (places - (tilt @ fit.centre)[:, None]) / (tilt @ fit.half)[:, None]
    used = near & (u.abs() <= _FITTED).all(-1)
    terms = _terms(fit.degrees[0], 0)
    some = torch.tensor([i + j <= SMOOTH_DEGREE for i, j in terms])
    solved = least_squares(basis(torch.where(used[..., None], u, 0.0), terms)[..., some], more.mT, used)
    even = fit.even.clone()
    even[-more.shape[1] :, :, some] += nodes.coefficients(solved).permute(2, 0, 1)
    return replace(fit, even=even)


def part_of(fits: PupilFits, leaving: Fit, nodes: TiltNodes, landings: torch.Tensor, some: torch.Tensor) -> Part:
    """The part of a pupil that `leaving` covers; its rays, `some` [T, N], meet the plane at y0 + `landings` [T, N, 2].

    `fits` are of all of the pupil, on their own nodes.
    """
    count, at = some.sum(1), chebyshev(nodes.places, nodes.count)
    centre = nodes.coefficients(torch.where(some, landings[..., 1], 0.0).sum(1) / count)
    centre[_BOX_DEGREE:] = 0
    beside = torch.stack([landings[..., 0], landings[..., 1] - (at @ centre)[:, None]], -1)
    landing = float(torch.where(some, length(beside), 0.0).max())
    tilt, own = nodes.terms(nodes.sines), fits.nodes.terms(nodes.sines)
    ends = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], dtype=torch.float64).expand(len(tilt), -1, -1)
    along, across = _even(leaving, tilt, ends)[:, 1], _odd(leaving, tilt, ends)[:, 0]
    sine = torch.maximum(across[:, 0].abs(), (along[:, 1] - along[:, 2]).abs() / 2)
    chief = (own @ fits.middle) / (own @ fits.radius)
    apart = (chief + (along[:, 1] + along[:, 2]) / 2).abs()
    return Part(centre, landing, float(sine.max()), float(apart.max()))


def _narrowed(fit: Fit, nodes: TiltNodes, tilt: torch.Tensor) -> Fit:
    turned = nodes.coefficients(tilt)
    even, odd = (torch.einsum("nt,ktm->knm", turned, one) for one in (fit.even, fit.odd))
    return Fit(turned @ fit.centre, turned @ fit.half, even, odd, fit.degrees)


def fit_leaving(
    nodes: TiltNodes, leaving: Bundle, more: torch.Tensor | None = None, degree: int = PHASE_DEGREE
) -> tuple[Fit, float]:
    """Fit `PupilFits.leaving`, the functions of the light that leaves, to a bundle; also return the paths' RMS misfit.

    `more` [T, 1 + rims, N] is added to the bundle's paths and to its heights at `limiting_surfaces`. `degree` is that
    of the paths.
    """
    rims = limiting_surfaces(leaving)
    if more is None:
        more = torch.zeros(len(leaving.psi), 1 + len(rims), 1, dtype=torch.float64)
    return fit_functions(
        nodes,
        leaving.e,
        leaving,
        [
            (leaving.psi + more[:, 0], degree),
            (leaving.s[..., 1], MAP_DEGREE),
            (leaving.jacobian, SMOOTH_DEGREE),
            *((leaving.height[..., i] + more[:, 1 + n], SMOOTH_DEGREE) for n, i in enumerate(rims)),
        ],
        [(leaving.s[..., 0], MAP_DEGREE)],
    )


def _landings(bundle: Bundle) -> tuple[float, float, float]:
    """Largest distance of rays' landings from y0, their slope with s, and the rest, in metres."""
    passing = bundle.passing[..., None]
    some = passing.sum(1, keepdim=True)
    s = torch.where(passing, bundle.s, torch.zeros_like(bundle.s))
    s = torch.where(passing, s - s.sum(1, keepdim=True) / some, torch.zeros_like(s))
    apart = bundle.landing.clone()
    apart[..., 1] -= bundle.middle[:, None]
    apart = torch.where(passing, apart, torch.zeros_like(apart))
    defocus = float((apart * s).sum() / (s**2).sum())
    left = length(apart - defocus * s)
    return float(length(apart).max()), defocus, float(left.max())


def fit_functions(
    nodes: TiltNodes,
    places: torch.Tensor,
    bundle: Passing,
    even: Sequence[tuple[torch.Tensor, int]],
    odd: Sequence[tuple[torch.Tensor, int]] = (),
) -> tuple[Fit, float]:
    """Fit functions of places [T, N, 2], given by values [T, N] and a degree; also return the first's RMS misfit."""
    # Stray rays may be anywhere, or not finite.
    places = torch.where(bundle.near[..., None], places, torch.zeros_like(places))
    centre, half = boxes(nodes, places, bundle.passing)
    u = (places - centre[:, None]) / half[:, None]
    used = bundle.near & (u.abs() <= _FITTED).all(-1)
    degrees = max(degree for _, degree in even), max((degree for _, degree in odd), default=1)
    fitted: list[torch.Tensor] = []
    misfit = torch.zeros(places.shape[:2], dtype=torch.float64)
    for parity, functions in enumerate((even, odd)):
        terms = _terms(degrees[parity], parity)
        matrix = basis(u, terms)
        order = torch.tensor([i + j for i, j in terms])
        found = torch.zeros(len(functions), len(places), len(terms), dtype=torch.float64)
        for degree in sorted({degree for _, degree in functions}):
            some = order <= degree
            chosen = [k for k, (_, own) in enumerate(functions) if own == degree]
            values = torch.stack([functions[k][0] for k in chosen], -1)
            solved = least_squares(matrix[..., some], values, used)
            for j, k in enumerate(chosen):
                found[k][:, some] = solved[..., j]
        fitted.append(found)
        if parity == 0:
            misfit = torch.einsum("fnm,fm->fn", matrix, found[0]) - even[0][0]
    inside = bundle.passing & (u.abs() <= 1).all(-1)
    square = torch.where(inside, misfit**2, torch.zeros_like(misfit)).sum(-1) / inside.sum(-1)
    tilted = [nodes.coefficients(found.transpose(0, 1)).transpose(0, 1) for found in fitted]
    fit = Fit(nodes.coefficients(centre), nodes.coefficients(half), tilted[0], tilted[1], degrees)
    return fit, float(square.max().sqrt())


def values_at(fit: Fit, tilt: torch.Tensor, places: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Even and odd functions [B, K, N] at places [B, N, 2], across and along tilts given as `TiltNodes.terms`."""
    u = (places - (tilt @ fit.centre)[:, None]) / (tilt @ fit.half)[:, None]
    return _even(fit, tilt, u), _odd(fit, tilt, u)


def first_at(fit: Fit, tilt: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """The first even function [B, N], as `values_at` has it."""
    u = (places - (tilt @ fit.centre)[:, None]) / (tilt @ fit.half)[:, None]
    return _of_terms(fit.even[:1], fit.degrees[0], 0, tilt, u)[:, 0]


def on_grid(
    fit: Fit, tilt: torch.Tensor, toward: torch.Tensor, count: int, dtype: torch.dtype = torch.float64
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """A fit's functions on `count` columns and rows about its pupil, for any azimuth of the tilt.

    `tilt` [B, T] are `TiltNodes.terms`, `toward` [B, 2] unit vectors of the tilts. Returns x and y [B, n], the first
    even function [B, n, n] in float64, the others [B, K - 1, n, n] and the odd functions [B, K, n, n] in `dtype`, and
    where places lie inside the fit's box [B, n, n].
    """
    unit = (torch.arange(count, dtype=torch.float64, device=tilt.device) + 0.5) * 2 / count - 1
    centre, half = tilt @ fit.centre, tilt @ fit.half
    # Columns and rows that hold the rotated box; its corners hold no pupil.
    c, s = toward[:, 0].abs(), toward[:, 1].abs()
    x_wide = torch.hypot(half[:, 0] * s, half[:, 1] * c)
    y_wide = torch.hypot(half[:, 0] * c, half[:, 1] * s)
    wide = torch.stack([x_wide, y_wide], -1) * (1 + 0.25 * torch.minimum(c, s)[:, None])
    wide = torch.minimum(wide, torch.stack([half[:, 0] * s + half[:, 1] * c, half[:, 0] * c + half[:, 1] * s], -1))
    at = centre[:, 1:2] * toward
    x, y = at[:, 0:1] + wide[:, 0:1] * unit, at[:, 1:2] + wide[:, 1:2] * unit

    def scaled(
        columns: torch.Tensor, rows: torch.Tensor, dtype: torch.dtype = torch.float64
    ) -> tuple[torch.Tensor, torch.Tensor]:
        tx, ty = toward[:, :1] / half, toward[:, 1:] / half
        parts = (
            columns * tx[:, 1:],
            rows * ty[:, 1:] - centre[:, 1:] / half[:, 1:],
            columns * ty[:, :1],
            rows * tx[:, :1],
        )
        right, down, left, up = (part.to(dtype) for part in parts)
        return up[:, :, None] - left[:, None, :], right[:, None, :] + down[:, :, None]

    # Rotated or not, this many columns and rows determine a polynomial of the degree, so few places are evaluated.
    order = max(fit.degrees) + 1
    nodes = torch.cos(torch.pi * (torch.arange(order, dtype=torch.float64, device=tilt.device) + 0.5) / order)
    few = torch.stack(scaled(at[:, 0:1] + wide[:, 0:1] * nodes, at[:, 1:2] + wide[:, 1:2] * nodes), -1).flatten(1, 2)
    shape = (len(tilt), -1, order, order)
    lift = 2 / order * chebyshev(nodes, order)
    lift[:, 0] /= 2
    lift = chebyshev(unit, order) @ lift.T
    even, odd = _even(fit, tilt, few).reshape(shape), _odd(fit, tilt, few).reshape(shape)
    lower = lift.to(dtype)
    path = lift @ even[:, 0] @ lift.T
    others, odd = (lower @ one.to(dtype) @ lower.T for one in (even[:, 1:], odd))
    across, along = scaled(x, y, dtype)
    return x, y, path, others, odd, (across.abs() <= 1) & (along.abs() <= 1)


def on_tilt_grid(
    fit: Fit, tilt: torch.Tensor, count: int, dtype: torch.dtype = torch.float64
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """A fit's even functions on columns across the tilt and rows along it.

    The grid has `count` columns and rows over the whole box, an even number; those on one side of the middle are
    returned, from it outwards, which the others mirror: columns [B, n/2], rows [B, n], the first function [B, n, n/2]
    in float64, and the others [B, K - 1, n, n/2] in `dtype`.
    """
    unit = (torch.arange(count, dtype=torch.float64, device=tilt.device) + 0.5) * 2 / count - 1
    centre, half = tilt @ fit.centre, tilt @ fit.half
    table = _table(fit.even, fit.degrees[0], 0, tilt)
    along = chebyshev(unit, fit.degrees[0] + 1)
    across = along[count // 2 :, 0::2][:, : table.shape[-2]]
    path = along @ (across @ table[:, 0]).mT
    others = along.to(dtype) @ (across.to(dtype) @ table[:, 1:].to(dtype)).mT
    return half[:, :1] * unit[count // 2 :], centre[:, 1:] + half[:, 1:] * unit, path, others


def open_share(heights: torch.Tensor, inside: torch.Tensor | None = None, *, mirrored: bool = False) -> torch.Tensor:
    """Share of each sample [B, n, m] that no rim covers, for heights [B, K, n, m]; rims count as straight there.

    `mirrored`: beside the first column lies its mirror image.
    """
    lit = heights < 1
    # An edge crosses few squares, and each of those has a diagonal neighbour beyond the edge.
    crossed = torch.zeros_like(lit)
    for one, other in (((1, 0), (0, 1)), ((1, 1), (0, 0))):
        (a, b), (c, d) = (tuple(slice(k, -1 if k == 0 else None) for k in at) for at in (one, other))
        apart = lit[..., a, b] ^ lit[..., c, d]
        crossed[..., a, b] |= apart
        crossed[..., c, d] |= apart
    if mirrored:
        apart = lit[..., 1:, 0] ^ lit[..., :-1, 0]
        crossed[..., 1:, 0] |= apart
        crossed[..., :-1, 0] |= apart
    # Where no rim covers anything there are no heights.
    batch, rims, rows, columns = heights.shape
    total = heights.new_ones(batch, rows, columns, dtype=torch.bool) if inside is None else inside
    for one in (lit | crossed).unbind(1):
        total = total & one
    number = (crossed & total[:, None]).flatten().nonzero()[:, 0]
    column, row = number % columns, number // columns % rows
    flat = heights.flatten()
    above, below = (row > 0).long(), (row < rows - 1).long()
    before, after = (column > 0).long(), (column < columns - 1).long()
    gy = (flat[number + columns * below] - flat[number - columns * above]) / (above + below)
    wide = 1 + after if mirrored else before + after
    gx = (flat[number + after] - flat[number - before]) / wide
    share = _covered(1 - flat[number], gx.abs(), gy.abs())
    at = number // (rims * rows * columns) * (rows * columns) + number % (rows * columns)
    return total.to(heights.dtype).flatten().scatter_reduce(0, at, share, "amin").reshape(batch, rows, columns)


def edge_weights(share: torch.Tensor, *, mirrored: bool = False) -> torch.Tensor:
    """Weights of samples [B, n, m] near an edge for the shares of their squares inside it.

    A share is the mean over a square: light that the edge diffracts is damped by sin(q/2)/(q/2), q being the change of
    phase from sample to sample, along columns and along rows. Sums over a few samples undo that.

    `mirrored`: beside the first column lies its mirror image.
    """
    middle, *beside = _UNDAMPING
    reach = len(beside)
    for axis in (2, 1):
        count = share.shape[axis]
        # What lies beyond the first and the last sample is as they are.
        first, last = (share.narrow(axis, at, 1) for at in (0, count - 1))
        ends = [first] * reach, [last] * reach
        if mirrored and axis == 2:
            ends = [share.narrow(axis, at, 1) for at in reversed(range(reach))], ends[1]
        wide = torch.cat([*ends[0], share, *ends[1]], axis)
        share = middle * share
        for away, weight in enumerate(beside, 1):
            share.add_(wide.narrow(axis, reach - away, count), alpha=weight)
            share.add_(wide.narrow(axis, reach + away, count), alpha=weight)
    return share


def chebyshev(u: torch.Tensor, count: int) -> torch.Tensor:
    """T_0 … T_(count-1) at u [...]: [..., count]."""
    values = [torch.ones_like(u), u]
    for _ in range(count - 2):
        values.append(2 * u * values[-1] - values[-2])
    return torch.stack(values[:count], -1)


def basis(u: torch.Tensor, terms: Sequence[tuple[int, int]]) -> torch.Tensor:
    """Products T_i(u_0) T_j(u_1), [..., M], at scaled places u [..., 2]."""
    values = chebyshev(u, 1 + max(max(i, j) for i, j in terms))
    across, along = values[..., 0, :], values[..., 1, :]
    return across[..., [i for i, _ in terms]] * along[..., [j for _, j in terms]]


def _terms(degree: int, parity: int) -> tuple[tuple[int, int], ...]:
    """Degrees (across, along) of all products up to a total degree."""
    return tuple((i, j) for i in range(parity, degree + 1, 2) for j in range(degree + 1 - i))


def _even(fit: Fit, tilt: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    return _of_terms(fit.even, fit.degrees[0], 0, tilt, u)


def _odd(fit: Fit, tilt: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    return _of_terms(fit.odd, fit.degrees[1], 1, tilt, u)


def _of_terms(
    coefficients: torch.Tensor, degree: int, parity: int, tilt: torch.Tensor, u: torch.Tensor
) -> torch.Tensor:
    """[B, K, N] at scaled places u [B, N, 2], summed along first, then across."""
    table = _table(coefficients, degree, parity, tilt)
    parts: list[torch.Tensor] = []
    for start in range(0, u.shape[1], _PLACES_AT_ONCE):
        some = u[:, start : start + _PLACES_AT_ONCE]
        along = chebyshev(some[..., 1], degree + 1)
        across = chebyshev(some[..., 0], degree + 1)[..., parity::2][..., : table.shape[-2]]
        functions = [((along @ table[:, k].mT) * across).sum(-1) for k in range(table.shape[1])]
        parts.append(torch.stack(functions, 1) if functions else torch.zeros(len(some), 0, some.shape[1]).to(u))
    return torch.cat(parts, -1) if len(parts) != 1 else parts[0]


def _table(coefficients: torch.Tensor, degree: int, parity: int, tilt: torch.Tensor) -> torch.Tensor:
    """Coefficients at tilts, by degree across and along: [B, K, I, J]."""
    terms = _terms(degree, parity)
    now = torch.einsum("bt,ktm->bkm", tilt, coefficients)
    rows = len({i for i, _ in terms})
    table = torch.zeros(*now.shape[:2], rows, degree + 1, dtype=now.dtype, device=now.device)
    table[..., [(i - parity) // 2 for i, _ in terms], [j for _, j in terms]] = now
    return table


def boxes(nodes: TiltNodes, places: torch.Tensor, passing: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Middle and half widths [T, 2] of boxes about all that passes, as low polynomials of the tilt."""
    far = torch.full_like(places, math.inf)
    lower = torch.where(passing[..., None], places, far).amin(1)
    upper = torch.where(passing[..., None], places, -far).amax(1)
    # Left and right are symmetric.
    wide = torch.maximum(upper[:, 0], -lower[:, 0])
    lower, upper = torch.stack([-wide, lower[:, 1]], -1), torch.stack([wide, upper[:, 1]], -1)
    step = (upper - lower) / math.sqrt(places.shape[1])
    degree = min(_BOX_DEGREE, nodes.count)
    terms = chebyshev(nodes.places, nodes.count)[:, :degree]
    low = terms @ nodes.coefficients(lower - step)[:degree]
    high = terms @ nodes.coefficients(upper + step)[:degree]
    # Enlarge everywhere by the most that smoothing cuts off anywhere.
    low = low - (low - lower).clamp_min(0).amax(0)
    high = high + (upper - high).clamp_min(0).amax(0)
    return (low + high) / 2, (high - low) / 2 * _BOX_MARGIN


def least_squares(matrix: torch.Tensor, values: torch.Tensor, used: torch.Tensor) -> torch.Tensor:
    """[T, M, K] for a matrix [T, N, M], values [T, N, K] and the rows used [T, N]."""
    weights = used[..., None].to(torch.float64)
    a = matrix * weights
    b = torch.where(used[..., None], values, torch.zeros_like(values))
    # Slight damping: the rays of a small pupil do not determine the highest terms.
    scale = 1e-9 * torch.sqrt((a**2).sum((-2, -1), keepdim=True) / a.shape[-1])
    eye = torch.eye(a.shape[-1], dtype=torch.float64).expand(len(a), -1, -1) * scale
    none = torch.zeros(len(b), a.shape[-1], b.shape[-1], dtype=torch.float64)
    linalg: Any = torch.linalg
    found: Any = linalg.lstsq(torch.cat([a, eye], -2), torch.cat([b, none], -2), driver="gels")
    return found.solution


def _covered(value: torch.Tensor, gx: torch.Tensor, gy: torch.Tensor) -> torch.Tensor:
    """Share of a unit square where value + gx u + gy w > 0 for u, w in -½ … ½: exact for a straight edge."""
    a, b = torch.maximum(gx, gy).clamp_min(1e-12), torch.minimum(gx, gy)
    # An edge along the samples has no second slope: use a tiny one.
    b = torch.maximum(b, 1e-5 * a)

    def ramp(t: torch.Tensor) -> torch.Tensor:
        return 0.5 * t.clamp_min(0) ** 2

    near, far = (a + b) / 2, (a - b) / 2
    crossed = (ramp(value + near) - ramp(value + far) - ramp(value - far) + ramp(value - near)) / (a * b)
    return torch.where(2 * value.abs() < gx + gy, crossed.clamp(0, 1), (value > 0).to(value.dtype))
