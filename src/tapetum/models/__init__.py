"""Estimators: images of retro-reflections in; gaze, focus and device out, with intervals and probabilities."""

from tapetum.models.adaptation import adapt
from tapetum.models.architectures import ResNet18Network
from tapetum.models.base import Data, Estimator, Predictor
from tapetum.models.fast import load_predictor
from tapetum.models.features import feature_names, zernike_features
from tapetum.models.network import NetworkEstimator, ResNet18
from tapetum.models.other_units import calibrate_units
from tapetum.models.prediction import COVERAGE, NONE_OF_THESE, Prediction
from tapetum.models.simulation import SimulationFit, SimulationFitResult
from tapetum.models.snr import crop_snr
from tapetum.models.store import load_model, model_card, pretrained, save_model
from tapetum.models.training import EpochReport
from tapetum.models.zernike_ridge import ZernikeRidge

__all__ = [
    "COVERAGE",
    "NONE_OF_THESE",
    "Data",
    "EpochReport",
    "Estimator",
    "NetworkEstimator",
    "Prediction",
    "Predictor",
    "ResNet18",
    "ResNet18Network",
    "SimulationFit",
    "SimulationFitResult",
    "ZernikeRidge",
    "adapt",
    "calibrate_units",
    "crop_snr",
    "feature_names",
    "load_model",
    "load_predictor",
    "model_card",
    "pretrained",
    "save_model",
    "zernike_features",
]
