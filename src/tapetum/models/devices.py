"""Devices and processes of a training, over Lightning Fabric."""

from __future__ import annotations

import contextlib
import datetime as dt
import logging
import multiprocessing
import os
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import torch
from torch.multiprocessing.spawn import ProcessContext, ProcessException, start_processes

from tapetum.errors import InputError

if TYPE_CHECKING:
    from multiprocessing.synchronize import Semaphore

    from lightning_fabric import Fabric

__all__ = ["companions", "has_bfloat16", "make_fabric", "process_count", "training_device"]

# How long processes wait for one that validates or writes.
_TIMEOUT = dt.timedelta(minutes=10)
_FABRIC_PRECISION = {"float32": "32-true", "bf16": "bf16-mixed"}
# Seconds within which a process ends after it has closed its connections.
_ENDING = 10.0


def training_device(name: str | torch.device) -> torch.device:
    """Return the device "auto" (CUDA if present), "cpu", "cuda" or "cuda:1"; raise an InputError if it is missing."""
    cuda = torch.cuda.device_count()
    if name == "auto":
        return torch.device("cuda" if cuda else "cpu")
    remedy = 'use "auto", "cpu" or a CUDA device that is there'
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise InputError(f"no device is called {name!r}", where="device", remedy=remedy) from error
    if device.type not in ("cpu", "cuda"):
        raise InputError(f"cannot train on {name!r}", where="device", remedy=remedy)
    if device.type == "cuda" and (device.index or 0) >= cuda:
        raise InputError(f"this machine has {cuda} CUDA devices, asked for {name!r}", where="device", remedy=remedy)
    return device


def has_bfloat16(device: torch.device) -> bool:
    """Return whether products in bfloat16 are fast: GPUs and many processors have instructions for them.

    Elsewhere they are emulated, which takes several times as long as float32.
    """
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return torch.backends.mkldnn.is_available() and bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())


def process_count(processes: int | str, device: torch.device) -> int:
    """Return how many processes train ("auto": one per GPU); raise an InputError when there are fewer GPUs."""
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


def make_fabric(device: torch.device, precision: str, *, processes: int = 1) -> Fabric:
    """Return a Fabric for this process alone, or for one of several that `companions` started.

    Where the device has no bfloat16, float32 takes its place.
    """
    from lightning_fabric import Fabric
    from lightning_fabric.plugins.environments.lightning import LightningEnvironment
    from lightning_fabric.strategies.ddp import DDPStrategy

    several = processes > 1
    if not has_bfloat16(device):
        precision = "float32"
    ours = [device.index or 0] if device.type == "cuda" and not several else processes
    logger = logging.getLogger("lightning_fabric")
    level = logger.level
    # Fabric would announce itself on standard error.
    logger.setLevel(logging.WARNING)
    try:
        made = Fabric(
            accelerator=device.type,
            devices=ours,
            strategy=DDPStrategy(cluster_environment=LightningEnvironment(), timeout=_TIMEOUT) if several else "auto",
            precision=_FABRIC_PRECISION[precision],  # type: ignore[arg-type]
        )
        made.launch()
    finally:
        logger.setLevel(level)
    return made


@contextlib.contextmanager
def companions(
    count: int, device: torch.device, precision: str, work: Callable[..., None], *arguments: Any
) -> Iterator[Fabric]:
    """Start `count` - 1 more training processes and yield this process's Fabric, of rank 0.

    Each of the others calls ``work(fabric, *arguments)``, all pickled; arguments should be arrays, as tensors would use
    shared memory, which is scarce in containers. Fabric's own launcher is not used, because this process trains too:
    its callbacks need not be pickled, and Ctrl-C ends all processes. The processes find each other by torchrun's
    environment variables. Raises an InputError when one of them ends too early.
    """
    from lightning_fabric.plugins.environments.lightning import find_free_network_port

    threads, environment = torch.get_num_threads(), dict(os.environ)
    share = max(1, threads // count) if device.type == "cpu" else threads
    port = str(find_free_network_port())
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "LOCAL_RANK": "0", "NODE_RANK": "0"}
    up = multiprocessing.get_context("spawn").Semaphore(0)
    inputs = (up, count, share, device, precision, work, arguments)
    group = start_processes(_companion, inputs, nprocs=count - 1, join=False, daemon=True, start_method="spawn")
    assert isinstance(group, ProcessContext)  # and not None, as where it waits for their end
    started: list[Any] = group.processes
    try:
        _await_all(group, up, count - 1)
        ours = make_fabric(device, precision, processes=count)
        torch.set_num_threads(share)
        yield ours
        _leave(ours)
        group.join()
    except BaseException as error:
        lost = _said(error) if isinstance(error, ProcessException) else None
        if isinstance(error, RuntimeError):
            lost = _failure(group, _ENDING)
        if lost is None:
            raise
        remedy = "use fewer processes; a checkpoint can be resumed"
        raise InputError(lost, where="processes", remedy=remedy) from error
    finally:
        for process in started:
            process.terminate()
        if torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()
        for process in started:
            process.join()
        torch.set_num_threads(threads)
        os.environ.clear()
        os.environ.update(environment)


def _companion(
    index: int,
    up: Semaphore,
    count: int,
    threads: int,
    device: torch.device,
    precision: str,
    work: Callable[..., None],
    arguments: tuple[Any, ...],
) -> None:
    """Run as rank index + 1."""
    up.release()
    os.environ["LOCAL_RANK"] = str(index + 1)
    ours = make_fabric(device, precision, processes=count)
    torch.set_num_threads(threads)
    work(ours, *arguments)
    _leave(ours)


def _leave(ours: Fabric) -> None:
    """Wait for all processes, then leave the group."""
    ours.barrier()
    torch.distributed.destroy_process_group()


def _await_all(group: ProcessContext, up: Semaphore, count: int) -> None:
    """Wait until all processes run; Fabric would wait minutes for one that never starts."""
    for _ in range(count):
        while not up.acquire(timeout=0.1):
            if (lost := _failure(group, 0)) is not None:
                remedy = 'a script that trains needs `if __name__ == "__main__":` around what it runs'
                raise InputError(lost, where="processes", remedy=remedy)


def _failure(group: ProcessContext, seconds: float) -> str | None:
    """Return in one line how a process failed; None if none fails within `seconds`."""
    try:
        group.join(timeout=seconds)
    except ProcessException as error:
        return _said(error)
    return None


def _said(error: ProcessException) -> str:
    return f"a training process failed ({error.msg.strip().splitlines()[-1]})"
