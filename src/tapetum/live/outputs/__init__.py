"""Receivers of a watch's events and states, one file a kind, opened by `open_output`."""

from tapetum.live.outputs.base import Counts, Output, Queued
from tapetum.live.outputs.registry import OUTPUTS, open_output

__all__ = ["OUTPUTS", "Counts", "Output", "Queued", "open_output"]
