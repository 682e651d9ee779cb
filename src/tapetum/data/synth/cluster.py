"""Parts made by the workers of a Dask cluster, started here or joined by its address."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import os
import signal
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tapetum.data.synth.plan import Part, Plan, Video
from tapetum.data.synth.store import Staging
from tapetum.data.synth.work import MALLOC, make_part
from tapetum.data.write import Rules
from tapetum.errors import InputError, TapetumError, need

__all__ = ["joined", "parts_done"]

_EXTRA = "cluster"
_WAIT = 30.0
# Workers come and go where machines are lent: a part is given up only when this many died under it.
_DEATHS = 10


def parts_done(
    plan: Plan, staging: Staging, parts: Sequence[Part], *, workers: int | None, address: str | None
) -> Iterator[Part]:
    """Have parts made, and yield each when it is done.

    A task is a part: it gets the video's description, and writes to the store itself. When a worker dies, Dask gives
    its tasks to others.

    Raises
    ------
    InputError
        When the extra is missing, no scheduler or worker answers, or workers do not see the folder or have another
        version of Tapetum.
    TapetumError
        When a part kills one worker after another.
    """
    distributed = need("distributed", _EXTRA)
    with joined(distributed, workers, address) as client:
        if address is None:
            client.register_plugin(_plugin(distributed))
        _check_workers(client, staging, plan.digest)
        # A video stays with one worker, which prepares it once, as long as no other has run out of work.
        names = sorted(client.nthreads())
        futures = {
            client.submit(
                keep_part,
                str(staging.path),
                plan.videos[part.video],
                part,
                plan.rules,
                plan.classes,
                # Unlike any task of an earlier run: the store says what is done, not the cluster's memory.
                key=f"tapetum-{plan.digest[:12]}-{id(client):x}-{part.number}",
                pure=False,
                workers=[names[part.video % len(names)]],
                allow_other_workers=True,
                priority=-part.number,
            ): part
            for part in parts
        }
        waiting = distributed.as_completed(list(futures), loop=client.loop)
        for future in waiting:
            try:
                future.result()
            except distributed.KilledWorker as error:
                what = f"{_DEATHS} workers died under part {futures[future].number}"
                remedy = "see the workers' logs: they may lack memory"
                raise TapetumError(f"{what}; {remedy}") from error
            yield futures.pop(future)
            # The scheduler forgets it: nothing is made again when the worker that made it dies later.
            future.release()


def keep_part(path: str, video: Video, part: Part, rules: Rules, classes: list[str]) -> int:
    """Make one part and keep it: what a worker does. A part that is done already stays."""
    staging = Staging(Path(path))
    if not staging.has(part):
        staging.keep(part, make_part(video, part, rules, classes))
    return part.number


@contextlib.contextmanager
def joined(distributed: Any, workers: int | None, address: str | None) -> Iterator[Any]:
    """Join a cluster, or start one here and stop it at the end."""
    import dask.config

    if address is not None:
        try:
            client = distributed.Client(address, timeout=_WAIT, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            remedy = "give the address that `dask scheduler` prints, as tcp://HOST:8786"
            raise InputError(f"no Dask scheduler answers ({error})", where=address, remedy=remedy) from error
        with client:
            yield client
        return
    environment = {**dask.config.get("distributed.nanny.pre-spawn-environ", {}), **MALLOC}
    settings = {
        "distributed.scheduler.allowed-failures": _DEATHS,
        "distributed.nanny.pre-spawn-environ": environment,
    }
    with (
        _restored_environment(),
        tempfile.TemporaryDirectory(prefix="tapetum-") as scratch,
        dask.config.set(settings),
        distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            dashboard_address=None,
            # A part needs little memory; a worker that is killed for it by the system is replaced.
            memory_limit=0,
            local_directory=scratch,
            silence_logs="CRITICAL",
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client


@contextlib.contextmanager
def _restored_environment() -> Iterator[None]:
    """Undo what Dask does to this process's own environment when it starts workers."""
    before = dict(os.environ)
    try:
        yield
    finally:
        for name in set(os.environ) - set(before):
            del os.environ[name]
        os.environ.update(before)


def _check_workers(client: Any, staging: Staging, digest: str) -> None:
    """Refuse workers that would make something else, or elsewhere."""
    where = client.scheduler.address
    try:
        client.wait_for_workers(1, timeout=_WAIT)
    except TimeoutError as error:
        remedy = f"start some with `dask worker {where}`"
        raise InputError("the cluster has no workers", where=where, remedy=remedy) from error
    try:
        seen = client.run(_sees, str(staging.path))
    except (ModuleNotFoundError, AttributeError) as error:
        remedy = "install the same Tapetum there"
        raise InputError(f"the workers cannot run this Tapetum ({error})", where=where, remedy=remedy) from error
    mine = importlib.metadata.version("tapetum")
    for worker, (version, found) in seen.items():
        if version != mine:
            what = f"worker {worker} has Tapetum {version}, this is {mine}"
            raise InputError(what, where=where, remedy="install the same version there")
        if found != digest:
            remedy = "write to a folder that all machines share, under the same path"
            raise InputError(f"worker {worker} does not see {staging.path}", where=where, remedy=remedy)


def _sees(path: str) -> tuple[str, str | None]:
    """What a worker is and sees: its Tapetum, and which plan stands in the folder."""
    try:
        digest = json.loads((Path(path) / "plan.json").read_text(encoding="utf-8"))["digest"]
    except (OSError, ValueError, KeyError):
        digest = None
    return importlib.metadata.version("tapetum"), digest


def _plugin(distributed: Any) -> Any:
    class Deaf(distributed.WorkerPlugin):
        """Leaves Ctrl-C to the command that started the workers; a terminal sends it to all of them."""

        name = "tapetum-deaf"

        def setup(self, worker: Any) -> None:
            del worker
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGINT, signal.SIG_IGN)

    return Deaf()
