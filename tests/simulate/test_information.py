"""Fisher information against differences, closed forms, drawn numbers, and fits of noisy frames."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from numpy.polynomial import chebyshev
from scipy.linalg import invhilbert
from scipy.optimize import minimize_scalar
from scipy.stats import norm, poisson

from tapetum.bench import ProbeSensor, Scene, load_scene
from tapetum.errors import InputError
from tapetum.optics.grid import lens_numbers
from tapetum.simulate import information as module
from tapetum.simulate.exposure import digitise, gain_of
from tapetum.simulate.information import PARAMETERS, FisherInformation, expected_electrons, fisher, true_values
from tapetum.simulate.traced_information import TRACED, TracedSlopes

SECTION = "Fisher information"
Validated = Callable[..., None]

# Some 3000 electrons at the peak, steps of half an electron, nothing clipped.
BENCH = (
    "target.lens.aperture_radius=2 mm",
    "target.object_distance=2.5",
    "target.rotation=[0.2 deg, 0.5 deg]",
    "illumination.diameter=50 mm",
    "probe.sensor.pixels=[64, 64]",
    "probe.sensor.pitch=6.6 um",
    "probe.sensor.exposure=20 us",
    "probe.sensor.bits=14",
    "probe.sensor.gain=2",
    "probe.sensor.offset=200",
    "probe.sensor.full_well=30000",
    "probe.sensor.read_noise=3",
    "probe.sensor.background=20",
    "sampling.accuracy=1e-2",
)
DIVERGING = (
    "illumination.diameter=null",
    "illumination.mode=diverging",
    "illumination.divergence=0.5 deg",
    "illumination.power=50 uW",
    "probe.sensor.exposure=200 us",
)


def bench(*changes: str) -> Scene:
    return load_scene("thin-lens", [*BENCH, *changes])


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_information_in_any_mode_of_the_caller(mode: Callable[[], Any]) -> None:
    scene = bench()
    want = fisher(scene).information
    with mode():
        found = fisher(scene).information
    assert torch.equal(found, want) and not found.requires_grad
    with mode():
        traced = fisher(load_scene("rotation", ["sampling.accuracy=0.3"]), ("gaze_y", "power")).information
    assert bool(torch.isfinite(traced).all())


def test_values_of_unknown_names_are_refused() -> None:
    with pytest.raises(InputError, match=r"values: unknown parameter 'Power'; use gaze_x, .*power"):
        expected_electrons(bench(), {"Power": 5.0})


def noise_variance(sensor: ProbeSensor) -> float:
    """Of readout and rounding, in electrons squared."""
    return sensor.read_noise**2 + 1 / (12 * gain_of(sensor) ** 2)


def mean_of(scene: Scene, values: dict[str, float] | None = None) -> torch.Tensor:
    """Mean electrons, [H, W]. With gradients nothing small is left out of the picture, as `fisher` computes it."""
    known = {**true_values(scene, ("gaze_x", "gaze_y")), **(values or {})}
    asked = {name: torch.tensor(value, dtype=torch.float64, requires_grad=True) for name, value in known.items()}
    return expected_electrons(scene, asked).detach()


def by_differences(scene: Scene, names: Sequence[str]) -> torch.Tensor:
    """Fisher's matrix by central differences of the mean electrons, weighed by 1/(μ + σ²)."""
    start, rows = true_values(scene, names), list[torch.Tensor]()
    for name, value in start.items():
        step = {"gaze_x": 1e-6, "gaze_y": 1e-6, "place_x": 1e-10, "place_y": 1e-10}.get(name, 1e-6 * value)
        up, down = (mean_of(scene, {**start, name: value + d}) for d in (step, -step))
        rows.append(((up - down) / (2 * step)).flatten())
    mean = mean_of(scene).flatten()
    jacobian = torch.stack(rows)
    return (jacobian / (mean + noise_variance(scene.probe.sensor))) @ jacobian.T


WAYS = {
    "collimated": ((), ("gaze_x", "gaze_y", "object_distance", "focal_length", "power", "place_x", "place_y")),
    "diverging": (DIVERGING, tuple(PARAMETERS)),
    "diverging, over 8 m and through an aperture of r = 3 mm": (
        (*DIVERGING, "sampling.propagation=finite", "probe.lens.aperture_radius=3 mm", "distance=8"),
        tuple(PARAMETERS),
    ),
}


