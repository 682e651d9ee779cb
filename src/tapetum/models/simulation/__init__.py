"""Fit by simulation: the parameters of a known scene by which the simulator explains an image best."""

from tapetum.models.simulation.fit import SimulationFit
from tapetum.models.simulation.from_file import SCENE_SUFFIXES, read_by_scene
from tapetum.models.simulation.result import Mode, SimulationFitResult

__all__ = ["SCENE_SUFFIXES", "Mode", "SimulationFit", "SimulationFitResult", "read_by_scene"]
