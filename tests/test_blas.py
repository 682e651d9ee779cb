"""BLAS keeps to one thread while anybody wants it, and has its own again afterwards."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from tapetum.blas import one_blas_thread
from tapetum.record.source import Frame
from tapetum.track import Detections, detect, track


def threads() -> set[int]:
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


def test_those_that_overlap_give_back_the_threads_of_before() -> None:
    with threadpool_limits(2, user_api="blas"):
        one, other = one_blas_thread(), one_blas_thread()
        one.__enter__()
        other.__enter__()
        one.__exit__(None, None, None)
        assert threads() == {1}
        other.__exit__(None, None, None)
        assert threads() == {2}


def test_tracking_leaves_cores_to_the_models() -> None:
    """OpenBLAS's threads spin for milliseconds after each of a detector's products."""
    seen = []

    def find(frame: Frame, /) -> Detections:
        seen.append(threads())
        return Detections.empty()

    frames = [Frame(n, n / 30, np.zeros((16, 16), np.uint8)) for n in range(3)]
    with threadpool_limits(2, user_api="blas"):
        for source in (frames, iter(frames)):
            assert len(list(track(source, detector=find))) == 3
        assert threads() == {2}
    assert seen == [{1}] * 6


def test_detection_alone_does_too(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr(
        importlib.import_module("tapetum.track.detector"), "make_maps", lambda *_: seen.append(threads())
    )
    monkeypatch.setattr(importlib.import_module("tapetum.track.detector"), "search", lambda *_: [])
    with threadpool_limits(2, user_api="blas"):
        assert len(detect(np.zeros((16, 16), np.uint8))) == 0
        assert threads() == {2}
    assert seen == [{1}]
