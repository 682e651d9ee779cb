"""What `inspect_dataset` counts, each planted in a small set."""

from __future__ import annotations

import numpy as np
import pytest

from tapetum.data import dataset_from_arrays
from tapetum.data.doubles import NEAR_BITS, near_pairs
from tapetum.data.quality import DatasetQuality, inspect_dataset
from tapetum.errors import InputError
from tapetum.progress import quiet

SIDE, COUNT = 40, 30
ROWS, COLUMNS = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2


def pictures(seed: int = 0) -> np.ndarray:
    """RRs of one scene, each exposed separately: alike, but no copies."""
    light = 15 + 150 * np.exp(-(ROWS**2 + COLUMNS**2) / 20)
    return np.clip(light + np.random.default_rng(seed).normal(0, 2, (COUNT, SIDE, SIDE)), 0, 254).astype(np.uint8)


def looked_at(images: np.ndarray, **more) -> DatasetQuality:
    split = (np.arange(len(images)) >= 20).astype(int)
    dataset = dataset_from_arrays(images, {"gaze_x": np.linspace(-0.3, 0.3, len(images))}, split=split)
    return inspect_dataset(dataset.assign({name: ("frame", values) for name, values in more.items()}))


def test_a_clean_set():
    told = looked_at(pictures())
    assert (told.frames, told.train, told.test, told.per_recording) == (30, 20, 10, ((20, 10),))
    assert told.exact.frames == told.near.frames == told.saturated == told.empty == told.badly_centred == 0
    assert told.labels["gaze_x"].spread.least == pytest.approx(-0.3)
    assert sum(told.labels["gaze_x"].spread.counts) == 30
    assert told.labels["gaze_x"].out_of_range == 0 and told.quality is None


def test_copies_are_told_from_new_exposures():
    images = pictures()
    images[7] = images[3]
    images[25] = images[3]
    # Brighter by a fifth, and some counts of dark: the same exposure still.
    images[12] = np.clip(images[5] * 1.2 + 3, 0, 254).astype(np.uint8)
    told = looked_at(images)
    assert told.exact.pairs == ((3, 7), (3, 25)) and told.exact.across_split == 1
    assert told.near.pairs == ((5, 12),) and told.near.across_split == 0


@pytest.mark.parametrize("flipped", [0.5, 0.1, 0.02], ids=["noise", "alike", "nearly the same"])
def test_near_copies_are_those_that_comparing_all_pairs_finds(flipped):
    rng = np.random.default_rng(4)
    prints = rng.integers(0, 2, 256).astype(bool) ^ (rng.random((300, 256)) < flipped)
    for earlier, later, bits in ((3, 250, 16), (40, 41, 17), (7, 200, 1), (8, 200, 1)):
        prints[later] = prints[earlier]
        prints[later, rng.choice(256, bits, replace=False)] ^= True
    wanted = np.arange(300) % 10 != 9
    apart = (prints[:, None] != prints[None]).sum(2)
    want = []
    for n in np.flatnonzero(wanted):
        others = [(apart[m, n], m) for m in np.flatnonzero(wanted[:n])]
        if others and min(others)[0] <= NEAR_BITS:
            want.append((min(others)[1], n))
    assert list(near_pairs(prints, wanted, quiet)) == want and want


def test_saturated_empty_and_off_centre_frames():
    images = pictures()
    images[2, 18:22, 18:22] = 255
    images[4] = np.random.default_rng(1).normal(15, 2, (SIDE, SIDE))
    images[6] = 40
    images[9] = np.roll(images[9], 8, axis=1)
    told = looked_at(images)
    assert told.saturated == 1 and told.saturated_share.most == pytest.approx(16 / SIDE**2)
    assert told.empty == 2
    assert told.badly_centred >= 1 and told.off_centre.most > 4


def test_impossible_labels_and_interleaved_frames():
    gaze, time = np.linspace(-0.3, 0.3, COUNT), np.arange(COUNT, dtype=float)
    gaze[3], gaze[4] = np.nan, 0.7
    time[29] = 3.5
    told = looked_at(pictures(), gaze_x=gaze, time=time, quality=np.linspace(0.5, 1, COUNT))
    assert (told.labels["gaze_x"].not_finite, told.labels["gaze_x"].out_of_range) == (1, 1)
    assert told.interleaved == 1
    assert told.quality is not None and told.quality.median == pytest.approx(0.75)


def test_classes_are_counted_by_name():
    names = np.array(["phone-01", "phone-02", "phone-02"])[np.arange(COUNT) % 3]
    told = inspect_dataset(dataset_from_arrays(pictures(), {"device": names}))
    assert told.classes == {"phone-01": 10, "phone-02": 20}


def test_other_measures_see_every_image_once():
    images, seen = pictures(), []
    dataset = dataset_from_arrays(images, {"gaze_x": np.zeros(COUNT)})
    inspect_dataset(dataset, also=[lambda start, batch: seen.append((start, len(batch)))])
    assert seen == [(0, COUNT)]


def test_pixels_that_are_no_numbers():
    images = pictures().astype(np.float32)
    images[5, 2, 2] = np.nan
    dataset = dataset_from_arrays(images, {"gaze_x": np.zeros(COUNT)}, full_scale=255)
    assert inspect_dataset(dataset).not_finite == 1


def test_no_frame_at_all():
    dataset = dataset_from_arrays(pictures(), {"gaze_x": np.zeros(COUNT)}).isel(frame=slice(0, 0))
    with pytest.raises(InputError, match="no frame"):
        inspect_dataset(dataset)
