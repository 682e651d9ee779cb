"""Our scores of tracks are TrackEval's, the reference code of HOTA, in an environment of its own: `make peers`."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from test_following import filmed, followed

from tapetum.track.metrics import score_tracks

ROOT = Path(__file__).parents[2]
PYTHON = Path(os.environ.get("TAPETUM_PEERS", ROOT / ".peers")) / "bin" / "python"
REACH = 20.0

needs_trackeval = pytest.mark.skipif(not PYTHON.exists(), reason="no environment with TrackEval: run `make peers`")

Frames = list[tuple[np.ndarray, np.ndarray]]


def sequences() -> list[tuple[Frames, Frames]]:
    """Truth and tracks from nearly right to hopeless: few and many, with and without common motion taken out."""
    made = []
    for seed, (targets, rms, options) in enumerate(
        [
            (1, 5.0, {}),
            (5, 60.0, {"persist": (3, 5)}),
            (30, 60.0, {"persist": (3, 5)}),
            # Every identity is lost again and again.
            (12, 60.0, {"shake": 0.0}),
            (5, 25.0, {"shake": 0.0, "max_coast": 0.1}),
        ]
    ):
        truth, found = filmed(np.random.default_rng(seed), targets, rms, frames=60, missed=0.1, false=2.0)
        made.append((truth, [(np.array(a), np.array(b)) for a, b in followed(found, **options)]))
    rng = np.random.default_rng(9)
    # Places that stray up to and past the reach, numbers that swap, frames without either.
    for _ in range(5):
        truth, tracks = [], []
        names = rng.permutation(8)
        for n in range(40):
            if rng.random() < 0.1:
                names = rng.permutation(8)
            place = np.column_stack([15.0 * np.arange(8) + n, np.zeros(8)])
            there, said = rng.random(8) < 0.8, rng.random(8) < (0.0 if n == 20 else 0.8)
            truth.append((np.arange(8)[there], place[there]))
            tracks.append((names[said], place[said] + rng.normal(0, 6, (int(said.sum()), 2))))
        made.append((truth, tracks))
    return made


@needs_trackeval
def test_our_scores_are_trackevals(validated) -> None:
    made = sequences()
    asked = []
    for truth, tracks in made:
        frames = []
        for (names, places), (said, where) in zip(truth, tracks, strict=True):
            apart = np.linalg.norm(np.reshape(places, (-1, 1, 2)) - np.reshape(where, (1, -1, 2)), axis=2)
            frames.append(
                [np.asarray(names).tolist(), np.asarray(said).tolist(), np.maximum(0, 1 - apart / REACH).tolist()]
            )
        asked.append(frames)
    script = Path(__file__).with_name("trackeval_scores.py")
    done = subprocess.run([PYTHON, script], input=json.dumps(asked), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    theirs = json.loads(done.stdout)
    assert len(theirs) == len(made)
    idf1 = []
    for (truth, tracks), one in zip(made, theirs, strict=True):
        ours = vars(score_tracks(truth, tracks, reach=REACH))
        idf1.append(ours["idf1"])
        for name, value in one.items():
            validated("Scores of tracks", name.upper(), abs(ours[name] - value), 1e-9, "TrackEval 1.3.0", "of one")
    # From all right to nearly nothing.
    assert max(idf1) > 0.9 and min(idf1) < 0.3
