"""Processes of this machine that compute beside this one: how they start, and what each of them sets."""

from __future__ import annotations

import multiprocessing
import signal
import sys
from multiprocessing.context import ForkServerContext, SpawnContext

from tapetum.memory import keep_big_blocks

__all__ = ["begin_beside", "context_of"]


def context_of(*modules: str) -> ForkServerContext | SpawnContext:
    """Return how new processes start that first need the modules of these names.

    On Linux they fork from one process that has imported them once, which costs each a few milliseconds in place of
    seconds. That process starts with the first of them and keeps its environment. Elsewhere each imports for itself.
    """
    if not sys.platform.startswith("linux"):
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    # What has started already stays as it is: modules that it lacks are imported where they are used.
    context.set_forkserver_preload(list(modules))
    return context


def begin_beside() -> None:
    """To be called first in such a process: it keeps memory between arrays and leaves Ctrl-C to the one that waits.

    Ctrl-C reaches all processes of a terminal; the one that waits ends the others.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    keep_big_blocks(one_arena=True)
