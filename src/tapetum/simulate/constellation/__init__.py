"""Several probes whose signal and illumination stay even over a volume (paper, end of section 3).

A camera near the probes stands in few cones and answers each of them strongly; one far away stands in many and answers
each weakly. Here: what a set of probes does at given points, and the design of such a set.

Axes of a room: x across, y up, z away from the probes' wall, in metres. Arrays over N points and P probes are [N, P].
The lasers are independent of each other, so irradiances add. People in the way are not modelled.
"""

from tapetum.simulate.constellation.choice import Design, design, single_probe
from tapetum.simulate.constellation.light import (
    Evenness,
    OverlapLaw,
    Signals,
    coverage,
    evenness,
    irradiance,
    overlap_law,
    signal,
)
from tapetum.simulate.constellation.room import Constellation, PlacedProbe, ProbeKit, Rail, Volume

__all__ = [
    "Constellation",
    "Design",
    "Evenness",
    "OverlapLaw",
    "PlacedProbe",
    "ProbeKit",
    "Rail",
    "Signals",
    "Volume",
    "coverage",
    "design",
    "evenness",
    "irradiance",
    "overlap_law",
    "signal",
    "single_probe",
]