@pytest.mark.parametrize("way", WAYS)
def test_information_against_differences(validated: Validated, way: str) -> None:
    changes, names = WAYS[way]
    scene = bench(*changes)
    mean = mean_of(scene)
    assert 1000 < float(mean.max()) < 7000
    found = fisher(scene, names)
    want = by_differences(scene, names)
    own = want.diagonal().sqrt()
    error = ((found.information - want) / (own[:, None] * own[None, :])).abs().max()
    what = f"Information of {len(names)} parameters, {way}"
    validated(SECTION, what, error, 2e-4, "central differences of the mean electrons", "of √(F_ii F_jj)")
    # The matrices' inverses ask for far more.
    bounds = torch.tensor(list(found.bounds.values()), dtype=torch.float64)
    assert torch.allclose(bounds, torch.linalg.inv(want).diagonal().sqrt(), rtol=1e-2)


def test_a_target_that_reflects_nothing_tells_nothing() -> None:
    dark = load_scene("thin-lens", ("target.sensor.reflectance=0", "probe.sensor.background=5"))
    assert set(fisher(dark).bounds.values()) == {math.inf}


def test_gaze_is_a_place_in_the_picture_not_an_angle() -> None:
    """With the focal length the image moves by z tan θ unless the gaze is what stays."""
    scene = bench()
    longer = bench("target.lens.focal_length=104 mm")
    own = true_values(longer, ("gaze_x", "gaze_y", "focal_length"))
    want = expected_electrons(longer, {})
    found = expected_electrons(scene, own)
    assert float((found - want).abs().max() / want.max()) < 1e-3
    assert own["gaze_y"] != pytest.approx(true_values(scene, ("gaze_y",))["gaze_y"], rel=0.01)


class Pictures:
    """Mean electrons [N] for parameters near their values: Chebyshev interpolation of simulated frames."""

    def __init__(self, scene: Scene, reach: dict[str, float], nodes: int) -> None:
        self.start, self.reach = true_values(scene, tuple(reach)), reach
        places = np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes)
        found = np.stack([self.simulated(scene, at) for at in itertools.product(places, repeat=len(reach))])
        grid = found.reshape(*[nodes] * len(reach), -1)
        inverse = np.linalg.inv(chebyshev.chebvander(places, nodes - 1))
        for axis in range(len(reach)):
            grid = np.moveaxis(np.tensordot(inverse, grid, (1, axis)), 0, axis)
        self._coefficients, self._nodes = grid, nodes

    def simulated(self, scene: Scene, at: Sequence[float]) -> np.ndarray:
        values = {n: self.start[n] + u * r for u, (n, r) in zip(at, self.reach.items(), strict=True)}
        return mean_of(scene, values).flatten().numpy()

    def __call__(self, at: Sequence[float] | np.ndarray, differentiated: int | None = None) -> np.ndarray:
        """At -1 … 1 times the reach; the derivative with respect to one of these where it is named."""
        grid = self._coefficients
        for axis, u in enumerate(at):
            basis = np.eye(self._nodes)
            if axis == differentiated:
                basis = np.vstack([chebyshev.chebder(basis), np.zeros(self._nodes)])
            grid = np.tensordot(chebyshev.chebval(u, basis), grid, (0, 0))
        return grid


def frames(scene: Scene, count: int, seed: int) -> np.ndarray:
    """Drawn frames in electrons, [count, N]."""
    sensor, mean = scene.probe.sensor, mean_of(scene)
    numbers = digitise(mean.expand(count, -1, -1), sensor, np.random.default_rng(seed)).reshape(count, -1)
    assert numbers.max() < 2**sensor.bits - 1 and numbers.min() > 0
    return (numbers.astype(np.float64) - sensor.offset) / gain_of(sensor)


