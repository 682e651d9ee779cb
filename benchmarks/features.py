"""The paper's 1092 Zernike features, beside four least-squares fits a frame by the `zernike` package."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tapetum.models import zernike_features
from tapetum.models.features import ORDER, POWERS, SCALES
from tapetum.optics.zernike import disc_coordinates, nm_to_noll

from .measure import Contender, Effort, Figure, Row, in_turns

TITLE = "Zernike features: 1092 of a frame of 400 × 400 pixels"
PEERS = ("zernike",)


def run(effort: Effort) -> list[Row]:
    """A batch by ours, a few frames by the peer, in turns; and how far the two are apart."""
    from zernike import RZern

    count, few = effort.of(64, 8), effort.of(2, 1)
    images = np.random.default_rng(0).integers(0, 256, (count, 400, 400), dtype=np.uint8)
    fits = {}
    for side in SCALES:
        fits[side] = RZern(ORDER)
        x, y = disc_coordinates(side)
        fits[side].make_cart_grid(x.numpy(), y.numpy())

    def theirs(frames: NDArray[np.uint8]) -> NDArray[np.float64]:
        found = []
        for frame in frames:
            for side, fit in fits.items():
                edge = (400 - side) // 2
                root = np.sqrt(frame[edge : edge + side, edge : edge + side].astype(np.float64))
                coefficients = fit.fit_cart_grid(root)[0]
                found += [coefficients**power for power in POWERS]
        return np.concatenate(found).reshape(len(frames), -1)

    timings = in_turns(
        {
            "ours": Contender(lambda: zernike_features(images), work=count),
            "peer": Contender(lambda: theirs(images[:few]), work=few),
        },
        effort.rounds,
    )
    first = fits[SCALES[0]]
    places = [nm_to_noll(int(n), int(m)) - 1 for n, m in zip(first.ntab, first.mtab, strict=True)]
    # Of the whole batch, as it was timed: a single frame takes another, less exact product.
    ours = zernike_features(images, powers=(1,))[:few].reshape(few, len(SCALES), -1)[:, :, places]
    peer = theirs(images[:few]).reshape(few, len(SCALES), len(POWERS), -1)[:, :, 0]
    apart = float(np.abs(ours - peer).max())
    return [
        Row(
            "all features",
            Figure.rate(timings.typical("ours"), "frames"),
            "zernike, fit_cart_grid",
            Figure.rate(timings.typical("peer"), "frames"),
            timings.speed_up("ours", "peer"),
            f"float32 against float64: coefficients differ by {apart:.1g} at most",
        )
    ]
