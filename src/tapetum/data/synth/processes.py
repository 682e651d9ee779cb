"""Parts made by several processes of this machine, without a cluster."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Iterator, Sequence
from itertools import groupby
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from tapetum.data.synth.plan import Part, Plan
from tapetum.data.synth.store import Staging
from tapetum.data.synth.work import MALLOC, make_part
from tapetum.errors import TapetumError

__all__ = ["parts_by_processes"]


def parts_by_processes(plan: Plan, staging: Staging, parts: Sequence[Part], count: int) -> Iterator[Part]:
    """Have parts made by `count` processes, and yield each when it is done.

    A process takes whole videos, each of which it prepares once, or runs of their parts where there are more processes
    than videos. What one that dies had not done goes to the others.

    Raises
    ------
    TapetumError
        When a process fails, or all of them have died.
    """
    waiting, left = deque(_runs(parts, count)), len(parts)
    with _started(min(count, len(waiting)), staging.path, plan) as processes:
        doing: dict[Connection, list[Part]] = {}
        while left:
            for connection in processes:
                if not doing.get(connection) and waiting:
                    doing[connection] = waiting.popleft()
                    # Where the process has died meanwhile, the next look at it says so.
                    with contextlib.suppress(OSError):
                        connection.send(doing[connection])
            for connection in wait(list(processes)):
                assert isinstance(connection, Connection)
                try:
                    told = connection.recv()
                except (EOFError, ConnectionResetError):
                    processes.pop(connection).join()
                    # It may have died after it had kept a part and before it could say so.
                    lost = doing.pop(connection, [])
                    kept = [part for part in lost if staging.has(part)]
                    yield from kept
                    left -= len(kept)
                    if rest := [part for part in lost if part not in kept]:
                        waiting.appendleft(rest)
                    if not processes:
                        what = f"all of the {min(count, len(parts))} processes that film ended before their time"
                        remedy = "they may lack memory: use fewer; what is done is kept, and the same call carries on"
                        raise TapetumError(f"{what}; {remedy}") from None
                    continue
                if isinstance(told, str):
                    raise TapetumError(f"a process that films failed: {told}")
                if isinstance(told, int):
                    part = next(one for one in doing[connection] if one.number == told)
                    doing[connection].remove(part)
                    left -= 1
                    yield part


def _runs(parts: Sequence[Part], count: int) -> list[list[Part]]:
    """Divide parts by video, and every video into as many runs as keep so many processes at work."""
    videos = [list(own) for _, own in groupby(parts, key=lambda part: part.video)]
    pieces = -(-count // max(1, len(videos)))
    return [run for video in videos for k in range(pieces) if (run := video[k::pieces])]


@contextlib.contextmanager
def _started(count: int, path: Path, plan: Plan) -> Iterator[dict[Connection, BaseProcess]]:
    """Start processes, and end them when they are no longer needed."""
    context = multiprocessing.get_context("spawn")
    found: dict[Connection, BaseProcess] = {}
    before = {name: os.environ.get(name) for name in MALLOC}
    os.environ.update(MALLOC)
    try:
        for _ in range(count):
            here, there = context.Pipe()
            process = context.Process(target=_film, args=(there, path, plan), daemon=True)
            process.start()
            # Left open here, it would hide the end of the process.
            there.close()
            found[here] = process
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
    started = list(found.values())
    try:
        yield found
    finally:
        # A part is kept whole or not at all.
        for process in started:
            process.terminate()
        for process in started:
            process.join()


def _film(connection: Connection, path: Path, plan: Plan) -> None:
    """Make parts as they are asked for, until nobody asks any more."""
    # Ctrl-C reaches all processes of a terminal; the one that asks ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    staging = Staging(path)
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            for part in connection.recv():
                try:
                    if not staging.has(part):
                        staging.keep(part, make_part(plan.videos[part.video], part, plan.rules, plan.classes))
                except Exception as error:  # It is reported where it is waited for.
                    connection.send(str(error) if isinstance(error, TapetumError) else repr(error))
                    return
                connection.send(part.number)
