"""Tasks that run at the same time, each in a process of its own."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool

from tapetum.data.synth.work import one_thread
from tapetum.errors import InputError
from tapetum.processes import begin_beside, context_of

__all__ = ["side_by_side"]


def side_by_side(tasks: Sequence[Callable[[], object]], processes: int) -> Iterator[int]:
    """Run tasks in this process or, where there are several, in new ones; yield each task's number when it is done.

    Tasks must be picklable then, and keep what they make in files that are whole or absent: an error or an interruption
    ends all others at once.

    Raises
    ------
    InputError
        When a process ends before its time, and whatever a task raises.
    """
    if processes <= 1:
        for number, task in enumerate(tasks):
            task()
            yield number
        return
    before = set(multiprocessing.active_children())
    context = context_of("tapetum.data.synth.work", __name__)
    with ProcessPoolExecutor(processes, context, initializer=begin_beside) as pool:
        # Processes start when the first tasks are submitted.
        waiting = {pool.submit(_run, task): number for number, task in enumerate(tasks)}
        started = set(multiprocessing.active_children()) - before
        try:
            for done in as_completed(waiting):
                done.result()
                yield waiting[done]
        except BrokenProcessPool as error:
            what = "a process ended before its time"
            raise InputError(what, where="processes", remedy="use fewer: it may have lacked memory") from error
        finally:
            # Where all is done they are idle; otherwise a film would go on for minutes.
            for process in started:
                process.terminate()


def _run(task: Callable[[], object]) -> None:
    """Run a task; what it returns stays where it ran."""
    with one_thread():
        task()
