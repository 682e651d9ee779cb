"""What a frame of the synthetic sets costs, part by part on one thread, and two workers beside one."""

from __future__ import annotations

import contextlib
import math
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import dask.config
import distributed

from tapetum.bench import load_scene, scene_names
from tapetum.data.build import add_frames, labels_of
from tapetum.data.synth import Plan, make_plan, rotation_plan, synthesise
from tapetum.data.synth.clip import Clip
from tapetum.data.synth.plan import KINDS, PIECE, Part
from tapetum.data.synth.store import Made, Staging
from tapetum.data.synth.work import make_part, one_thread, shot_of
from tapetum.memory import MALLOC
from tapetum.record import label_recording
from tapetum.record.blobs import find_candidates

from .measure import Effort, Figure, Row

TITLE = "Synthetic sets: a pair of frames, part by part on one thread, and many workers"
PEERS = ("distributed", "zarr")
_TASKS = 500
_CORES = (1, 100, 10_000)


@dataclass(frozen=True)
class Cost:
    """Seconds: of a shot prepared, of a worker's work on a pair where it made the part before and where it did not, of
    a crop put into the set; crops a pair."""

    prepared: float
    pair: float
    alone: float
    together: float
    kept: float


def run(effort: Effort) -> list[Row]:
    """Measure each part of the work for every set whose scene there is, and how two workers share it."""
    plans = {"hand-held": rotation_plan(load_scene("hand-held"), "paper")}
    plans |= {kind: make_plan(kind, "paper") for kind in KINDS if kind in scene_names()}
    frames = effort.of(PIECE, 16)
    rows: list[Row] = []
    costs: dict[str, Cost] = {}
    for name, plan in plans.items():
        own, costs[name] = _costs(name, plan, frames)
        rows += own
    first = plans.get("rotation", plans["hand-held"])
    rows += _sharing(first, effort.of(4, 2), frames, min(effort.rounds, 3))
    task = _scheduling(effort.of(_TASKS, 50))
    rows.append(Row("a task of nothing, scheduled and done", Figure.duration(task)))
    for name, plan in plans.items():
        rows += [_foreseen(name, plan, costs[name], task, cores) for cores in _CORES]
        rows.append(_foreseen(name, plan, costs[name], task, _CORES[-1], times=1000))
    return rows


def _foreseen(name: str, plan: Plan, cost: Cost, task: float, cores: int, times: int = 1) -> Row:
    """What a set of paper size, or of many times its videos, would take, as the costs say; nothing of it was run."""
    parts, videos = times * len(plan.parts), times * len(plan.videos)
    each = math.ceil(parts / cores)
    # The first part of a video that a worker makes has no neighbour whose labels it shares.
    begun = math.ceil(each * videos / parts)
    filming = PIECE * (begun * cost.alone + (each - begun) * cost.pair) + min(videos, each) * cost.prepared
    scheduling = parts * task if cores > 1 else 0.0
    together = times * sum(video.frames for video in plan.videos) * cost.kept * cost.together
    note = (
        f"filming {filming:.3g} s ({parts} parts), Dask {scheduling:.2g} s meanwhile, putting together {together:.3g} s"
    )
    larger, many = f" {times} times" if times > 1 else "", "s" if cores > 1 else ""
    case = f"{name} of paper size{larger}, {cores} core{many}: foreseen"
    return Row(case, Figure.duration(max(filming, scheduling) + together), note=note)


