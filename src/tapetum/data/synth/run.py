"""Make a set: the parts that are missing, here or on many machines, and then the whole."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from tapetum.data.synth.plan import Part, Plan
from tapetum.data.synth.processes import parts_by_processes
from tapetum.data.synth.store import Staging
from tapetum.data.synth.work import make_part
from tapetum.durable import sole_writer
from tapetum.errors import InputError
from tapetum.progress import Progress, quiet

__all__ = ["synthesise"]


def synthesise(
    plan: Plan,
    out: str | Path,
    *,
    workers: int | None = None,
    processes: int | None = None,
    cluster: str | None = None,
    progress: Progress = quiet,
    overwrite: bool = False,
) -> Path:
    """Make a set, or carry on where the same call was interrupted.

    What is done stands in the folder `OUT.part` until the set is whole. However it was made (alone, by many,
    interrupted, with workers that died) the set is the same to the last bit, on processors of one kind.

    Parameters
    ----------
    plan
        What to film: see `make_plan`.
    out
        The store to write, by convention NAME.zarr.
    workers
        Processes to start on this machine, by Dask; None for none but this one.
    processes
        Processes to start on this machine, without Dask; 1 or None for none but this one.
    cluster
        Address of a Dask scheduler whose workers see the same folder as this machine.
    progress
        Shown over the parts.
    overwrite
        Replace a store that is there already, once the new one is whole.

    Returns
    -------
    Path
        The store.

    Raises
    ------
    InputError
        When something stands at `out`, another command is making it, another set was begun there, the cluster cannot do
        it, the disk is full, or no frame could be kept.
    """
    out = Path(out)
    ways = {"workers": workers, "processes": processes, "cluster": cluster}
    asked = [name for name, value in ways.items() if value is not None]
    if len(asked) > 1:
        raise InputError("are two ways to say who works", where=", ".join(asked), remedy="give one of them")
    for name, count in (("workers", workers), ("processes", processes)):
        if count is not None and count < 1:
            raise InputError(f"must be positive, is {count}", where=name, remedy="give a number of processes")
    if out.exists() and not overwrite:
        raise InputError("exists already", where=out, remedy="choose another name or remove it first")
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    with sole_writer(out):
        _make(plan, out, workers, processes, cluster, progress, overwrite)
    return out


def _make(
    plan: Plan,
    out: Path,
    workers: int | None,
    processes: int | None,
    cluster: str | None,
    progress: Progress,
    overwrite: bool,
) -> None:
    staging = Staging.begin(out, plan)
    done = staging.done()
    missing = [part for part in plan.parts if part.number not in done]
    if missing:
        if processes is not None and processes > 1:
            results = parts_by_processes(plan, staging, missing, processes)
        elif workers is None and cluster is None:
            results = _alone(plan, staging, missing)
        else:
            from tapetum.data.synth.cluster import parts_done

            results = parts_done(plan, staging, missing, workers=workers, address=cluster)
        what = f"filming {plan.kind}" if not done else f"filming {plan.kind}, {len(done)} of {len(plan.parts)} done"
        for _ in progress(results, what, total=len(missing)):
            pass
    staging.put_together(plan, out, progress=progress, overwrite=overwrite)
    staging.remove()


def _alone(plan: Plan, staging: Staging, parts: Sequence[Part]) -> Iterator[Part]:
    """Make parts in this process, one after the other."""
    for part in parts:
        staging.keep(part, make_part(plan.videos[part.video], part, plan.rules, plan.classes))
        yield part
