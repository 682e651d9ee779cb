"""Kinds of outputs by the beginning of their text, or by the suffix of a file. A new kind is a line here."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from tapetum.errors import InputError
from tapetum.live.outputs.base import Queued
from tapetum.live.outputs.lsl import Lsl
from tapetum.live.outputs.mqtt import Mqtt
from tapetum.live.outputs.osc import Osc
from tapetum.live.outputs.tracks import Tracks
from tapetum.live.outputs.webhook import Webhook

__all__ = ["OUTPUTS", "open_output"]

OUTPUTS: dict[str, Callable[[str], Queued]] = {
    "osc": Osc,
    "lsl": Lsl,
    "mqtt": Mqtt,
    "mqtts": Mqtt,
    "http": Webhook,
    "https": Webhook,
    ".parquet": Tracks,
    ".csv": Tracks,
    ".jsonl": Tracks,
}
"""By scheme or suffix."""

# One letter before the colon is a drive of Windows.
_SCHEME = re.compile(r"([a-z][a-z0-9+.-]+):", re.IGNORECASE)


def open_output(text: str) -> Queued:
    """Open the receiver that a text names, as osc://127.0.0.1:9000; it runs until its `close`.

    Nothing is asked of the receiver yet: one that is not there now may come later.

    Raises
    ------
    InputError
        When the text names no known kind, or is incomplete; when the packages of an extra are missing.
    """
    found = _SCHEME.match(text)
    kind = found[1].lower() if found else Path(text).suffix.lower()
    if kind not in OUTPUTS:
        known = ", ".join(f"FILE{one}" if one.startswith(".") else f"{one}:…" for one in OUTPUTS)
        raise InputError(f"unknown kind of output {text!r}", where="output", remedy=f"use one of {known}")
    output = OUTPUTS[kind](text)
    output.start()
    return output
