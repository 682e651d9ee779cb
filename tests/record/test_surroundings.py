"""What stands under the laser's spot, by what stands around it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from tapetum.record.labels import UNKNOWN
from tapetum.record.streak import HALF, Streaks, sharpened, unsaturated
from tapetum.record.surroundings import GROUP, surroundings

COUNT, HEIGHT, SIGMA, NOISE = 3 * GROUP, 200.0, 1.2, 2.0
SIDE = 2 * HALF + 1
FINE = 4


def edge(angle: float, offset: float, step: float) -> np.ndarray:
    """A wall with a straight edge that passes `offset` px from the spot, drawn with `FINE` pixels a pixel."""
    y, x = np.mgrid[-2 * HALF : 2 * HALF + 1 : 1 / FINE, -2 * HALF : 2 * HALF + 1 : 1 / FINE]
    beyond = np.cos(angle) * x + np.sin(angle) * y > offset
    return gaussian_filter(60.0 + step * beyond, 0.8 * FINE)


def filmed(wall: np.ndarray, seed: int, count: int = COUNT, height: float = HEIGHT) -> tuple[np.ndarray, np.ndarray]:
    """Patches [N, S, S] of frames in which the camera turns, and true places [N, 2] of the spot in them."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-0.5, 0.5, (count, 2))
    y, x = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1]
    patches = []
    for px, py in places:
        at = [(y - py + 2 * HALF) * FINE, (x - px + 2 * HALF) * FINE]
        spot = height * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * SIGMA**2))
        patches.append(map_coordinates(wall, at, order=1) + spot + NOISE * rng.standard_normal((SIDE, SIDE)))
    return np.array(patches, np.float32), places


def fitted(patches: np.ndarray, begin: Streaks | None = None) -> Streaks:
    count = len(patches)
    return sharpened(patches, np.zeros((count, 2)), np.full(count, SIGMA), np.full(count, 255.0), begin)


def cleared(patches: np.ndarray) -> tuple[Streaks, np.ndarray]:
    """Fits to what is left of patches without the surroundings, and the deviations that are stated."""
    found, unknown = fitted(patches), np.zeros((len(patches), 2))
    for _ in range(2):
        under, unknown = surroundings(patches, found, np.ones(len(patches), bool), np.arange(len(patches)))
        found = fitted(patches - under, found)
    return found, unknown


def texture(seed: int, grain: float, deviation: float) -> np.ndarray:
    """What a wall varies by about a spot, smooth over `grain` px."""
    noise = np.random.default_rng([seed, 3]).standard_normal((FINE * (4 * HALF + 1),) * 2)
    smooth = gaussian_filter(noise, grain * FINE)
    return deviation * smooth / smooth.std()


def saturated(patches: np.ndarray) -> np.ndarray:
    return unsaturated(np.minimum(patches, 255), np.full(len(patches), 255.0))


def test_what_a_pixel_pulls_predicts_how_far_a_texture_draws_a_saturated_spot() -> None:
    y, x = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1]
    drawn, predicted = [], []
    for seed in range(8):
        wall = texture(seed, 2.0, 8.0)
        patches, places = filmed(100 + wall, seed, height=320.0)
        shown = saturated(patches)
        at = [[(one + 2 * HALF) * FINE for one in (y - py, x - px)] for px, py in places]
        under = np.stack([map_coordinates(wall, one, order=1) for one in at]).reshape(COUNT, -1)
        found = fitted(shown)
        drawn.append((found.places - places).mean(axis=0))
        pulls = found.pulls(np.isfinite(shown).reshape(COUNT, -1))
        predicted.append(np.einsum("nkp,np->nk", pulls, under).mean(axis=0))
    # Of pixels that are not saturated; with all of them a third would be missing.
    assert np.vdot(drawn, predicted) / np.vdot(predicted, predicted) == pytest.approx(1, abs=0.1)
    assert np.std(np.subtract(drawn, predicted)) < 0.2 * np.std(drawn)


def test_under_a_spot_on_an_even_wall_nothing_is_seen() -> None:
    patches, _ = filmed(np.full((FINE * (4 * HALF + 1),) * 2, 60.0), 4, height=150.0)
    under, _ = surroundings(patches, fitted(patches), np.ones(COUNT, bool), np.arange(COUNT))
    # The spot's own light about it would be twelve digital numbers.
    assert np.nanmax(np.abs(under - 60)[:, 6:-6, 6:-6]) < 4


