"""How the picture of a room moved between two frames, beside what warped them."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from tapetum.detection.global_motion import MotionFinder
from tapetum.track.motion import MOTION, motion_columns, motion_of

SIZE, RIM = (640, 480), 120
# Where two matrices are compared.
PLACES = np.array([(x, y) for x in (60, 320, 580) for y in (60, 240, 420)], dtype=np.float64)


def room(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    width, height = SIZE[0] + 2 * RIM, SIZE[1] + 2 * RIM
    picture = np.full((height, width), 80.0, np.float32)
    for _ in range(150):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        w, h = rng.uniform(10, 120, 2)
        cv2.rectangle(picture, (int(x), int(y)), (int(x + w), int(y + h)), float(rng.uniform(20, 150)), -1)
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 1.0))


def shot(
    picture: np.ndarray, shift: tuple[float, float], turn: float, scale: float, seed: int, lit: bool
) -> tuple[np.ndarray, np.ndarray]:
    """A frame in bytes, with noise, and the matrix [2, 3] from the picture's places to the frame's."""
    height, width = picture.shape
    way = cv2.getRotationMatrix2D((width / 2, height / 2), turn, scale)
    way[:, 2] += shift
    light = picture * (1.2 if lit else 1.0)
    if lit:
        for x, y in ((300, 300), (500, 400), (700, 250)):
            cv2.circle(light, (x, y), 6, 255.0, -1)
    moved = cv2.warpAffine(light, way, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    way[:, 2] -= RIM
    seen = moved[RIM:-RIM, RIM:-RIM] + np.random.default_rng(seed).normal(0, 2, SIZE[::-1])
    return np.clip(seen, 0, 255).round().astype(np.uint8), way


def between(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    turned = after[:, :2] @ np.linalg.inv(before[:, :2])
    return np.column_stack([turned, after[:, 2] - turned @ before[:, 2]])


def apart(found: np.ndarray | None, true: np.ndarray) -> float:
    """Largest distance between where two matrices take places of the frame, pixels."""
    assert found is not None
    gone, went = (PLACES @ one[:, :2].T + one[:, 2] for one in (found, true))
    return float(np.linalg.norm(gone - went, axis=1).max())


@pytest.mark.parametrize(
    ("shift", "turn", "scale"),
    [((0, 0), 0, 1), ((3.4, -7.7), 0, 1), ((-70, 45), 0.6, 1), ((90, 5), -1.0, 1.01), ((20, -60), 2.0, 0.98)],
)
@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_shift_turn_and_scale_are_found_between_a_dark_and_a_lit_frame(
    shift: tuple[float, float], turn: float, scale: float, kind: type
) -> None:
    picture, find = room(1), MotionFinder()
    (dark, first), (lit, second) = shot(picture, (0, 0), 0, 1, 0, False), shot(picture, shift, turn, scale, 1, True)
    assert find(dark.astype(kind)) is None
    assert apart(find(lit.astype(kind)), between(first, second)) < 0.5


def test_large_frames_are_reduced_first() -> None:
    picture, find = room(2), MotionFinder()
    frames, ways = zip(
        *(shot(picture, one, 0.3, 1, n, n == 1) for n, one in enumerate([(0, 0), (-17, 22)])), strict=True
    )
    large = [cv2.resize(one, (2560, 1920), interpolation=cv2.INTER_CUBIC) for one in frames]
    assert find(large[0]) is None
    found = find(large[1])
    true = between(*ways)
    # Of pixels that are a quarter as wide, the first is three eighths of a wide one nearer to the corner.
    true[:, 2] = 4 * (true[:, 2] + true[:, :2] @ [-0.375, -0.375] + 0.375)
    assert found is not None
    assert np.linalg.norm(4 * PLACES @ (found - true)[:, :2].T + (found - true)[:, 2], axis=1).max() < 1.5


def test_what_moves_by_itself_does_not_count() -> None:
    """A person over a quarter of the picture walks one way while the probe goes another."""
    picture, person, find = room(3), room(4)[:500, :250] * 0.8, MotionFinder()
    ways, found = [], None
    for n, (shift, at) in enumerate([((0, 0), 300), ((12, -9), 340)]):
        scene = picture.copy()
        scene[150:650, at : at + 250] = person
        image, way = shot(scene, shift, 0, 1, n, n == 1)
        ways.append(way)
        found = find(image)
    assert apart(found, between(*ways)) < 0.7


def test_a_picture_that_grows_by_a_third_is_no_motion_of_a_hand() -> None:
    picture, find = room(6), MotionFinder()
    find(shot(picture, (0, 0), 0, 1, 0, False)[0])
    assert find(shot(picture, (0, 0), 0, 1.35, 1, False)[0]) is None


@pytest.mark.parametrize("wide", [250, 350])
def test_before_a_probe_that_stands_somebody_close_walks_by(wide: int) -> None:
    picture, person, find = room(3), room(4)[:, :wide] * 0.8, MotionFinder()
    found = []
    for n, at in enumerate((180, 196, 212)):
        scene = picture.copy()
        scene[:, at : at + wide] = person
        found.append(find(shot(scene, (0, 0), 0, 1, n, n == 1)[0]))
    assert all(apart(one, np.eye(2, 3)) < 0.5 for one in found[1:])


def test_where_nothing_can_be_followed_none_is_said() -> None:
    rng, find = np.random.default_rng(0), MotionFinder()
    dark = [rng.normal(20, 3, SIZE[::-1]).clip(0, 255).astype(np.uint8) for _ in range(4)]
    assert [find(one) for one in dark] == [None] * 4
    flat = np.full(SIZE[::-1], 100, np.uint8)
    assert [find(flat), find(flat)] == [None] * 2
    picture = room(1)
    first, _ = shot(picture, (0, 0), 0, 1, 0, False)
    # After noise, after another scene, and after a frame of another size.
    other, _ = shot(room(9), (0, 0), 0, 1, 0, False)
    assert [find(first), find(other), find(first[:400])] == [None] * 3
    assert find(first[:400]) is not None


@pytest.mark.parametrize("turn", [0.0, 0.7, -2.0])
def test_a_motion_goes_through_a_table(turn: float) -> None:
    size = (640, 480)
    a, b = 1.02 * math.cos(turn), 1.02 * math.sin(turn)
    matrix = np.array([[a, -b, 31.0], [b, a, -12.5]])
    columns = motion_columns(matrix, size)
    assert tuple(columns) == MOTION
    assert columns["turn"] == pytest.approx(turn) and columns["scale"] == pytest.approx(1.02)
    middle = np.array([319.5, 239.5])
    assert matrix @ [*middle, 1] - middle == pytest.approx([columns["shift_x"], columns["shift_y"]])
    assert motion_of(columns, size) == pytest.approx(matrix)
    assert motion_columns(None, size) == {} and motion_of({}, size) is None and motion_of(columns, None) is None
