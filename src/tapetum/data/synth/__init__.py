"""The three sets of the paper, filmed on the virtual bench: planned, made in parts by one or many, put together."""

from tapetum.data.synth.plan import (
    KINDS,
    SIZES,
    Plan,
    Units,
    Video,
    focusing_plan,
    make_plan,
    phones_plan,
    rotation_plan,
)
from tapetum.data.synth.run import synthesise

__all__ = [
    "KINDS",
    "SIZES",
    "Plan",
    "Units",
    "Video",
    "focusing_plan",
    "make_plan",
    "phones_plan",
    "rotation_plan",
    "synthesise",
]
