"""Estimators: images of retro-reflections in, gaze or focus with intervals out."""

from tapetum.models.base import COVERAGE, Data, Estimator, Prediction
from tapetum.models.features import feature_names, zernike_features
from tapetum.models.network import ResNet18Network
from tapetum.models.resnet import ResNet18
from tapetum.models.store import load_model, model_card, pretrained, save_model
from tapetum.models.training import EpochReport
from tapetum.models.zernike_ridge import ZernikeRidge

__all__ = [
    "COVERAGE",
    "Data",
    "EpochReport",
    "Estimator",
    "Prediction",
    "ResNet18",
    "ResNet18Network",
    "ZernikeRidge",
    "feature_names",
    "load_model",
    "model_card",
    "pretrained",
    "save_model",
    "zernike_features",
]
