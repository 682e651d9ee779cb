"""Fit by simulation: the parameters of a known scene by which the simulator explains an image best."""

from tapetum.models.simulation.fit import SimulationFit
from tapetum.models.simulation.result import Mode, SimulationFitResult

__all__ = ["Mode", "SimulationFit", "SimulationFitResult"]