@pytest.mark.parametrize("axis", [0, 1])
def test_what_is_unknown_draws_a_streak_most_along_itself(axis: int) -> None:
    # Its ends alone say where it is.
    patches, _ = filmed(100 + texture(3, 2.0, 15.0), 3, height=0.0)
    y, x = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1]
    for part in np.linspace(-3, 3, 25):
        along, across = (x, y) if axis == 0 else (y, x)
        patches += (HEIGHT / 25 * np.exp(-((along - part) ** 2 + across**2) / (2 * SIGMA**2))).astype(np.float32)
    _, unknown = surroundings(patches, fitted(patches), np.ones(COUNT, bool), np.arange(COUNT))
    middle = np.median(unknown, axis=0)
    assert middle[axis] > 1.5 * middle[1 - axis]


@pytest.mark.parametrize("angle", np.radians([0, 30, 45, 75, 90]))
@pytest.mark.parametrize("offset", [0.7, 2.5])
def test_an_edge_under_the_spot_hardly_draws_it_aside(angle: float, offset: float) -> None:
    patches, places = filmed(edge(angle, offset, 60.0), 5)
    along = np.array([np.cos(angle), np.sin(angle)])
    alone = float((fitted(patches).places - places).mean(axis=0) @ along)
    found, unknown = cleared(patches)
    left = np.linalg.norm((found.places - places).mean(axis=0))
    assert abs(alone) > 0.04
    assert left < 0.35 * abs(alone)
    assert left < 4 * np.linalg.norm(np.median(unknown, axis=0))


def test_what_is_said_to_be_unknown_is_how_far_walls_draw_spots_aside() -> None:
    rng, scores = np.random.default_rng(8), []
    for seed in range(40):
        edges = [edge(rng.uniform(0, np.pi), rng.uniform(-6, 6), rng.normal(0, 30)) for _ in range(3)]
        wall = np.sum(edges, axis=0) - 120.0
        grain = gaussian_filter(rng.standard_normal(wall.shape), 2 * FINE)
        patches, places = filmed(wall + 3 * grain / grain.std(), seed, 2 * GROUP)
        found, unknown = cleared(patches)
        noise = NOISE / HEIGHT / np.sqrt(len(patches))
        scores.append((found.places - places).mean(axis=0) / np.hypot(np.median(unknown, axis=0), noise))
    assert 0.9 < np.sqrt(np.mean(np.square(scores))) < 1.8
    assert np.mean(np.abs(scores) < 1.645) > 0.75


def test_a_fine_texture_under_a_saturated_spot_is_partly_known_and_the_rest_is_stated() -> None:
    """Frames moved onto each other must keep the texture, and pixels that are saturated say nothing of the place."""
    alone, left, stated = [], [], []
    for seed in range(12):
        patches, places = filmed(100 + texture(seed, 1.5, 15.0), seed, height=320.0)
        patches = saturated(patches)
        found, unknown = cleared(patches)
        alone.append((fitted(patches).places - places).mean(axis=0))
        left.append((found.places - places).mean(axis=0))
        stated.append(UNKNOWN * np.median(unknown, axis=0))
    rms = [float(np.sqrt(np.mean(np.square(one)))) for one in (alone, left, np.divide(left, stated))]
    assert rms[1] < 0.6 * rms[0]
    assert 0.7 < rms[2] < 1.4


def test_frames_far_away_take_no_part() -> None:
    """Parts of a recording are labelled like the whole."""
    patches, _ = filmed(edge(0.3, 1.0, 50.0), 2, 8 * GROUP)
    found, good, numbers = fitted(patches), np.ones(len(patches), bool), np.arange(len(patches))
    whole, unknown = surroundings(patches, found, good, numbers)
    part = slice(2 * GROUP, 7 * GROUP)
    alone, alone_unknown = surroundings(patches[part], fitted(patches[part]), good[part], numbers[part])
    inner = slice(GROUP, -GROUP)
    np.testing.assert_allclose(alone[inner], whole[part][inner], atol=1e-3)
    np.testing.assert_allclose(alone_unknown[inner], unknown[part][inner], rtol=1e-3)


def test_few_frames_and_frames_without_a_laser_say_nothing() -> None:
    patches, _ = filmed(edge(0.3, 1.0, 50.0), 2)
    found, good, numbers = fitted(patches), np.ones(len(patches), bool), np.arange(len(patches))
    good[3] = False
    pictures, unknown = surroundings(patches, found, good, numbers)
    assert (pictures[3] == 0).all() and np.isnan(unknown[3]).all()
    assert np.isfinite(unknown[good]).all() and (pictures[4] != 0).any()
    # Two frames; and frames at the edge of the image, of which hardly a pixel is seen.
    pictures, unknown = surroundings(patches[:2], fitted(patches[:2]), good[:2], numbers[:2])
    assert (pictures == 0).all() and np.isnan(unknown).all()
    patches[:, :, : HALF + 5] = np.nan
    patches[:, : HALF + 2] = np.nan
    pictures, unknown = surroundings(patches, found, np.ones(COUNT, bool), numbers)
    assert (pictures == 0).all() and np.isnan(unknown).all()
