"""Synthesis of a set: missing parts are made, here or on many machines, and joined."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from tapetum.data.dataset import FORMAT
from tapetum.data.synth.parallel import parts_by_processes
from tapetum.data.synth.plan import Part, Plan
from tapetum.data.synth.store import Staging
from tapetum.data.synth.work import keep_part
from tapetum.errors import InputError, noted
from tapetum.files import check_replaceable, reserved
from tapetum.progress import Progress, quiet

__all__ = ["synthesise"]


def synthesise(
    plan: Plan,
    out: str | Path,
    *,
    processes: int | None = None,
    cluster: str | None = None,
    progress: Progress = quiet,
    overwrite: bool = False,
    workers: int | None = None,
) -> Path:
    """Make a set, or continue where the same call was interrupted.

    Finished parts are kept in the folder `OUT.part` until the set is complete. The set is the same to the last bit on
    processors of one kind, however many workers made it and however often it was interrupted.

    Parameters
    ----------
    plan
        What to film: see `make_plan`.
    out
        The store to write, by convention NAME.zarr.
    processes
        Processes to start on this machine; 1 or None for this one alone.
    cluster
        Address of a Dask scheduler whose workers see the same folder as this machine.
    progress
        Shown over the parts.
    overwrite
        Replace an existing dataset once the new one is complete.
    workers
        Older name of `processes`.

    Returns
    -------
    Path
        The store.

    Raises
    ------
    InputError
        When `out` exists, another command is making it or another set was begun there, the cluster is unusable, the
        disk is full, or no frame could be kept.
    """
    out = Path(out)
    ways = {"workers": workers, "processes": processes, "cluster": cluster}
    asked = {name: value for name, value in ways.items() if value is not None}
    if len(asked) > 1:
        raise InputError("are two ways to say who works", where=", ".join(asked), remedy="give one of them")
    for name, count in asked.items():
        if isinstance(count, int) and count < 1:
            raise InputError(f"must be positive, is {count}", where=name, remedy="give a number of processes")
    check_replaceable(out, FORMAT, overwrite=overwrite)
    with reserved(out):
        staging = Staging.begin(out, plan)

        def kept() -> str:
            # The folder may have been removed meanwhile.
            where = f"what is done is kept in {staging.path}, and the same command carries on"
            return where if staging.stands else ""

        done = staging.done()
        missing = [part for part in plan.parts if part.number not in done]
        if missing:
            what = f"filming {plan.kind}" + (f", {len(done)} of {len(plan.parts)} done" if done else "")
            making = _making(plan, staging, missing, processes or workers or 1, cluster)
            with noted(kept, KeyboardInterrupt, InputError):
                for _ in progress(making, what, total=len(missing)):
                    pass
        with noted(kept, KeyboardInterrupt):
            staging.put_together(plan, out, progress=progress, overwrite=overwrite)
        staging.remove()
    return out


def _making(plan: Plan, staging: Staging, parts: Sequence[Part], processes: int, cluster: str | None) -> Iterator[Part]:
    """Make parts on the cluster, in processes or here; yield each when it is done."""
    if cluster is not None:
        from tapetum.data.synth.cluster import parts_by_cluster

        yield from parts_by_cluster(plan, staging, parts, cluster)
    elif processes > 1:
        yield from parts_by_processes(plan, staging, parts, processes)
    else:
        for part in parts:
            keep_part(staging.path, plan.videos[part.video], part, plan.rules, plan.classes)
            yield part
