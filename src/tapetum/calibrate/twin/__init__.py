"""A twin of a real camera: the scene that explains its labelled recording."""

from tapetum.calibrate.twin.fit import fit_twin
from tapetum.calibrate.twin.result import Before, Fitted, Twin

__all__ = ["Before", "Fitted", "Twin", "fit_twin"]
