"""How the picture of a whole room moved between two frames: the motion of a probe in the hand.

As in trackers that compensate the camera's motion (BoT-SORT: Aharon et al., arXiv:2206.14651): corners are followed
from one frame to the next (Lucas and Kanade, in pyramids: Bouguet 2001), from the shift that phase correlation finds or
else from what matched corners tell, and the turn, scale and shift on which most of them agree is the probe's (RANSAC).
What moves by itself disagrees; where as many as need agree show that the probe stands, it does.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tapetum.detection.registration import common_shift, common_turn, evened

__all__ = ["MotionFinder"]

Array = NDArray[np.float64]

# Most corners, how strong the weakest is beside the strongest, and the pixels of the small frame between two.
_CORNERS, _WEAKEST, _BETWEEN = 200, 0.01, 8
# Corners that must agree, within so many pixels of the small frame, and their least share. In drawn films of textured
# rooms 0.35 to 0.97 agree; where a frame shows noise or shade alone, up to 0.2 do, by chance.
_AGREED, _WITHIN, _SHARE = 12, 1.5, 0.25
# Pixels of the small frame by which a corner of a scene that stands seems to move at most.
_STANDS = 0.5
# How much the scale may change from one frame to the next: a collapse onto one place would agree with anything there.
_SCALES = 0.25
# Pairs of corners that are tried: at the least share one in sixteen has two that agree.
_TRIES = 300
# Of following a corner: the side of its window and how often the frame is halved.
_WINDOW, _HALVED = (15, 15), 2


class MotionFinder:
    """Finds the motion from each frame to the next.

    Between a lit and a dark frame too: each is brought to even mean and contrast first.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> wall = cv2.GaussianBlur(rng.normal(100, 60, (300, 400)).astype(np.float32), (0, 0), 2)
    >>> find = MotionFinder()
    >>> find(wall[20:260, 20:340]) is None
    True
    >>> np.abs(find(wall[25:265, 13:333]) - [[1, 0, 7], [0, 1, -5]]).max().round() + 0
    0.0
    """

    def __init__(self) -> None:
        self._before: tuple[tuple[int, ...], NDArray[np.uint8]] | None = None
        # Whether a turn is sought where no shift fits: it takes several times as long, in vain where nothing is to see.
        self._turns = True

    def __call__(self, image: NDArray[np.generic]) -> Array | None:
        """Return the motion since the frame before.

        Parameters
        ----------
        image
            [H, W] grey levels from 0 to 255, uint8 or float32.

        Returns
        -------
        array or None
            [2, 3] matrix A that takes places of the frame before to this one's, ``A @ (x, y, 1)``, in pixels; None for
            the first frame, after one of another size, and where too little can be followed.
        """
        now = evened(image)
        before, self._before = self._before, (image.shape, now)
        if before is None or before[0] != image.shape:
            return None
        motion = _between(before[1], now, self._turns)
        self._turns = motion is not None
        if motion is None:
            return None
        # A pixel of the small frame covers several of the frame.
        over = np.array(image.shape[::-1]) / now.shape[::-1]
        first = (motion[:, :2] @ (0.5 / over - 0.5) + motion[:, 2] + 0.5) * over - 0.5
        return np.column_stack([motion[:, :2] * over[:, None] / over, first])


def _between(before: NDArray[np.uint8], now: NDArray[np.uint8], turns: bool) -> Array | None:
    """The motion between two small frames, [2, 3], in their pixels; `turns` seeks one that may begin with a turn."""
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, _WEAKEST, _BETWEEN)
    if corners is None or len(corners) < _AGREED:
        return None
    motion = _followed(before, now, corners, common_shift(before, now))
    if motion is None and turns and (start := common_turn(before, now)) is not None:
        motion = _followed(before, now, corners, start)
    return motion


def _followed(before: NDArray[np.uint8], now: NDArray[np.uint8], corners: NDArray, start: NDArray) -> Array | None:
    """The motion on which corners [N, 1, 2] agree that are sought from a first guess of it."""
    expected = np.ascontiguousarray(corners @ start[:, :2].T + start[:, 2], dtype=np.float32)
    found, followed, _ = cv2.calcOpticalFlowPyrLK(
        before, now, corners, expected, winSize=_WINDOW, maxLevel=_HALVED, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    # What has left the picture says nothing.
    kept = (followed[:, 0] > 0) & ((expected >= 0) & (expected <= np.array(now.shape[::-1]) - 1)).all((1, 2))
    if kept.sum() < _AGREED:
        return None
    motion, agreed = cv2.estimateAffinePartial2D(
        corners[kept], found[kept], ransacReprojThreshold=_WITHIN, maxIters=_TRIES
    )
    if motion is None or agreed.sum() < max(_AGREED, _SHARE * kept.sum()):
        return None
    # Before a probe that stands, most of what can be followed may be somebody who walks by.
    at, gone = corners[kept][:, 0], found[kept][:, 0]
    stands = np.linalg.norm(gone - at, axis=1) <= _STANDS
    moved = np.linalg.norm(at @ motion[:, :2].T + motion[:, 2] - at, axis=1)
    if stands.sum() >= max(_AGREED, _SHARE * kept.sum()) and np.median(moved) > _WITHIN:
        return np.eye(2, 3)
    scale = float(np.hypot(*motion[:, 0]))
    return np.asarray(motion, dtype=np.float64) if abs(scale - 1) <= _SCALES else None
