"""Several probes whose signal and illumination stay even over a volume (paper, end of section 3).

A camera near the probes is lit by few cones and returns much light to each; a distant one is lit by many and returns
little to each. This package computes the signals of a set of probes at given points, and designs such a set.

Axes of a room: x across, y up, z away from the probes' wall, in metres. Arrays over N points and P probes are [N, P].
The lasers are mutually incoherent, so irradiances add. People in the way are not modelled.
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
