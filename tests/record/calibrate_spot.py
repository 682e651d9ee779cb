"""Find the weights with which `tapetum.record.blobs` tells a laser from a part of the scene, and print them.

Run from the repository's root: python tests/record/calibrate_spot.py [pictures]
Half of the pictures (even seeds) fit a logistic regression; the other half say how good it is.
"""

from __future__ import annotations

import sys

import numpy as np
from sklearn.linear_model import LogisticRegression
from spot_scenes import SCENES, Laser, expose

from tapetum.record import blobs


def picture(seed: int) -> tuple[str, Laser | None, np.ndarray]:
    """Return the kind of scene, its laser (every second has none) and the picture of a seed."""
    rng = np.random.default_rng(seed)
    kind = list(SCENES)[seed // 4 % len(SCENES)]
    # From dim pictures to ones with burnt out parts.
    scene = SCENES[kind](rng) * np.exp(rng.uniform(np.log(0.08), np.log(1.4)))
    laser = Laser.random(rng, low=50) if seed // 2 % 2 else None
    return kind, laser, expose(scene if laser is None else scene + laser.drawn(), rng)


def main(count: int) -> None:
    """Fit, score, print."""
    rows, truths = [], []
    per_picture = []
    for seed in range(count):
        kind, laser, image = picture(seed)
        found, _, described, _ = blobs.measured(image, None, None)
        error = np.full(len(found), 99.0) if laser is None else np.hypot(found[:, 1] - laser.x, found[:, 2] - laser.y)
        if seed % 2 == 0:
            rows.append(described)
            truths.append(error < 1)
        else:
            per_picture.append((kind, laser, described, error))
    model = LogisticRegression(C=10, max_iter=5000).fit(np.concatenate(rows), np.concatenate(truths))
    print("WEIGHTS =", model.coef_[0].round(2).tolist(), "BIAS =", round(float(model.intercept_[0]), 2))
    for label, weights, bias in (
        ("fitted", model.coef_[0], model.intercept_[0]),
        ("in use", blobs.WEIGHTS, blobs.BIAS),
    ):
        for kind in SCENES:
            right = wrong = quiet = present = absent = candidate = 0
            errors = []
            for _, laser, described, error in (row for row in per_picture if row[0] == kind):
                odds = described @ weights + bias
                best = int(np.argmax(odds))
                if laser is None:
                    absent, quiet = absent + 1, quiet + (odds[best] < 0)
                    continue
                present, candidate = present + 1, candidate + (error.min() < 1)
                right += error[best] < 1 and odds[best] > 0
                wrong += error[best] >= 1 and odds[best] > 0
                if error[best] < 1:
                    errors.append(error[best])
            rms = np.sqrt(np.mean(np.square(errors)))
            print(
                f"{label} {kind:8} candidate {candidate}/{present} found {right}/{present} wrong {wrong} "
                f"quiet when absent {quiet}/{absent} error rms {rms:.3f} median {np.median(errors):.3f} px"
            )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 800)
