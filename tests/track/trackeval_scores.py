"""Score sequences with TrackEval (Luiten and Hoffhues, MIT licence), in its own environment.

Reads JSON from standard input: a list of sequences, each a list of frames (true numbers, track numbers, likenesses
[truth, tracks]). Writes a list of scores.
"""

from __future__ import annotations

import contextlib
import json
import sys
from typing import Any

import numpy as np
from trackeval.metrics import CLEAR, HOTA, Identity  # pyright: ignore[reportMissingImports]


def numbered(lists: list[list[int]]) -> tuple[list[np.ndarray], int]:
    """Number what occurs from 0 on."""
    names = sorted({name for one in lists for name in one})
    place = {name: n for n, name in enumerate(names)}
    return [np.array([place[name] for name in one], dtype=int) for one in lists], len(names)


def scores(sequence: list[list[Any]]) -> dict[str, float]:
    truth, true_names = numbered([frame[0] for frame in sequence])
    tracks, names = numbered([frame[1] for frame in sequence])
    data = {
        "num_timesteps": len(sequence),
        "num_gt_ids": true_names,
        "num_tracker_ids": names,
        "num_gt_dets": sum(map(len, truth)),
        "num_tracker_dets": sum(map(len, tracks)),
        "gt_ids": truth,
        "tracker_ids": tracks,
        "similarity_scores": [
            np.array(frame[2], dtype=float).reshape(len(frame[0]), len(frame[1])) for frame in sequence
        ],
    }
    # They report on standard output.
    with contextlib.redirect_stdout(sys.stderr):
        hota = HOTA().eval_sequence(data)
        clear = CLEAR({"PRINT_CONFIG": False}).eval_sequence(data)
        identity = Identity({"PRINT_CONFIG": False}).eval_sequence(data)
    return {
        **{name: float(np.mean(hota[key])) for name, key in (("hota", "HOTA"), ("deta", "DetA"), ("assa", "AssA"))},
        **{name: float(clear[key]) for name, key in (("mota", "MOTA"), ("changes", "IDSW"))},
        **{name: float(clear[key]) for name, key in (("missed", "CLR_FN"), ("false", "CLR_FP"))},
        "idf1": float(identity["IDF1"]),
    }


if __name__ == "__main__":
    json.dump([scores(sequence) for sequence in json.load(sys.stdin)], sys.stdout)
