"""Images that carry their label: a spot whose faint companion moves with the gaze."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
import xarray as xr

from tapetum.data import dataset_from_arrays


def pictures(count: int, *, side: int = 40, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return images [N, side, side] uint8 and gaze [N, 2]."""
    rng = np.random.default_rng(seed)
    gaze = rng.uniform(-0.5, 0.5, (count, 2))
    at = np.arange(side) - (side - 1) / 2
    images = np.empty((count, side, side))
    for n, (x, y) in enumerate(gaze):
        core = 150 * np.exp(-(at[:, None] ** 2 + at**2) / (2 * 3.0**2))
        companion = 60 * np.exp(-((at[:, None] - 16 * y) ** 2 + (at - 16 * x) ** 2) / (2 * 2.5**2))
        images[n] = 10 + core + companion
    images += rng.normal(0, 2, images.shape)
    return np.clip(np.rint(images), 0, 255).astype(np.uint8), gaze


@pytest.fixture(autouse=True, scope="package")
def one_thread() -> Iterator[None]:
    """Small tensors gain nothing by threads, which on a busy machine lose minutes waiting for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def small() -> xr.Dataset:
    """260 images in two recordings; the last 60 test."""
    images, gaze = pictures(260)
    split = (np.arange(260) >= 200).astype(int)
    recording = (np.arange(260) % 200 >= 100).astype(int)
    columns = {"gaze_x": gaze[:, 0], "gaze_y": gaze[:, 1]}
    return dataset_from_arrays(images, columns, split=split, recording=recording)
