"""Parts of a set made by the workers of a Dask cluster."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tapetum.data.synth.plan import Part, Plan
from tapetum.data.synth.store import Staging
from tapetum.data.synth.work import keep_part
from tapetum.errors import InputError, TapetumError, need

__all__ = ["parts_by_cluster"]

_WAIT = 30.0  # s


def parts_by_cluster(plan: Plan, staging: Staging, parts: Sequence[Part], address: str) -> Iterator[Part]:
    """Make parts on the cluster at an address, one task each; yield each part when it is done.

    Workers write the parts' files themselves. When a worker dies, Dask gives its tasks to others. Raises an InputError
    when the extra is missing, no scheduler or worker answers, or workers do not see the folder or have another version
    of Tapetum; a TapetumError when a part kills one worker after another.
    """
    distributed = need("distributed", "cluster")
    try:
        client = distributed.Client(address, timeout=_WAIT, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        remedy = "give the address that `dask scheduler` prints, as tcp://HOST:8786"
        raise InputError(f"no Dask scheduler answers ({error})", where=address, remedy=remedy) from error
    with client:
        _check_workers(client, staging, plan.digest)
        # A video stays with one worker, which prepares it once, unless another worker is idle.
        names = sorted(client.nthreads())
        futures = {
            client.submit(
                keep_part,
                str(staging.path),
                plan.videos[part.video],
                part,
                plan.rules,
                plan.classes,
                # A key unlike those of earlier runs: only the folder records what is done.
                key=f"tapetum-{plan.digest[:12]}-{id(client):x}-{part.number}",
                pure=False,
                workers=[names[part.video % len(names)]],
                allow_other_workers=True,
                priority=-part.number,
            ): part
            for part in parts
        }
        for future in distributed.as_completed(list(futures), loop=client.loop):
            try:
                future.result()
            except distributed.KilledWorker as error:
                what = f"one worker after another died under part {futures[future].number}"
                remedy = "see the workers' logs: they may lack memory"
                raise TapetumError(f"{what}; {remedy}") from error
            yield futures.pop(future)
            # Released, so that it is not repeated when its worker dies later.
            future.release()


def _check_workers(client: Any, staging: Staging, digest: str) -> None:
    """Refuse workers with another version of Tapetum or another folder."""
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
    for worker, (version, found) in seen.items():
        if version != (mine := importlib.metadata.version("tapetum")):
            what = f"worker {worker} has Tapetum {version}, this is {mine}"
            raise InputError(what, where=where, remedy="install the same version there")
        if found != digest:
            remedy = "write to a folder that all machines share, under the same path"
            raise InputError(f"worker {worker} does not see {staging.path}", where=where, remedy=remedy)


def _sees(path: str) -> tuple[str, str | None]:
    """Return a worker's version of Tapetum, and the digest of the plan that it sees in the folder."""
    try:
        digest = json.loads((Path(path) / "plan.json").read_text(encoding="utf-8"))["digest"]
    except (OSError, ValueError, KeyError):
        digest = None
    return importlib.metadata.version("tapetum"), digest