def test_likelihood_fit_of_the_gaze_reaches_the_bound(validated: Validated) -> None:
    """Scan, then refine: the Poisson light with read noise as a Poisson variable shifted by its variance."""
    scene, count = bench(), 400
    noise = noise_variance(scene.probe.sensor)
    pictures = Pictures(scene, {"gaze_y": 0.01}, 20)
    bound = fisher(scene, ("gaze_y",)).bounds["gaze_y"]
    between = [0.37]
    direct = pictures.simulated(scene, between)
    assert np.sqrt(((pictures(between) - direct) ** 2 / (direct + noise)).sum()) < 0.02
    drawn = frames(scene, count, 5) + noise
    scan = np.linspace(-0.95, 0.95, 39)
    means = np.stack([pictures([u]) for u in scan]) + noise
    nearest = scan[np.argmin(means.sum(1)[:, None] - np.log(means) @ drawn.T, axis=0)]
    # The bound is a hundredth of the range: the scan does not know the answer.
    assert bound < 0.02 * pictures.reach["gaze_y"]

    def unlikely(u: float, frame: np.ndarray) -> float:
        mean = pictures([u]) + noise
        return float(mean.sum() - np.log(mean) @ frame)

    def fitted(near: float, frame: np.ndarray) -> float:
        found: Any = minimize_scalar(
            unlikely, args=(frame,), bounds=(near - 0.05, near + 0.05), options={"xatol": 1e-6}
        )
        return float(found.x)

    fits = np.array([fitted(u, one) for u, one in zip(nearest, drawn, strict=True)])
    errors = fits * pictures.reach["gaze_y"] / bound
    assert abs(errors.mean()) < 3.5 / math.sqrt(count)
    spread = 1 / math.sqrt(2 * (count - 1))
    what = f"Scatter of the gaze fitted to {count} noisy frames, 0.5 deg, x_d = 2.5 m"
    against = f"the Cramér-Rao bound; {count} frames leave ±{spread:.1%} (one standard deviation)"
    validated(SECTION, what, abs(errors.std(ddof=1) - 1), 3 * spread, against, "of the bound")


def test_joint_fit_of_gaze_and_focus_reaches_the_bounds(validated: Validated) -> None:
    """Fisher's scoring, from a start that is off by several standard deviations."""
    scene, count, names = bench(), 400, ("gaze_y", "object_distance")
    noise = noise_variance(scene.probe.sensor)
    told = fisher(scene, names)
    pictures = Pictures(scene, {name: 12 * bound for name, bound in told.bounds.items()}, 4)
    between = [0.4, -0.3]
    direct = pictures.simulated(scene, between)
    assert np.sqrt(((pictures(between) - direct) ** 2 / (direct + noise)).sum()) < 0.02
    rng, fits = np.random.default_rng(8), list[np.ndarray]()
    for frame in frames(scene, count, 6):
        at = rng.uniform(-0.4, 0.4, 2)
        for _ in range(20):
            slopes, mean = np.stack([pictures(at, 0), pictures(at, 1)]), pictures(at) + noise
            step = np.linalg.solve((slopes / mean) @ slopes.T, slopes @ ((frame + noise) / mean - 1))
            at = at + step
            if np.abs(step).max() < 1e-5:
                break
        else:
            pytest.fail("scoring does not converge")
        fits.append(at)
    errors = np.stack(fits) * np.array(list(pictures.reach.values())) / np.array(list(told.bounds.values()))
    assert np.abs(errors.mean(0)).max() < 3.5 / math.sqrt(count)
    spread = 1 / math.sqrt(2 * (count - 1))
    against = f"the Cramér-Rao bounds; {count} frames leave ±{spread:.1%} each (one standard deviation)"
    what = f"Scatter of gaze and object distance fitted jointly to {count} noisy frames, 0.5 deg, x_d = 2.5 m"
    validated(SECTION, what, np.abs(errors.std(0, ddof=1) - 1).max(), 3 * spread, against, "of the bounds")
    covariance = torch.linalg.inv(told.information)
    correlation = float(covariance[0, 1] / (covariance[0, 0] * covariance[1, 1]).sqrt())
    found = np.asarray(np.corrcoef(errors.T))[0, 1]
    assert found == pytest.approx(correlation, abs=3.5 * (1 - correlation**2) / math.sqrt(count))


