"""Predictions, intervals and which frames a model may learn from."""

from __future__ import annotations

import numpy as np
import pytest

from tapetum.data import dataset_from_arrays
from tapetum.errors import InputError
from tapetum.models import Estimator, Prediction, ResNet18, ZernikeRidge
from tapetum.models.base import target_names, training_part

pytestmark = pytest.mark.usefixtures("narrow")


def test_columns_of_a_table_of_tracks():
    value = np.array([[0.1, 0.2], [0.3, 0.4]])
    prediction = Prediction(("gaze_x", "gaze_y"), value, value - 1, value + 2)
    assert list(prediction.columns()) == [
        *("gaze_x", "gaze_x_low", "gaze_x_high"),
        *("gaze_y", "gaze_y_low", "gaze_y_high"),
        *("applies", "reason"),
    ]
    np.testing.assert_array_equal(prediction["gaze_y"], [0.2, 0.4])
    np.testing.assert_array_equal(prediction.columns()["gaze_x_high"], [2.1, 2.3])
    assert len(prediction) == 2
    with pytest.raises(InputError, match="there are: gaze_x, gaze_y"):
        _ = prediction["focus"]


def test_a_prediction_is_never_nan():
    bad = np.array([[np.nan]])
    with pytest.raises(InputError, match="not finite"):
        Prediction(("z",), bad, bad, bad)
    with pytest.raises(InputError, match="must all be"):
        Prediction(("z",), np.zeros((2, 1)), np.zeros((1, 1)), np.zeros((2, 1)))


def test_the_last_tenth_of_every_recording_calibrates(small):
    part = training_part(small, ("gaze_x",), 0.1)
    assert part.calibrate.tolist() == [*range(90, 100), *range(190, 200)]
    assert part.fit.tolist() == [*range(90), *range(100, 190)]
    assert part.data_hash == small.tp.train.tp.hash
    np.testing.assert_array_equal(part.targets[:, 0], small["gaze_x"].values[:200].astype(float))


def test_test_frames_never_train(small):
    whole, train = training_part(small, ("gaze_x",), 0.1), training_part(small.tp.train, ("gaze_x",), 0.1)
    np.testing.assert_array_equal(whole.targets, train.targets)
    with pytest.raises(InputError, match="too few"):
        training_part(small.tp.test, ("gaze_x",), 0.1)


def test_targets_have_names():
    assert target_names("gaze") == ("gaze_x", "gaze_y")
    assert target_names("focus") == ("object_distance", "focal_length")
    assert target_names("focal_length") == ("focal_length",)
    with pytest.raises(InputError, match="target"):
        target_names(())


def test_both_models_are_estimators():
    for model in (ZernikeRidge(alpha="cv"), ResNet18("focus", seed=3)):
        assert isinstance(model, Estimator)
        assert type(model)(**model.parameters()).parameters() == model.parameters()


@pytest.mark.parametrize("kind", [ZernikeRidge, ResNet18])
def test_a_missing_label_is_told(kind):
    dataset = dataset_from_arrays(np.zeros((4, 8, 8), np.uint8), {"gaze_x": np.arange(4)})
    with pytest.raises(InputError, match="no label 'gaze_y'"):
        kind().fit(dataset)


@pytest.mark.parametrize("model", [ZernikeRidge(), ResNet18()])
def test_an_unfitted_model_says_so(model):
    with pytest.raises(InputError, match="not fitted"):
        model.predict(np.zeros((1, 400, 400), np.uint8))
    with pytest.raises(InputError, match="not fitted"):
        model.state()


def test_labels_that_teach_nothing_are_told(small):
    lame = small.copy()
    values = lame["gaze_x"].values.copy()
    values[[3, 7]] = np.nan
    lame["gaze_x"] = lame["gaze_x"].copy(data=values)
    with pytest.raises(InputError, match="label gaze_x is not a number in 2 training frames, the first is number 3"):
        training_part(lame, ("gaze_x", "gaze_y"), 0.1)
    still = dataset_from_arrays(np.zeros((30, 8, 8), np.uint8), {"focal_length": np.full(30, 0.05)})
    with pytest.raises(InputError, match="focal_length never changes in the one recording"):
        training_part(still, ("focal_length",), 0.1)


def test_many_short_recordings_set_their_share_aside(small):
    """Four frames each: a tenth of one is none, of fifty together it is twenty."""
    short = small.assign(recording=("frame", np.arange(260) // 4))
    part = training_part(short, ("gaze_x",), 0.1)
    assert len(part.calibrate) == 20
    # Always the last ones of a recording.
    numbers = np.asarray(part.dataset["recording"].values)
    assert all(numbers[k] != numbers[k + 1] for k in part.calibrate if k + 1 < len(numbers))


def test_frames_that_choose_do_not_calibrate(small):
    part = training_part(small, ("gaze_x",), 0.1, select=True)
    assert part.choose.tolist() == [*range(90, 95), *range(190, 195)]
    assert part.calibrate.tolist() == [*range(95, 100), *range(195, 200)]
    assert part.fit.tolist() == [*range(90), *range(100, 190)]
    network = ResNet18(crop=36, size=24, epochs=2, batch=20, patience=1, device="cpu").fit(small)
    assert network.training_["calibrated_on"] == 10
    assert "10 training frames that neither fit nor calibrate" in network.training_["chosen"]["epochs"]
    # The intervals are those of the ten frames that chose nothing: too few but for the largest error.
    found = network.predict(small.tp.train.isel(frame=part.calibrate), anyway=True)
    truth = small.tp.train.isel(frame=part.calibrate).tp.values(("gaze_x", "gaze_y"))
    np.testing.assert_allclose(network.intervals_.half_width[0], np.abs(found.value - truth).max(axis=0), rtol=1e-5)


def test_what_the_data_chose_stands_on_the_card(small):
    ridge = ZernikeRidge("gaze", scales=(20,), order=2, alpha="cv", standardise=True).fit(small)
    assert "contiguous fifths of the fitted frames" in ridge.training_["chosen"]["alpha"]
    assert ZernikeRidge("gaze", scales=(20,), order=2).fit(small).training_["chosen"] == {}
