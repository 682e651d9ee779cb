"""Defaults that all commands share."""

from __future__ import annotations

__all__ = ["SEED"]

SEED = 1
"""Of everything random in a command's output. The published sets were filmed with it."""
