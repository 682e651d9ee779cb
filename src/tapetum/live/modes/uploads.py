"""Frames of uploaded pictures and films, which a process with limits decodes (`decode`)."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np

from tapetum.errors import InputError
from tapetum.live.modes import decode
from tapetum.record.source import Frame

__all__ = ["KINDS", "decoded"]

KINDS = ("single", "pair", "film")
_SECONDS = 60.0  # for a whole upload
_LINE = 200
_REMEDY = "save it as a JPEG, or a film as MP4, and send it again"


def decoded(content: bytes, kind: str, first: int = 0) -> Iterator[Frame]:
    """Yield the grey frames of an upload: one of a "single", the lit and the dark one of a "pair", all of a "film".

    Parameters
    ----------
    content
        The files' bytes, one after the other.
    kind, first
        One of `KINDS`; of a pair the length of the lit picture in bytes.

    Raises
    ------
    InputError
        When it is none of the formats, damaged, too large, or takes too much memory or time to decode.
    """
    if not content:
        raise InputError("is empty", where="upload", remedy="choose a file")
    if kind == "pair" and not 0 < first < len(content):
        raise InputError(f"must divide {len(content)} bytes in two, is {first}", where="first")
    first = first if kind == "pair" else len(content)
    what = "film" if kind == "film" else "picture"
    command = [sys.executable, "-I", str(Path(decode.__file__)), what, str(first)]
    # The child gets no descriptor of the server's, no settings of its environment beside what Python needs.
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={"PATH": "/usr/bin:/bin"},
        cwd="/" if sys.platform != "win32" else None,
    )
    clock = threading.Timer(_SECONDS, process.kill)
    clock.start()
    feeder = threading.Thread(target=_feed, args=(process.stdin, content), daemon=True)
    feeder.start()
    try:
        assert process.stdout is not None
        yield from _frames(process.stdout, kind)
    finally:
        clock.cancel()
        process.kill()
        process.wait()
        feeder.join(1)
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()


def _feed(pipe: IO[bytes] | None, content: bytes) -> None:
    assert pipe is not None
    # Where the child has ended, what it said counts.
    with contextlib.suppress(OSError):
        pipe.write(content)
        pipe.close()


def _frames(pipe: IO[bytes], kind: str) -> Iterator[Frame]:
    """Read the child's frames; its answers are checked like any untrusted input, because crafted bytes may have taken
    it over."""
    most = decode.FILM_FRAMES if kind == "film" else 2
    number, before = 0, -1.0
    while True:
        line = pipe.readline(_LINE)
        try:
            head = json.loads(line)
        except ValueError:
            head = {}
        if not isinstance(head, dict) or not head:
            what = "takes too much memory or time to decode, or is damaged"
            raise InputError(what, where="upload", remedy=_REMEDY)
        if head.get("end") is True:
            break
        if "fault" in head:
            raise InputError(str(head["fault"])[:_LINE], where="upload", remedy=_REMEDY)
        width, height, moment = head.get("width"), head.get("height"), head.get("time")
        if (
            not (isinstance(width, int) and isinstance(height, int) and isinstance(moment, int | float))
            or not (32 <= width <= 2**16 and 32 <= height <= 2**16 and width * height <= decode.MOST_PIXELS)
            or not 0 <= moment <= decode.FILM_SECONDS
            or number >= most
        ):
            raise InputError("the decoder's answer makes no sense", where="upload", remedy=_REMEDY)
        pixels = pipe.read(width * height)
        if len(pixels) < width * height:
            raise InputError("takes too much memory or time to decode", where="upload", remedy=_REMEDY)
        # Two frames of one time are one moment apart, as trackers want it.
        before = max(float(moment), before + 1e-3)
        lit = {"pair": number == 0}.get(kind)
        yield Frame(
            number, before, np.frombuffer(pixels, np.uint8).reshape(height, width), f"upload[{number}]", lit=lit
        )
        number += 1
    if number == 0 or (kind == "pair" and number != 2):
        raise InputError("holds no picture", where="upload", remedy=_REMEDY)
