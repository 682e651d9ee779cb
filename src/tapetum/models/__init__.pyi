from .adaptation import adapt
from .architectures import ResNet18Network
from .base import Data, Estimator, Predictor
from .fast import load_predictor
from .features import feature_names, zernike_features
from .network import NetworkEstimator, ResNet18
from .other_units import calibrate_units
from .prediction import COVERAGE, NONE_OF_THESE, Prediction
from .simulation import SimulationFit, SimulationFitResult
from .snr import crop_snr
from .store import load_model, model_card, pretrained, save_model
from .training import EpochReport
from .zernike_ridge import ZernikeRidge

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
