"""A small made-up demo: smooth gaze, a good and a poor model."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tapetum.models import Prediction
from tapetum.report import DemoReport, ModelResult, SignEvidence, SignRate, Tracking
from tapetum.report.evaluation import Outcome


@pytest.fixture(scope="session")
def gaze() -> tuple[np.ndarray, np.ndarray]:
    """Two videos of 60 frames: time [120] and gaze [120, 2]."""
    time = np.concatenate([np.arange(60), np.arange(60)]) / 15.0
    turn = np.linspace(0, 4 * np.pi, 120)
    return time, np.stack([0.4 * np.sin(turn), 0.35 * np.cos(0.7 * turn)], axis=1)


def outcome_of(time: np.ndarray, truth: np.ndarray, value: np.ndarray, half: float = np.inf) -> Outcome:
    """What a model says of these gazes, with intervals of this half width."""
    return Outcome(
        dataset="demo.zarr",
        prediction=Prediction(("gaze_x", "gaze_y"), value, value - half, value + half),
        truth={"gaze_x": truth[:, 0], "gaze_y": truth[:, 1]},
        recording=np.repeat([0, 1], [60, 60]),
        recordings=("one", "two"),
        time=time,
        snr=np.linspace(5, 50, len(time)),
        guess={"gaze_x": 0.01, "gaze_y": -0.02},
        simulated=True,
    )


@pytest.fixture(scope="session")
def told() -> Callable[..., Outcome]:
    return outcome_of


@pytest.fixture(scope="session")
def content(gaze: tuple[np.ndarray, np.ndarray]) -> DemoReport:
    rng = np.random.default_rng(5)
    time, truth = gaze
    good = truth + 0.02 * rng.normal(size=truth.shape)
    poor = truth + 0.1 * rng.normal(size=truth.shape)
    spots = rng.uniform(20, 80, (40, 2))
    found = spots + np.array([0.3, 0.4])
    found[7] = np.nan
    axis = np.linspace(-0.5, 0.5, 5)
    return DemoReport(
        made="at noon",
        recording=[("scene", "thin-lens"), ("<script>alert(1)</script>", 'a "quoted" & odd name')],
        picture=rng.integers(0, 255, (48, 64)).astype(np.uint8),
        models=[
            ModelResult("ResNet-18", outcome_of(time, truth, good, 0.05), "bundled."),
            ModelResult("Zernike + ridge", outcome_of(time, truth, poor), "trained here."),
        ],
        samples=rng.integers(0, 255, (4, 12, 12)).astype(np.uint8),
        sample_gaze=truth[:4],
        spots_found=found,
        spots_true=spots,
        path_rrs=[rng.integers(0, 255, (10, 10)), rng.integers(0, 255, (10, 10))],
        path_rrs_at=[5, 30],
        sign=SignEvidence(
            axis,
            axis,
            np.full((5, 5), 4.0),
            np.full((5, 5), 0.1),
            [
                SignRate("ResNet-18", True, (90, 80), (100, 100)),
                SignRate("ResNet-18", False, (51, 0), (100, 0)),
            ],
            "10 % of the first",
        ),
        tracking=Tracking(
            frame=rng.poisson(5, (30, 40)),
            track=np.repeat([1, 2], [25, 5]),
            x=np.linspace(5, 30, 30),
            y=np.linspace(5, 20, 30),
            time=np.arange(30) / 15,
            snr=np.where(np.arange(30) == 11, np.nan, 20.0),
            frames=32,
            truth=truth[:20],
            predicted=good[:20],
        ),
        timings=[("filming", 30.0), ("training", 12.5)],
        seeds=[("filming", 3)],
        sizes=[("frames", "120")],
        versions=[("torch", "2")],
        limits=["One more limit."],
        files=[("tracks.parquet", "a row a frame and track")],
        next_steps=[("tapetum demo --train", "trains before your eyes")],
    )