def exact_information(mean: float, sensor: ProbeSensor) -> float:
    """Of one pixel about its mean electrons, from the probability of every digital number."""
    counts = np.arange(max(0, int(mean - 12 * math.sqrt(mean) - 30)), int(mean + 12 * math.sqrt(mean) + 40))
    chance = poisson.pmf(counts, mean)
    change = poisson.pmf(counts - 1, mean) - chance
    borders = (np.arange(2**sensor.bits - 1) + 0.5 - sensor.offset) / gain_of(sensor)
    reached = borders[(borders > counts[0] - 12 * sensor.read_noise) & (borders < counts[-1] + 12 * sensor.read_noise)]
    below: Any = norm.cdf((reached[:, None] - counts[None]) / sensor.read_noise)
    below[reached >= sensor.full_well] = 1.0
    odds, moves = (np.asarray(np.diff(below @ p, prepend=0.0, append=p.sum())) for p in (chance, change))
    seen = odds > 1e-14
    return float((moves[seen] ** 2 / odds[seen]).sum())


@pytest.mark.parametrize(
    ("read_noise", "means", "most"),
    [(2.0, (0.1, 1.0, 5.0), 0.15), (2.0, (30.0, 200.0, 900.0), 1e-3), (6.0, (0.1, 1.0, 30.0, 900.0), 0.02)],
)
def test_pixel_tells_what_its_digital_numbers_do(
    validated: Validated, read_noise: float, means: tuple[float, ...], most: float
) -> None:
    sensor = ProbeSensor(bits=12, gain=2.0, offset=100.0, full_well=1500.0, read_noise=read_noise)
    found = module._information_of_pixels(torch.tensor([means], dtype=torch.float64), sensor)[0].numpy()
    exact = np.array([exact_information(one, sensor) for one in means])
    # Means and variances never tell more than the whole distribution.
    assert (found < exact * (1 + 1e-6)).all()
    what = f"Information of a pixel of {means[0]:g} to {means[-1]:g} e⁻, read noise {read_noise:g} e⁻, steps of 0.5 e⁻"
    error = float((1 - found / exact).max())
    validated(SECTION, what, error, most, "the probabilities of all digital numbers", "of the information")


@pytest.mark.parametrize("limit", [{"full_well": 800.0}, {"gain": 4095 / 800.0, "full_well": 1500.0}])
def test_saturated_pixels_tell_nothing(limit: dict[str, Any]) -> None:
    """By a full well, or by the largest digital number."""
    sensor = ProbeSensor(**{"bits": 12, "gain": 2.0, "read_noise": 3.0, **limit})
    means = torch.tensor([[600.0, 800.0, 900.0, 1100.0, 1e6]], dtype=torch.float64)
    free, edge, few, none, lost = (module._information_of_pixels(means, sensor) * (means + noise_variance(sensor)))[
        0
    ].tolist()
    assert free == pytest.approx(1, abs=1e-6)
    assert 0.1 < edge < 0.9
    assert few < 0.05
    assert none == lost == 0
    blind = fisher(bench("probe.sensor.background=60000"), ("gaze_x", "power"))
    assert list(blind.bounds.values()) == list(blind.alone.values()) == [math.inf, math.inf]


def test_hot_pixels_are_noise() -> None:
    hot = ("probe.sensor.hot_pixels=0.5", "probe.sensor.hot_current=5e7")
    names = ("gaze_y", "power")
    clean, worse = (fisher(bench(*changes), names).bounds for changes in ((), hot))
    # Half of the pixels have a thousand electrons more.
    assert all(1.02 < worse[name] / clean[name] < 2 for name in names)


SHOT = ("probe.sensor.read_noise=0", "probe.sensor.background=0", "probe.sensor.gain=8", "probe.sensor.bits=16")
READ = (
    "probe.sensor.read_noise=1000",
    "probe.sensor.background=0",
    "probe.sensor.gain=1",
    "probe.sensor.bits=16",
    "probe.sensor.offset=20000",
)


