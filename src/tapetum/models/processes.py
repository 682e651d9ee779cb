"""Where a training runs: on the CPU, a GPU or several, in one process or more, over Lightning Fabric."""

from __future__ import annotations

import contextlib
import datetime as dt
import logging
import multiprocessing
import os
import socket
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING, Any

import torch
from torch.multiprocessing.spawn import ProcessContext, ProcessException, start_processes

from tapetum.errors import InputError

if TYPE_CHECKING:
    from lightning_fabric import Fabric

__all__ = ["companions", "fabric_of_one", "process_count", "training_device"]

# The others wait so long for one that validates or writes.
_TIMEOUT = dt.timedelta(minutes=10)
_FABRIC_PRECISION = {"float32": "32-true", "bf16": "bf16-mixed"}
_ENVIRONMENT = ("MASTER_ADDR", "MASTER_PORT", "OMP_NUM_THREADS")


def training_device(name: str | torch.device) -> torch.device:
    """Return the device called "auto" (CUDA where there is one), "cpu", "cuda" or "cuda:1".

    Raises
    ------
    InputError
        When there is none of that name on this machine.
    """
    cuda = torch.cuda.device_count()
    if name == "auto":
        return torch.device("cuda" if cuda else "cpu")
    remedy = 'use "auto", "cpu" or "cuda"'
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise InputError(f"no device is called {name!r}", where="device", remedy=remedy) from error
    if device.type not in ("cpu", "cuda"):
        raise InputError(f"cannot train on {name!r}", where="device", remedy=remedy)
    if device.type == "cuda" and (device.index or 0) >= cuda:
        raise InputError(f"this machine has {cuda} CUDA devices, asked for {name!r}", where="device", remedy=remedy)
    return device


def process_count(processes: int | str, device: torch.device) -> int:
    """Return how many processes train: "auto" is one for every GPU, and one on a CPU.

    Raises
    ------
    InputError
        When there are not so many GPUs, or `processes` is no such number.
    """
    there = torch.cuda.device_count()
    if processes == "auto":
        return max(1, there) if device.type == "cuda" and device.index is None else 1
    if not isinstance(processes, int) or processes < 1:
        raise InputError(f"must be 1 or more, is {processes!r}", where="processes", remedy='"auto" takes all GPUs')
    if processes > 1 and device.type == "cuda":
        if device.index is not None:
            raise InputError(f"{device} is one device", where="processes", remedy='use device="cuda" for several')
        if processes > there:
            raise InputError(
                f"{processes} GPUs asked for, there are {there}", where="processes", remedy='"auto" takes all'
            )
    return processes


def fabric_of_one(device: torch.device, precision: str) -> Fabric:
    """Return a Fabric for this process alone."""
    from lightning_fabric import Fabric

    devices = [device.index or 0] if device.type == "cuda" else 1
    with _quiet_fabric():
        return Fabric(accelerator=device.type, devices=devices, precision=_FABRIC_PRECISION[precision])  # type: ignore[arg-type]


@contextlib.contextmanager
def companions(
    count: int, device: torch.device, precision: str, work: Callable[..., None], *arguments: Any
) -> Iterator[Fabric]:
    """Start the processes that train beside this one, and yield this one's Fabric, rank 0 of `count`.

    This process takes part itself: what it is called back with (bars, reports) need not travel, and Ctrl-C ends
    all of them.

    Parameters
    ----------
    count
        Processes, this one included.
    device
        "cpu", or "cuda" for the first `count` GPUs.
    precision
        See `tapetum.models.epochs.TrainingSettings`.
    work
        Called in each of the others as ``work(fabric, *arguments)``; like them, it must be able to travel.
    arguments
        Arrays rather than tensors: those would go through shared memory, which is scarce in containers.

    Raises
    ------
    InputError
        When one of the processes ends before its time.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    threads = torch.get_num_threads()
    share = max(1, threads // count) if device.type == "cpu" else threads
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    receiver, sender = multiprocessing.get_context("spawn").Pipe(duplex=False)
    inputs = (count, port, share, device.type, precision, work, arguments, sender)
    group = start_processes(_companion, inputs, nprocs=count - 1, join=False, daemon=True, start_method="spawn")
    assert isinstance(group, ProcessContext)  # and not None, as where it waits for their end
    started: list[Any] = group.processes
    try:
        _await_all(group, receiver, count - 1)
        fabric = _fabric_of_many(0, count, port, device.type, precision)
        torch.set_num_threads(share)
        yield fabric
        fabric.barrier()
        _leave()
        group.join()
    except BaseException as error:
        # One that fails closes its connections first, and is known to have ended a moment later.
        lost = _said(error) if isinstance(error, ProcessException) else None
        if isinstance(error, RuntimeError):
            lost = _failure(group, 10)
        for process in started:
            process.terminate()
        _leave()
        if lost is not None:
            remedy = "use fewer processes; a checkpoint can be resumed"
            raise InputError(lost, where="processes", remedy=remedy) from error
        raise
    finally:
        for process in started:
            process.join()
        torch.set_num_threads(threads)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _companion(
    index: int,
    count: int,
    port: int,
    threads: int,
    accelerator: str,
    precision: str,
    work: Callable[..., None],
    arguments: tuple[Any, ...],
    ready: Connection,
) -> None:
    """Be rank index + 1."""
    torch.set_num_threads(threads)
    ready.send(index)
    fabric = _fabric_of_many(index + 1, count, port, accelerator, precision)
    torch.set_num_threads(threads)
    work(fabric, *arguments)
    fabric.barrier()
    _leave()


def _await_all(group: ProcessContext, receiver: Connection, count: int) -> None:
    """Return when all processes are up; the meeting itself would wait long for one that never comes."""
    missing = set(range(count))
    while missing:
        if receiver in wait([receiver, *group.sentinels]):
            missing.discard(receiver.recv())
        elif (lost := _failure(group, 1)) is not None:
            remedy = 'a script that trains needs `if __name__ == "__main__":` around what it runs'
            raise InputError(lost, where="processes", remedy=remedy)


def _failure(group: ProcessContext, seconds: float) -> str | None:
    """Say in a line how one of the processes failed; None where none does within so many seconds."""
    try:
        group.join(timeout=seconds)
    except ProcessException as error:
        return _said(error)
    return None


def _said(error: ProcessException) -> str:
    return f"a training process failed ({error.msg.strip().splitlines()[-1]})"


def _leave() -> None:
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


@contextlib.contextmanager
def _quiet_fabric() -> Iterator[None]:
    """Keep Fabric from announcing itself on standard error."""
    logger = logging.getLogger("lightning_fabric")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)


def _fabric_of_many(rank: int, count: int, port: int, accelerator: str, precision: str) -> Fabric:
    """Return a Fabric that has met the others."""
    from lightning_fabric import Fabric
    from lightning_fabric.plugins.environments.lightning import LightningEnvironment
    from lightning_fabric.strategies.ddp import DDPStrategy

    class Started(LightningEnvironment):
        """Processes that exist already, on this machine."""

        @property
        def creates_processes_externally(self) -> bool:
            return True

        @property
        def main_address(self) -> str:
            return "127.0.0.1"

        @property
        def main_port(self) -> int:
            return port

        def local_rank(self) -> int:
            return rank

        def node_rank(self) -> int:
            return 0

    strategy = DDPStrategy(cluster_environment=Started(), timeout=_TIMEOUT)
    with _quiet_fabric():
        fabric = Fabric(
            accelerator=accelerator,
            strategy=strategy,
            devices=count,
            precision=_FABRIC_PRECISION[precision],  # type: ignore[arg-type]
        )
        fabric.launch()
    return fabric
