"""Deprecated alias of `tapetum.simulate.bounds`, kept for one release."""

from tapetum.simulate.bounds import (
    ALL_UNKNOWN,
    FRAME,
    FocusBounds,
    GazeBound,
    GazeInformation,
    focus_bounds,
    gaze_bounds,
    gaze_information,
    gaze_prior,
    rings_of_gazes,
)

__all__ = ["ALL_UNKNOWN", "FRAME", "FocusBounds", "GazeBound", "GazeInformation", "focus_bounds", "gaze_bounds"]
__all__ += ["gaze_information", "gaze_prior", "rings_of_gazes"]