@pytest.mark.parametrize(("noise", "power"), [(SHOT, 0.5), (READ, 1.0)], ids=["shot noise", "read noise"])
def test_bounds_fall_with_the_power(validated: Validated, noise: tuple[str, ...], power: float) -> None:
    names = ("gaze_x", "gaze_y", "object_distance", "place_y")
    dim, bright = (fisher(bench(*noise, f"illumination.power={p}"), names).bounds for p in (2.5e-4, 1e-3))
    error = max(abs(math.log(dim[n] / bright[n], 4) - power) for n in names)
    kind = "shot noise alone" if power == 0.5 else "read noise alone"
    what = f"Exponent of the bounds' fall with the laser's power, {kind}"
    against = "1/√power" if power == 0.5 else "1/power"
    validated(SECTION, what, error, 0.01, against, "(difference of exponents)")


def test_independent_frames_add() -> None:
    names = ("gaze_x", "gaze_y", "object_distance")
    one = fisher(bench(*SHOT), names)
    both = one + one
    for name in names:
        assert both.bounds[name] == pytest.approx(one.bounds[name] / math.sqrt(2), rel=1e-9)
    # Without read noise two frames are one of twice the exposure.
    longer = fisher(bench(*SHOT, "probe.sensor.exposure=40 us"), names)
    assert torch.allclose(both.information, longer.information, rtol=2e-3, atol=0)
    with pytest.raises(InputError, match="parameters"):
        _ = one + fisher(bench(*SHOT), names[:2])


def test_more_unknowns_never_help() -> None:
    every = fisher(bench(*DIVERGING), tuple(PARAMETERS))
    few = fisher(bench(*DIVERGING), ("gaze_x", "place_x", "object_distance"))
    for name in few.parameters:
        assert every.alone[name] == pytest.approx(few.alone[name], rel=1e-9)
        assert few.alone[name] <= few.bounds[name] * (1 + 1e-9)
        assert few.bounds[name] <= every.bounds[name] * (1 + 1e-9)
    assert every.units["focal_length"] == "m" and set(every.units) == set(PARAMETERS)


def test_what_the_frame_does_not_tell_is_infinite() -> None:
    # Collimated light in the far field knows no distance.
    flat = fisher(bench(), ("gaze_y", "distance", "power"))
    assert flat.bounds["distance"] == flat.alone["distance"] == math.inf
    assert flat.bounds["gaze_y"] == pytest.approx(fisher(bench(), ("gaze_y", "power")).bounds["gaze_y"], rel=1e-9)
    # With the vergence given, distance and power say one thing: how bright it is.
    fixed = fisher(bench(*DIVERGING, "illumination.vergence=0.2"), ("power", "gaze_y", "distance"))
    assert fixed.bounds["power"] == fixed.bounds["distance"] == math.inf
    assert 0 < fixed.alone["power"] < math.inf and 0 < fixed.alone["distance"] < math.inf
    known = fisher(bench(*DIVERGING, "illumination.vergence=0.2"), ("power", "gaze_y"))
    assert fixed.bounds["gaze_y"] == pytest.approx(known.bounds["gaze_y"], rel=1e-6)


def of(jacobian: np.ndarray) -> FisherInformation:
    names = tuple(PARAMETERS)[: jacobian.shape[1]]
    return FisherInformation(names, (0.0,) * len(names), torch.from_numpy(jacobian.T @ jacobian))


def test_bounds_of_ill_conditioned_matrices(validated: Validated) -> None:
    size = 6
    index = np.arange(size)
    scale = 10.0 ** np.array([-9, -3, 0, 4, 8, 12])
    hilbert = torch.from_numpy(np.outer(scale, scale) / (index[:, None] + index[None, :] + 1))
    found = FisherInformation(tuple(PARAMETERS)[:size], (0.0,) * size, hilbert).bounds
    want = np.sqrt(np.diag(invhilbert(size))) / scale
    error = np.abs(np.array(list(found.values())) / want - 1).max()
    what = "Bounds from a Hilbert matrix of 6 rows (condition number 1.5e7), units 21 powers of ten apart"
    validated(SECTION, what, error, 1e-6, "its inverse in whole numbers", "of the bound")