def _costs(name: str, plan: Plan, frames: int) -> tuple[list[Row], Cost]:
    """The parts of one piece of work, from a middling video of the plan."""
    video = plan.videos[len(plan.videos) // 2]
    part = Part(0, 0, 0, frames)
    with one_thread(), tempfile.TemporaryDirectory() as folder:
        shot_of.cache_clear()
        shot, prepared = _busy(lambda: _prepared(video.scene, video.session))
        # A frame on, as within a video; its batches are whole ones.
        _, filmed = _busy(lambda: shot.probe(0, frames))
        pictures, taken = _busy(lambda: shot.target(0, frames))
        _, found = _busy(lambda: [find_candidates(one) for one in pictures])
        # A piece is too short to leave frames between training and test.
        rules = replace(plan.rules, test_fraction=0.0)
        short = replace(video, session=replace(video.session, seconds=frames / 15))
        whole = replace(plan, videos=(short,), rules=rules)
        clip, made = Clip.of(video, shot, 0, frames), Made()
        label_recording(clip)
        labels = labels_of(clip, whole.classes)
        made.told, judged = _busy(lambda: add_frames(clip, 0, labels, made.add, plan.rules, frames))
        staging = Staging.begin(Path(folder) / "set.zarr", whole)
        _, stored = _busy(lambda: staging.keep(part, made))
        _, together = _busy(lambda: staging.put_together(whole, Path(folder) / "set.zarr"))
        size = sum(file.stat().st_size for file in (Path(folder) / "set.zarr" / "image").rglob("*"))
        # A part in a video's middle, whose neighbour the same process has made.
        beside, own = (Part(0, 0, first, first + frames) for first in (3 * frames, 4 * frames))
        _, lone = _busy(lambda: make_part(video, beside, plan.rules, plan.classes))
        _, all_in = _busy(lambda: make_part(video, own, plan.rules, plan.classes))
        begin, end = Clip.of(video, shot, own.first, own.last).ranges["target"]
    crops = len(made.crops)
    raw = plan.rules.side**2
    note = f"{crops} of {frames} frames kept; {size / max(crops, 1) / 1e3:.0f} kB of {raw / 1e3:.0f} kB each"
    looked = f"once for a process that makes a whole video; {(end - begin) / frames:.2f} a probe frame for a part alone"
    pair, alone = ((one + stored) / frames for one in (all_in, lone))
    cost = Cost(prepared, pair, alone, together / max(crops, 1), crops / frames)
    rows = [
        Row(f"{name}: a shot prepared, first frames made", Figure.duration(prepared)),
        Row(f"{name}: a probe frame filmed", Figure.duration(filmed / frames)),
        Row(f"{name}: a target picture made", Figure.duration(taken / frames), note=looked),
        Row(f"{name}: the laser found in it", Figure.duration(found / frames)),
        # The clip films its frames again while it is read.
        Row(f"{name}: a frame judged, centred, cut", Figure.duration(max(judged - filmed, 0) / frames)),
        Row(f"{name}: a crop kept in its region", Figure.duration(stored / max(crops, 1)), note=note),
        Row(f"{name}: a crop put into the set, by one process", Figure.duration(cost.together)),
        Row(f"{name}: a pair, all of a worker's work", Figure.duration(cost.pair)),
        Row(f"{name}: the same where another worker made the part before", Figure.duration(cost.alone)),
    ]
    return rows, cost


def _prepared(scene: Any, session: Any) -> Any:
    shot = shot_of(scene, session)
    shot.probe(0, 1)
    shot.target(0, 1)
    return shot


# Dask's own types do not know all that it takes.
_Cluster: Any = distributed.LocalCluster


@contextlib.contextmanager
def _joined(workers: int) -> Iterator[Any]:
    """Start a cluster of so many processes here, and join it; each keeps its memory between arrays, as ours do."""
    keeping = {**dask.config.get("distributed.nanny.pre-spawn-environ", {}), **MALLOC}
    with (
        tempfile.TemporaryDirectory() as scratch,
        dask.config.set({"distributed.nanny.pre-spawn-environ": keeping}),
        _Cluster(
            n_workers=workers,
            threads_per_worker=1,
            dashboard_address=None,
            memory_limit=0,
            local_directory=scratch,
            silence_logs="CRITICAL",
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client


class _Stages:
    """A progress that notes how long each stage takes, in seconds: filming, putting together."""

    def __init__(self) -> None:
        self.seconds: list[float] = []

    def __call__(self, items: Iterable[Any], what: str, *, total: int | None = None) -> Iterator[Any]:
        del what, total
        start = time.perf_counter()
        yield from items
        self.seconds.append(time.perf_counter() - start)


def _sharing(plan: Plan, videos: int, frames: int, rounds: int) -> list[Row]:
    """The same set filmed by two workers and by one, both ready and waiting; every round has videos of its own."""
    seconds: dict[int, list[float]] = {1: [], 2: []}
    busy: dict[int, list[float]] = {1: [], 2: []}
    starting: list[float] = []
    for number in range(rounds):
        for workers in (1, 2) if number % 2 == 0 else (2, 1):
            start = time.perf_counter()
            with _joined(workers) as client, tempfile.TemporaryDirectory() as folder:
                address, stages = client.scheduler.address, _Stages()
                # Warm: everything is imported, and no shot of the timed set is prepared.
                synthesise(_little(plan, videos, 8, 1000), Path(folder) / "warm.zarr", cluster=address)
                starting.append(time.perf_counter() - start)
                timed = _little(plan, videos, frames, number)
                before = sum(client.run(time.process_time).values())
                synthesise(timed, Path(folder) / "set.zarr", cluster=address, progress=stages)
                busy[workers].append(sum(client.run(time.process_time).values()) - before)
                seconds[workers].append(stages.seconds[0])
    ratios = [one / two for one, two in zip(seconds[1], seconds[2], strict=True)]
    ratio = (median(ratios), min(ratios), max(ratios))
    count = videos * frames
    # Where others use the machine, the time that passes says more of them than of us.
    work = median(two / one for one, two in zip(busy[1], busy[2], strict=True))
    return [
        Row(
            f"{count} pairs filmed by 2 workers",
            Figure.rate(median(seconds[2]) / count, "pairs"),
            "1 worker",
            Figure.rate(median(seconds[1]) / count, "pairs"),
            ratio,
            f"efficiency {ratio[0] / 2:.0%}; the workers' processor time is {work:.2f} times that of one",
        ),
        Row("workers started and warm", Figure.duration(median(starting))),
    ]


def _little(plan: Plan, videos: int, frames: int, seed: int) -> Plan:
    """Some videos of one part each, with seeds of their own."""
    short = tuple(
        replace(one, session=replace(one.session, seconds=frames / 15, seed=one.session.seed + seed + 1))
        for one in plan.videos[:videos]
    )
    return replace(plan, videos=short, rules=replace(plan.rules, test_fraction=0.0))


def _scheduling(count: int) -> float:
    """Seconds that Dask itself takes for a task: nothing is done, and a video's description is sent."""
    video = rotation_plan(load_scene("hand-held")).videos[0]
    with _joined(1) as client:
        client.gather([client.submit(_nothing, video, n, pure=False) for n in range(20)])
        _, took = _timed(lambda: client.gather([client.submit(_nothing, video, n, pure=False) for n in range(count)]))
    return took / count


def _nothing(video: Any, number: int) -> int:
    del video
    return number


def _timed(work: Callable[[], Any], clock: Callable[[], float] = time.perf_counter) -> tuple[Any, float]:
    start = clock()
    return work(), clock() - start


def _busy(work: Callable[[], Any]) -> tuple[Any, float]:
    """Processor time, which others on the machine change least; there is next to no waiting in the parts of a pair."""
    return _timed(work, time.process_time)
