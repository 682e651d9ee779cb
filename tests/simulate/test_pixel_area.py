"""A picture holds the mean over each pixel's sensitive area, however coarse its pixels are."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import tapetum as tp
from references.judge import Effort, judge, pixel_places
from tapetum.bench import Scene, with_values
from tapetum.errors import InputError
from tapetum.optics.grid import Grid
from tapetum.simulate import retroreflect
from tapetum.simulate.pixel_area import PixelArea, change_by_area
from tapetum.simulate.planning import plan_bench

SECTION = "A pixel's area"
PITCH = 2e-6


def wave(x: torch.Tensor, y: torch.Tensor, across: float, down: float) -> torch.Tensor:
    """A picture of two periods, in metres."""
    bright = torch.cos(2 * math.pi * x / across + 0.3)[None, :] * torch.cos(2 * math.pi * y / down - 1.1)[:, None]
    return 1 + bright


@pytest.mark.parametrize("fill", [1.0, 0.5, 0.1])
@pytest.mark.parametrize("period", [9.0, 3.0, 2.3, 1.5, 0.7, 0.21])
def test_means_of_waves(period: float, fill: float, validated) -> None:
    """Of a wave twice as long as the finest, whose transform there is half of what it is at most."""
    pixels = Grid(20, 23, PITCH, (3e-6, -1e-6))
    area = PixelArea.of(pixels, fill, period * PITCH, 0.01)
    across, down = 2 * period * PITCH, 3.3 * period * PITCH
    found = area.means(wave(area.samples.x(), area.samples.y(), across, down))
    side = math.sqrt(fill) * PITCH
    less = math.prod(float(np.sinc(side / one)) for one in (across, down))
    wanted = 1 + less * (wave(pixels.x(), pixels.y(), across, down) - 1)
    assert found.shape == wanted.shape
    # The error is that of a picture, whose finest periods are faint.
    apart = float((found - wanted).abs().max())
    assert area.error <= 1.1e-3
    validated(SECTION, f"mean of a wave, pixels of {1 / period:.2g} periods, fill {fill:g}", apart, 2.1e-3, "sinc")


def test_points_are_what_was_computed() -> None:
    pixels = Grid(4, 5, PITCH)
    area = PixelArea.of(pixels, 0.0, 1e-9, 0.01)
    picture = torch.rand(2, 4, 5)
    assert area.samples == pixels and area.means(picture) is picture


def test_means_of_many_pictures_carry_gradients() -> None:
    area = PixelArea.of(Grid(6, 7, PITCH), 1.0, 1.3 * PITCH, 0.01)
    pictures = torch.rand(2, 3, *area.samples.shape, dtype=torch.float64)
    plain = area.means(pictures)
    followed = area.means(pictures.requires_grad_())
    torch.testing.assert_close(plain, followed.detach(), rtol=1e-12, atol=1e-12)
    followed.sum().backward()
    # What each sample counts for adds up to one a pixel.
    assert pictures.grad is not None
    assert float(pictures.grad.sum()) == pytest.approx(2 * 3 * 42)


def test_pixels_of_too_many_periods_are_refused() -> None:
    with pytest.raises(InputError, match="periods of the picture's finest fringes"):
        PixelArea.of(Grid(6, 7, PITCH), 1.0, PITCH / 200, 0.01)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"probe.sensor.pitch": 5e-6, "probe.sensor.fill": 1.0}, "pixels of a quarter of a period"),
        ({"probe.sensor.pitch": 30e-6, "probe.sensor.fill": 0.6}, "pixels of 1.4 periods, fill 0.6"),
    ],
)
def test_a_thin_lens_s_picture(changes: dict[str, object], what: str, validated) -> None:
    changes |= {"probe.sensor.pixels": [21, 21], "target.rotation": ["0.3 deg", "-0.2 deg"], "sampling.accuracy": 1e-3}
    scene = with_values(tp.load_scene("thin-lens"), changes)
    image = retroreflect(scene)
    found, sensor = image.numpy()[0], scene.probe.sensor
    # Gauss-Legendre points over the sensitive square of some pixels.
    nodes, weights = np.polynomial.legendre.leggauss(5)
    rows, columns = (one.ravel() for one in np.meshgrid([4, 10, 13], [7, 10, 11], indexing="ij"))
    shift = math.sqrt(sensor.fill) / 2 * nodes
    dy, dx = (one.ravel() for one in np.meshgrid(shift, shift, indexing="ij"))
    places = pixel_places(
        (columns[:, None] + dx).ravel().astype(float),
        (rows[:, None] + dy).ravel().astype(float),
        (21, 21),
        sensor.pitch,
    )
    seen = judge(scene, places, False, Effort.of(1e-3)).reshape(-1, 25) @ (np.outer(weights, weights).ravel() / 4)
    error = float(np.abs(found[rows, columns] - seen).max() / found.max())
    validated(SECTION, f"a thin lens, {what}", error, float(image.metadata["expected_error"]), "the judge")


def test_wide_pixels_lose_no_light_wherever_the_picture_lies() -> None:
    """Taken for points they see more or less of it by its place between them."""
    wide = {"probe.sensor.pitch": 60e-6, "probe.sensor.pixels": [41, 41], "probe.sensor.fill": 1.0}
    scene = with_values(tp.load_scene("thin-lens"), wide)

    def light(scene: Scene, place: tuple[float, float]) -> float:
        camera = tp.Camera(scene, 1e-3, device="cpu")
        return float(camera(torch.zeros(1, 2, dtype=torch.float64), torch.tensor([place], dtype=torch.float64)).sum())

    whole = [light(scene, place) for place in ((0, 0), (20e-6, 0), (30e-6, 30e-6))]
    assert max(whole) < 1.01 * min(whole)
    points = with_values(scene, {"probe.sensor.fill": 0})
    assert light(points, (0, 0)) > 1.1 * light(points, (30e-6, 30e-6))


def test_a_plan_counts_the_samples_of_wide_pixels() -> None:
    wide = with_values(tp.load_scene("thin-lens"), {"probe.sensor.pitch": 60e-6})
    points, means = (
        plan_bench(with_values(wide, {"probe.sensor.fill": fill})).sampling.memory_bytes for fill in (0, 1)
    )
    # Forty-nine samples a pixel and more; the pupil's take as much memory as before.
    assert means > 2 * points


def test_what_points_leave_out_is_said() -> None:
    changes = {"target.rotation": ["0.3 deg", "-0.2 deg"], "probe.sensor.pixels": [81, 81]}
    scene = with_values(tp.load_scene("thin-lens"), changes)
    points, means = (retroreflect(with_values(scene, {"probe.sensor.fill": fill})) for fill in (0, 1))
    inner = (slice(None), slice(8, -8), slice(8, -8))
    apart = float(np.abs(points.numpy() - means.numpy())[inner].max() / points.numpy().max())
    assert points.metadata["change_by_area"] == pytest.approx(apart, rel=0.05)
    assert 1e-3 < apart < 1e-2
    assert means.metadata["change_by_area"] == 0
    wide = retroreflect(with_values(scene, {"probe.sensor.pitch": 30e-6}))
    assert wide.metadata["change_by_area"] == math.inf


@pytest.mark.parametrize(
    ("period", "least", "most"), [(200.0, 0.0, 1e-4), (8.0, 1e-3, 0.02), (2.0, math.inf, math.inf)]
)
@pytest.mark.parametrize("side", [40, 3])
def test_the_change_of_pictures_of_any_size(period: float, least: float, most: float, side: int) -> None:
    pixels = Grid(side, side + 1, PITCH)
    picture = wave(pixels.x(), pixels.y(), 2 * period * PITCH, 2 * period * PITCH)[None]
    change = change_by_area(picture, pixels, period * PITCH)
    # Of few pixels it is what the finest fringes lose, which is more.
    assert least <= change <= (most if side > 3 else 8 * most)