def test_bounds_find_what_is_not_determined() -> None:
    rng = np.random.default_rng(3)
    a, b, c, d = rng.normal(size=(4, 500))
    near = a + 1e-3 * b
    cases: list[tuple[list[np.ndarray], list[bool]]] = [
        ([a, -2e6 * a, b], [False, False, True]),
        ([a, b, a + b, c], [False, False, False, True]),
        ([a, near, c], [True, True, True]),
        ([a, 3 * a, b, 1e-9 * b, c + 0.5 * a + b, d], [False, False, False, False, True, True]),
        ([a, 0 * a, b], [True, False, True]),
        ([0 * a], [False]),
    ]
    for columns, told in cases:
        jacobian = np.stack(columns, 1)
        found = list(of(jacobian).bounds.values())
        assert [math.isfinite(one) for one in found] == told
        for i, one in enumerate(found):
            if math.isfinite(one):
                rest = np.delete(jacobian, i, 1)
                left = jacobian[:, i] - rest @ (np.linalg.pinv(rest) @ jacobian[:, i])
                assert one == pytest.approx(1 / np.linalg.norm(left), rel=1e-6)


def test_window_loses_little() -> None:
    """A large sensor is computed only where the RR lies, on its own pixels."""
    large = [*BENCH, "target.object_distance=50", "probe.sensor.background=0"]
    names = ("gaze_x", "gaze_y", "object_distance", "power", "place_x")
    sensor = ["probe.sensor.pixels=[401, 310]"]
    scene = load_scene("thin-lens", large + sensor)
    window = module._where_it_matters(scene, torch.sin(torch.tensor(scene.target.rotation, dtype=torch.float64)))
    assert window is not None and (window.rows % 2, window.columns % 2) == (0, 1)
    scene = load_scene("thin-lens", large + sensor)
    found = fisher(scene, names).bounds
    small = fisher(load_scene("thin-lens", [*large, f"probe.sensor.pixels=[{window.columns}, {window.rows}]"]), names)
    assert found == pytest.approx(small.bounds, rel=1e-6)
    start = {n: torch.tensor(v, dtype=torch.float64) for n, v in true_values(scene, names).items()}
    whole = expected_electrons(scene, start)
    cut = expected_electrons(scene, start, output=window)
    rows, columns = ((310 - window.rows) // 2, (401 - window.columns) // 2)
    inside = whole[rows : rows + window.rows, columns : columns + window.columns]
    assert torch.allclose(inside, cut, atol=1e-3 * float(whole.max()))
    assert float(1 - inside.sum() / whole.sum()) < 0.02


SCENES = {
    "several wavelengths": ("illumination.lines=[{wavelength: 520 nm, power: 1 mW}]",),
    "an LED": ("illumination.bandwidth=10 nm",),
    "an extended source": ("illumination.source_size=0.15 mrad",),
    "a second beam": ("illumination.second_beam={ratio: 0.1, angle: [0.9 mrad, 0.4 mrad]}",),
    "a layer": ("target.sensor.layers=[{depth: 0.5 mm, index: 1.5, reflectance: 0.04}]",),
    "photosites": ("target.sensor.array={pitch: 8.8 um, fill: 0.5}",),
}


@functools.cache
def plain(names: tuple[str, ...]) -> FisherInformation:
    return fisher(bench(), names)


@pytest.mark.parametrize("kind", SCENES)
def test_scenes_of_all_kinds(kind: str) -> None:
    scene, names = bench(*SCENES[kind]), ("gaze_x", "gaze_y", "object_distance", "place_y")
    found = fisher(scene, names)
    assert all(0 < one < math.inf for one in found.bounds.values())
    assert float((plain(names).information - found.information).abs().max()) > 0
    start, step = true_values(scene, names), 1e-5
    up, down = (mean_of(scene, {**start, "gaze_y": start["gaze_y"] + d}) for d in (step, -step))
    mean = mean_of(scene)
    want = (((up - down) / (2 * step)) ** 2 / (mean + noise_variance(scene.probe.sensor))).sum()
    assert float(found.information[1, 1]) == pytest.approx(float(want), rel=1e-2)


def test_scattered_light_tells_of_the_power_and_of_the_tilts_cosine() -> None:
    scene = bench("target.sensor.diffuse={albedo: 0.5}", "target.sensor.reflectance=0", "illumination.power=0.5")
    found = fisher(scene, ("gaze_x", "power"))
    mean = mean_of(scene)
    light = mean - scene.probe.sensor.background
    # It goes by cos²θ = 1/(1 + t²), t = gaze × field/z.
    sensor, z = scene.target.sensor, lens_numbers(scene.target.lens.focal_length, scene.target.object_distance)[0]
    gaze = true_values(scene, ("gaze_x", "gaze_y"))
    across, down = (value * side * sensor.pitch / z for value, side in zip(gaze.values(), sensor.pixels, strict=True))
    slope = 2 * across * sensor.pixels[0] * sensor.pitch / z / (1 + across**2 + down**2)
    told = float((light**2 / (mean + noise_variance(scene.probe.sensor))).sum().sqrt())
    assert found.alone["gaze_x"] == pytest.approx(1 / (slope * told), rel=1e-3)
    want = float(0.5 / (light**2 / (mean + noise_variance(scene.probe.sensor))).sum().sqrt())
    assert found.alone["power"] == pytest.approx(want, rel=1e-4)


@pytest.mark.parametrize(
    ("parameters", "changes", "where", "says"),
    [
        (("gaze_x", "colour"), (), "parameters", "colour"),
        (("gaze_x", "gaze_x"), (), "parameters", "twice"),
        ((), (), "parameters", "none"),
        (("object_distance",), ("target.object_distance=inf",), "parameters", "infinite"),
        (("place_x",), ("target.sensor.diffuse={albedo: 0.5}",), "parameters", "scattered"),
        (("distance",), (*DIVERGING, "illumination.divergence=0.02 deg"), "parameters", "edge"),
    ],
)
def test_refuses(parameters: tuple[str, ...], changes: tuple[str, ...], where: str, says: str) -> None:
    with pytest.raises(InputError, match=says) as raised:
        fisher(bench(*changes), parameters)
    assert where in str(raised.value)


def test_one_name_is_one_parameter() -> None:
    scene = bench()
    assert fisher(scene, "gaze_y").bounds == fisher(scene, ("gaze_y",)).bounds
    # Focused at infinity there is still a gaze.
    far = fisher(bench("target.object_distance=inf"), ("gaze_x", "gaze_y", "place_x"))
    assert all(0 < one < math.inf for one in far.bounds.values())


# A singlet so slow that its aberrations hardly count.
SLOW = (
    "target.rotation=[0.3 deg, 0.5 deg]",
    "probe.sensor.pixels=[64, 64]",
    "probe.sensor.pitch=13.2 um",
    "sampling.accuracy=3e-2",
)
SINGLET = "target.lens={kind: prescription, name: la1509, f_number: 30, design_wavelength: 640 nm}"
GAZE = torch.tensor([[0.11, 0.06]], dtype=torch.float64)


def thin_like(scene: Scene, focal_length: float) -> Scene:
    """A thin lens of the same F-number and gaze as the scene's traced one."""
    lens = scene.target.lens
    radius = lens.aperture_radius * focal_length / lens.focal_length
    return bench(*SLOW, f"target.lens={{focal_length: {focal_length}, aperture_radius: {radius}}}")


@functools.cache
def slow_singlet() -> tuple[Scene, FisherInformation]:
    scene = bench(*SLOW, SINGLET)
    return scene, fisher(scene, TRACED, device="cpu")


def test_traced_lens_tells_what_a_thin_one_does(validated: Validated) -> None:
    real, every = slow_singlet()
    f = real.target.lens.focal_length
    thin = thin_like(real, f)
    names = tuple(name for name in TRACED if name != "focal_length")
    kept = [TRACED.index(name) for name in names]
    found = FisherInformation(names, (0.0,) * len(names), every.information[kept][:, kept])
    want = fisher(thin, names, device="cpu")
    for kind in ("alone", "bounds"):
        a, b = getattr(found, kind), getattr(want, kind)
        error = max(abs(a[name] / b[name] - 1) for name in names)
        what = f"Limits of 6 parameters, traced singlet at f/30, {'others known' if kind == 'alone' else 'all unknown'}"
        validated(SECTION, what, error, 0.1, "a thin lens, automatic differentiation", "of the limit")
    # A prime is scaled as a whole, its stop with it; the gaze stays.
    h, gaze = 1e-5 * f, true_values(thin, ("gaze_x", "gaze_y"))
    more, less = (expected_electrons(thin_like(real, f + d), gaze) for d in (h, -h))
    slope, mean = (more - less).flatten() / (2 * h), expected_electrons(thin, gaze).flatten()
    alone = float(1 / (slope.square() / (mean + noise_variance(thin.probe.sensor))).sum().sqrt())
    error = every.alone["focal_length"] / alone - 1
    what = "Limit of the focal length, traced singlet at f/30, others known"
    validated(SECTION, what, abs(error), 0.1, "a thin lens scaled with its stop, differences", "of the limit")


def bounds_of(slopes: TracedSlopes) -> tuple[dict[str, float], torch.Tensor]:
    """Bounds and slopes at the first gaze."""
    mean, jacobian = slopes(0)
    told = module.information_of(mean, jacobian, slopes.scene.probe.sensor)
    return FisherInformation(slopes.names, (0.0,) * len(slopes.names), told).bounds, jacobian


def test_traced_limits_do_not_hang_on_the_steps(validated: Validated) -> None:
    scene, every = slow_singlet()
    gaze = torch.tensor([list(true_values(scene, ("gaze_x", "gaze_y")).values())], dtype=torch.float64)
    whole, (half, _) = every.bounds, bounds_of(TracedSlopes(scene, TRACED, gaze, step=0.5, device="cpu"))
    error = max(abs(whole[name] / half[name] - 1) for name in TRACED)
    validated(SECTION, "Limits of 7 parameters, traced singlet at f/30", error, 0.06, "steps of half", "of the limit")


def test_roll_turns_the_picture_as_the_gaze_turns_about_the_axis(validated: Validated) -> None:
    """A round lens before a mirror: what turns about its axis turns its picture."""
    scene = bench(*SLOW, SINGLET, "sampling.accuracy=1e-2")
    sensor = scene.target.sensor
    wide, high = (count * sensor.pitch for count in sensor.pixels)
    _, slopes = TracedSlopes(scene, ("gaze_x", "gaze_y", "roll"), GAZE, device="cpu")(0)
    x, y = GAZE[0].tolist()
    want = x * wide / high * slopes[1] - y * high / wide * slopes[0]
    error = (slopes[2] - want).norm() / want.norm()
    what = "Change of the picture with the roll, traced singlet at f/30"
    validated(SECTION, what, float(error), 0.06, "the gaze turned about the axis", "of the change")


def test_photosites_move_under_the_spot_as_the_spot_over_them(validated: Validated) -> None:
    scene = bench(*SLOW, SINGLET, "target.sensor.array={pitch: 26 um, fill: 0.5}")
    alone, (direct,) = bounds_of(TracedSlopes(scene, ("gaze_x",), GAZE, device="cpu"))
    names = ("gaze_x", "photosite_x", "photosite_y")
    unknown, (found, moved, _) = bounds_of(TracedSlopes(scene, names, GAZE, device="cpu"))
    error = float((found - direct).norm() / direct.norm())
    what = "Change of the picture with the gaze, photosites under a traced singlet at f/30"
    validated(SECTION, what, error, 0.03, "small steps of the gaze", "of the change")
    # The photosites make nearly all of it: where they are not known, the gaze is much less so.
    assert float(moved.norm() * scene.target.sensor.pixels[0] * scene.target.sensor.pitch / direct.norm()) > 0.7
    assert unknown["gaze_x"] > 3 * alone["gaze_x"]


@pytest.mark.parametrize(
    ("names", "changes", "says"),
    [
        (("gaze_x", "colour"), (), "unknown parameter 'colour'"),
        (("photosite_x",), (), "a mirror without photosites"),
        (("object_distance",), ("target.sensor.layers=[{depth: 0.5 mm, index: 1.5, reflectance: 0.04}]",), "layers"),
        (("focal_length",), ("target.sensor.diffuse={albedo: 0.5}",), "scattered"),
        (("object_distance",), ("target.object_distance=inf",), "infinity"),
    ],
)
def test_traced_slopes_refuse(names: tuple[str, ...], changes: tuple[str, ...], says: str) -> None:
    with pytest.raises(InputError, match=says):
        TracedSlopes(bench(*SLOW, SINGLET, *changes), names, GAZE)
    with pytest.raises(InputError, match="not traced"):
        TracedSlopes(bench(), ("gaze_x",), GAZE)
