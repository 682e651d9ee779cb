from .ghost import GhostCalibration, calibrate_second_beam
from .photon_transfer import PhotonTransfer, photon_transfer
from .sensor import SensorCalibration, calibrate_sensor
from .sync import SyncCalibration, calibrate_sync
from .uncertainty import Measured
from .verdict import Check

__all__ = [
    "Check",
    "GhostCalibration",
    "Measured",
    "PhotonTransfer",
    "SensorCalibration",
    "SyncCalibration",
    "calibrate_second_beam",
    "calibrate_sensor",
    "calibrate_sync",
    "photon_transfer",
]
