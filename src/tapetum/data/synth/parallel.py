"""Parts of a set made by several processes of this machine."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Iterator, Sequence
from itertools import groupby
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from tapetum.data.synth.plan import Part, Plan
from tapetum.data.synth.store import Staging
from tapetum.data.synth.work import keep_part
from tapetum.errors import InputError, TapetumError
from tapetum.processes import begin_beside, context_of

__all__ = ["parts_by_processes"]


def parts_by_processes(plan: Plan, staging: Staging, parts: Sequence[Part], count: int) -> Iterator[Part]:
    """Make parts in `count` processes; yield each part when it is done.

    A process takes whole videos, which it prepares once, or runs of their parts where processes outnumber videos. The
    others take over what a dead process had not done. Raises a TapetumError when a process fails, or all have
    died, and the InputError that a process has raised.
    """
    waiting = deque(_runs(parts, count))
    with _started(min(count, len(waiting)), staging.path, plan) as connections:
        doing: dict[Connection, list[Part]] = {connection: [] for connection in connections}
        while waiting or any(doing.values()):
            for connection, own in doing.items():
                if not own and waiting:
                    own += waiting.popleft()
                    # If the process has died, `wait` reports it.
                    with contextlib.suppress(OSError):
                        connection.send(own)
            for connection in wait(list(doing)):
                assert isinstance(connection, Connection)
                try:
                    failure = connection.recv()
                except (EOFError, ConnectionResetError):
                    lost = doing.pop(connection)
                    # It may have died between keeping a part and reporting it.
                    kept = [part for part in lost if staging.has(part)]
                    yield from kept
                    if rest := [part for part in lost if part not in kept]:
                        waiting.appendleft(rest)
                    if waiting and not doing:
                        what = f"all of the {len(connections)} processes that film ended before their time"
                        remedy = "they may lack memory: use fewer; what is done is kept, and the same call carries on"
                        raise TapetumError(f"{what}; {remedy}") from None
                    continue
                if isinstance(failure, tuple):
                    what, where, remedy = failure
                    raise InputError(what, where=where, remedy=remedy)
                if failure is not None:
                    raise TapetumError(f"a process that films failed: {failure}")
                # Each process makes its parts in order.
                yield doing[connection].pop(0)


def _runs(parts: Sequence[Part], count: int) -> list[list[Part]]:
    """Divide parts by video, and every video into enough runs to occupy `count` processes."""
    videos = [list(own) for _, own in groupby(parts, key=lambda part: part.video)]
    pieces = -(-count // max(1, len(videos)))
    return [run for video in videos for k in range(pieces) if (run := video[k::pieces])]


@contextlib.contextmanager
def _started(count: int, path: Path, plan: Plan) -> Iterator[list[Connection]]:
    """Start processes; end them on leaving."""
    context = context_of("tapetum.data.synth.work")
    connections: list[Connection] = []
    processes: list[BaseProcess] = []
    for _ in range(count):
        here, there = context.Pipe()
        process = context.Process(target=_film, args=(there, path, plan), daemon=True)
        process.start()
        # An open copy of the other end would hide that the process has ended.
        there.close()
        connections.append(here)
        processes.append(process)
    try:
        yield connections
    finally:
        # Safe at any time, because a part is written completely or not at all.
        for process in processes:
            process.terminate()
        for process in processes:
            process.join()


def _film(connection: Connection, path: Path, plan: Plan) -> None:
    """Make parts as requested until the other end closes."""
    begin_beside()
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            for part in connection.recv():
                try:
                    keep_part(path, plan.videos[part.video], part, plan.rules, plan.classes)
                except InputError as error:  # raised in the process that waits for it
                    where = None if error.where is None else str(error.where)
                    connection.send((error.what, where, error.remedy))
                    return
                except Exception as error:
                    connection.send(str(error) if isinstance(error, TapetumError) else repr(error))
                    return
                connection.send(None)
