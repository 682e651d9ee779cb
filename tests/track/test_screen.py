"""What a quick look at a frame leaves out holds no spot: close looks at few parts find what one at the whole finds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from probe_frames import add_spot, hot_pixels, probe_frame

from tapetum.track import Detections, detect
from tapetum.track.background import fit_ground
from tapetum.track.screen import Part, parts_of, reduced
from tapetum.track.sheet import laid_out


def whole(image: np.ndarray, *_: object) -> list[Part]:
    return [Part(0, image.shape[0], 0, image.shape[1])]


def scattered(seed: int, shape: tuple[int, int] = (480, 640)) -> np.ndarray:
    """Spots of 3 to 60 px, from hardly there to saturated, with hot pixels, on grounds from black to bright."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 8))
    spots = [
        (rng.uniform(-3, 643), rng.uniform(-3, 483), math.exp(rng.uniform(1.1, 4.1)), math.exp(rng.uniform(0.7, 5.6)))
        for _ in range(count)
    ]
    image = probe_frame(rng, spots, hot_pixels(seed), [6.0, 1.0, 20.0, 0.2][seed % 4])
    return image[: shape[0], : shape[1]]


def assert_alike(one: Detections, other: Detections, image: np.ndarray) -> None:
    """Each spot of an SNR of 7 or more stands in both, with its height and size."""
    for first, second in ((one, other), (other, one)):
        for spot in first[first.snr >= 7]:
            off = np.hypot(second.x - spot.x, second.y - spot.y)
            n = int(off.argmin()) if len(second) else -1
            assert n >= 0 and off[n] < max(0.1, 0.02 * spot.diameter[0]), (image.shape, spot.to_table().to_pylist())
            assert second.peak[n] == pytest.approx(spot.peak[0], rel=0.01)
            assert second.diameter[n] == pytest.approx(spot.diameter[0], rel=0.05)


@pytest.mark.parametrize("shape", [(480, 640), (471, 633), (97, 203), (34, 50)])
def test_few_parts_hold_all_that_the_whole_frame_does(shape: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    images = [scattered(seed, shape) for seed in range(24)]
    ours = [detect(image) for image in images]
    monkeypatch.setattr("tapetum.track.spots.parts_of", whole)
    for image, found in zip(images, ours, strict=True):
        assert_alike(found, detect(image), image)


@pytest.mark.parametrize("kind", [np.uint16, np.float32])
def test_other_numbers_are_screened_alike(kind: type, monkeypatch: pytest.MonkeyPatch) -> None:
    images = [scattered(seed).astype(kind) * (kind(200) if kind is np.uint16 else kind(1 / 255)) for seed in range(8)]
    ours = [detect(image) for image in images]
    monkeypatch.setattr("tapetum.track.spots.parts_of", whole)
    for image, found in zip(images, ours, strict=True):
        assert_alike(found, detect(image), image)


def test_an_empty_frame_is_hardly_looked_at() -> None:
    """Hot pixels and noise are no reason; a spot is, and its surroundings come with it."""
    faint = np.zeros((120, 160), np.float32)
    rng = np.random.default_rng(3)
    image, empty = probe_frame(rng, [(300, 200, 20, 90)], hot_pixels(3)), probe_frame(rng, (), hot_pixels(3))
    found = []
    for one in (image, empty):
        small = reduced(one)
        found.append(parts_of(one, small, fit_ground(one, small.quarter, 1.0), faint, 5.3, 6.0))
    ((part,), none) = found
    assert none == []
    assert part.left <= 300 - 20 and part.right >= 300 + 20 and part.top <= 200 - 20 and part.bottom >= 200 + 20
    assert (part.right - part.left) * (part.bottom - part.top) < 0.06 * image.size


def test_reduced_frames_are_exact_means() -> None:
    image = np.random.default_rng(5).integers(0, 256, (39, 50), dtype=np.uint8)
    small = reduced(image)
    assert small.half.shape == (19, 25) and small.quarter.shape == (9, 12)
    halves = image[:38, :50].reshape(19, 2, 25, 2).mean(axis=(1, 3))
    np.testing.assert_array_equal(small.half * small.unit, halves)
    np.testing.assert_array_equal(small.quarter, image[:36, :48].reshape(9, 4, 12, 4).mean(axis=(1, 3)))


def test_a_bright_spots_halo_is_no_second_spot() -> None:
    """The wide smoothing carries light past a spot's own area; no ghost rule is needed to see that it is one."""
    for width in (8, 16, 30, 60):
        light = np.full((480, 640), 5.0)
        add_spot(light, 320, 240, width, 230, 0, 0)
        noise = np.random.default_rng(width).normal(0, 1, light.shape)
        image = np.clip(np.rint(light + noise), 0, 255).astype(np.uint8)
        assert len(detect(image, ghost_ratio=0, stray=0)) == 1, width


def test_windows_on_a_sheet_do_not_overlap() -> None:
    rng = np.random.default_rng(2)
    sizes = [(int(h), int(w)) for h, w in rng.integers(1, 90, (40, 2))]
    windows, shape = laid_out(sizes, 4)
    taken = np.zeros(shape, int)
    for (rows, columns), size in zip(windows, sizes, strict=True):
        assert rows.start % 4 == columns.start % 4 == 0
        assert (rows.stop - rows.start, columns.stop - columns.start) == size
        taken[rows, columns] += 1
    assert taken.max() == 1 and taken.sum() == sum(h * w for h, w in sizes)
    assert taken.size < 2 * taken.sum()


def test_spots_close_together_on_the_sheet_do_not_mix() -> None:
    """What is found of a spot does not depend on which others there are, far from it in the frame."""
    rng = np.random.default_rng(6)
    places = [(60.0 + 130 * k, 60.0 + 120 * n) for k in range(5) for n in range(4)]
    spots = [(x, y, rng.uniform(8, 40), rng.uniform(100, 400)) for x, y in places]
    noise = rng.normal(6, 1, (480, 640))
    light = noise.copy()
    for spot in spots:
        add_spot(light, *spot)
    together = detect(np.clip(np.rint(light), 0, 255).astype(np.uint8), ghosts="mark")
    for spot in spots:
        light = noise.copy()
        add_spot(light, *spot)
        alone = detect(np.clip(np.rint(light), 0, 255).astype(np.uint8))[0]
        n = int(np.hypot(together.x - spot[0], together.y - spot[1]).argmin())
        assert_alike(alone, together[n], light)
