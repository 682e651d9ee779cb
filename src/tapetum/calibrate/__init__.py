"""What must be known of a real probe: its sensor, the ghost of its beam splitter, the clocks of its cameras."""

from tapetum.calibrate.ghost import GhostCalibration, calibrate_second_beam
from tapetum.calibrate.photon_transfer import PhotonTransfer, photon_transfer
from tapetum.calibrate.sensor import SensorCalibration, calibrate_sensor
from tapetum.calibrate.sync import SyncCalibration, calibrate_sync
from tapetum.calibrate.uncertainty import Measured
from tapetum.calibrate.verdict import Check

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
