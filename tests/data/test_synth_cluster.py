"""A set made by several processes: the same bytes as by one, also when one of them dies."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import psutil
import pytest
from synth_plans import digest, little_plan

from tapetum.data.synth import synthesise
from tapetum.data.synth.parallel import parts_by_processes
from tapetum.data.synth.plan import Part
from tapetum.data.synth.store import Staging
from tapetum.errors import InputError, MissingExtraError, TapetumError


def workers() -> list[psutil.Process]:
    """Worker processes that this one has started and that still run."""
    found = []
    for child in psutil.Process().children(recursive=True):
        try:
            words = child.cmdline()
            # What a process forked from is none itself.
            forked = any("forkserver" in word for word in words) and child.ppid() != os.getpid()
            if forked or any("spawn_main" in word for word in words):
                found.append(child)
        except psutil.NoSuchProcess:  # ended meanwhile; a zombie, whose end nobody has asked for yet, is one of these
            continue
    return found


@pytest.fixture
def alone(whole: Path) -> str:
    return digest(whole)


@pytest.mark.slow
def test_two_workers_of_a_cluster_one_killed_half_way_give_the_same_bytes(alone: str, tmp_path: Path):
    import distributed

    killed: list[psutil.Process] = []
    out = tmp_path / "out" / "set.zarr"

    def kill(items, what, *, total=None):
        for number, item in enumerate(items):
            yield item
            if number == 0 and not killed:
                two = workers()
                assert len(two) == 2
                killed.append(two[0])
                two[0].send_signal(signal.SIGKILL)

    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, local_directory=str(tmp_path / "scratch")
    ) as cluster:
        synthesise(little_plan(2), out, cluster=cluster.scheduler_address, progress=kill)
    assert digest(out) == alone
    assert len(killed) == 1 and not killed[0].is_running()
    assert [path.name for path in out.parent.iterdir()] == ["set.zarr"]


def test_a_running_cluster_is_joined_by_its_address(alone: str, tmp_path: Path):
    import distributed

    # Its workers are threads of this process: as far as the set is concerned, another cluster.
    with distributed.LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        processes=False,
        protocol="tcp",
        dashboard_address=None,
        local_directory=str(tmp_path / "scratch"),
    ) as cluster:
        out = synthesise(little_plan(2), tmp_path / "set.zarr", cluster=cluster.scheduler_address)
    assert digest(out) == alone


def test_a_cluster_without_workers_or_without_anybody_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    import distributed

    monkeypatch.setattr("tapetum.data.synth.cluster._WAIT", 0.5)
    with distributed.LocalCluster(
        n_workers=0, processes=False, protocol="tcp", dashboard_address=None, local_directory=str(tmp_path / "scratch")
    ) as cluster:
        address = cluster.scheduler_address
        with pytest.raises(InputError, match="has no workers"):
            synthesise(little_plan(1), tmp_path / "a.zarr", cluster=address)
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        synthesise(little_plan(1), tmp_path / "b.zarr", cluster=address)
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        synthesise(little_plan(1), tmp_path / "c.zarr", cluster="nonsense://1")


def test_without_the_extra_its_name_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"tapetum\[cluster\]"):
        synthesise(little_plan(1), tmp_path / "set.zarr", cluster="tcp://127.0.0.1:1")


def test_processes_without_dask_one_killed_half_way_give_the_same_bytes(
    alone: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "distributed", None)
    killed: list[psutil.Process] = []
    environment = dict(os.environ)

    def kill(items, what, *, total=None):
        for number, item in enumerate(items):
            yield item
            if number == 0 and not killed:
                two = workers()
                assert len(two) == 2
                killed.append(two[0])
                two[0].send_signal(signal.SIGKILL)

    out = synthesise(little_plan(2), tmp_path / "set.zarr", processes=2, progress=kill)
    assert digest(out) == alone
    assert len(killed) == 1 and not killed[0].is_running()
    assert [path.name for path in tmp_path.iterdir()] == ["set.zarr"]
    assert dict(os.environ) == environment
    assert workers() == []


def test_when_all_processes_die_what_is_done_is_kept(alone: str, tmp_path: Path):
    def kill(items, what, *, total=None):
        for item in items:
            yield item
            for process in workers():
                process.send_signal(signal.SIGKILL)

    with pytest.raises(TapetumError, match="all of the 2 processes that film ended"):
        synthesise(little_plan(2), tmp_path / "set.zarr", processes=2, progress=kill)
    assert workers() == [] and len(list((tmp_path / "set.zarr.part" / "done").iterdir())) >= 1
    out = synthesise(little_plan(2), tmp_path / "set.zarr", workers=1)  # older name of processes
    assert digest(out) == alone


def test_a_process_that_fails_says_why(tmp_path: Path):
    plan = little_plan(2)
    staging = Staging.begin(tmp_path / "set.zarr", plan)
    (staging.path / "done").rmdir()
    (staging.path / "done").write_text("")
    with pytest.raises(InputError, match="is a file, not a folder; choose another path"):
        list(parts_by_processes(plan, staging, [plan.parts[0]], 1))
    with pytest.raises(TapetumError, match="a process that films failed: "):
        list(parts_by_processes(plan, staging, [Part(99, 10**6, 0, 1)], 1))
    staging.remove()
    with pytest.raises(InputError, match=r"set\.zarr\.part: has been removed while it was written"):
        list(parts_by_processes(plan, staging, [plan.parts[0]], 1))
    assert workers() == [] and not list(tmp_path.iterdir())
