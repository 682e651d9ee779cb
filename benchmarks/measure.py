"""Timing in turns, and the machine it was done on."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import median

import torch

__all__ = ["Contender", "Effort", "Figure", "Row", "Timings", "in_turns", "machine", "wait"]


@dataclass(frozen=True)
class Effort:
    """How much to repeat: `rounds` turns of everything; `quick` also takes less work a turn, to try a benchmark out."""

    rounds: int = 7
    quick: bool = False

    def of(self, full: int, quick: int) -> int:
        """The amount of work a turn."""
        return quick if self.quick else full


@dataclass(frozen=True)
class Contender:
    """What is timed: `run` does `work` units (images, frames); `repeats` times a round where it is short."""

    run: Callable[[], object]
    work: float = 1.0
    repeats: int = 1
    warm_up: bool = True


@dataclass(frozen=True)
class Timings:
    """Seconds a unit of work: one number a round and contender, the median of that round's repeats."""

    seconds: Mapping[str, tuple[float, ...]]

    def typical(self, name: str) -> float:
        """The median over the rounds, in seconds a unit."""
        return median(self.seconds[name])

    def speed_up(self, ours: str, peer: str) -> tuple[float, float, float]:
        """How many times faster ours is: median, least and largest of the rounds' own ratios.

        The ratio is formed within each round, where both met the same load.
        """
        ratios = [theirs / own for own, theirs in zip(self.seconds[ours], self.seconds[peer], strict=True)]
        return median(ratios), min(ratios), max(ratios)


def in_turns(contenders: Mapping[str, Contender], rounds: int) -> Timings:
    """Run all contenders one after another, `rounds` times, after one untimed run of each that wants it."""
    if rounds < 1:
        raise ValueError(f"needs at least one round, is {rounds}")
    for contender in contenders.values():
        if contender.warm_up:
            contender.run()
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for number in range(rounds):
        # The order turns round, so that nobody always comes after the same neighbour.
        order = list(contenders) if number % 2 == 0 else list(contenders)[::-1]
        for name in order:
            contender = contenders[name]
            runs: list[float] = []
            for _ in range(contender.repeats):
                start = time.perf_counter()
                contender.run()
                runs.append(time.perf_counter() - start)
            seconds[name].append(median(runs) / contender.work)
    return Timings({name: tuple(values) for name, values in seconds.items()})


def wait(made: torch.Tensor) -> None:
    """Until it is there: a GPU's calls return before."""
    if made.device.type == "cuda":
        torch.cuda.synchronize(made.device)


@dataclass(frozen=True)
class Figure:
    """A time or a rate, with its unit."""

    value: float
    unit: str

    @classmethod
    def rate(cls, seconds: float, what: str) -> Figure:
        """Units a second."""
        return cls(1 / seconds, f"{what}/s")

    @classmethod
    def duration(cls, seconds: float) -> Figure:
        """Seconds, or milliseconds where that reads better."""
        return cls(seconds, "s") if seconds >= 1 else cls(seconds * 1e3, "ms")

    def __str__(self) -> str:
        return f"{_rounded(self.value)} {self.unit}"


@dataclass(frozen=True)
class Row:
    """A line of the table: what was done, ours, the peer's, the ratio (least to largest) and what to know about it."""

    case: str
    ours: Figure
    peer: str = ""
    theirs: Figure | None = None
    ratio: tuple[float, float, float] | None = None
    note: str = ""

    @cached_property
    def cells(self) -> tuple[str, str, str, str, str]:
        """The row as text: case, ours, peer, ratio, note."""
        theirs = f"{self.theirs} ({self.peer})" if self.theirs is not None else "–"
        if self.ratio is None:
            ratio = "–"
        else:
            middle, least, most = (_rounded(value) for value in self.ratio)
            ratio = f"{middle}×" if least == most else f"{middle}× ({least}–{most})"
        return self.case, str(self.ours), theirs, ratio, self.note


def _rounded(value: float) -> str:
    if value >= 100:
        return f"{value:,.0f}".replace(",", " ")
    return f"{value:.3g}" if value < 1 else f"{value:.2g}" if value < 10 else f"{value:.0f}"


def machine(*packages: str) -> str:
    """One line on what was measured on: processor, cores, threads, versions (of `packages` too)."""
    names = ["tapetum", "torch", *packages]
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in names)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = f"{cores} core{'s' if cores != 1 else ''}"
    system = f"{platform.system()}, Python {platform.python_version()}"
    gpu = f"{torch.cuda.get_device_name()}; " if torch.cuda.is_available() else ""
    return f"{gpu}{_processor()}, {count}, {torch.get_num_threads()} torch threads; {system}; {versions}"


def _processor() -> str:
    listing = Path("/proc/cpuinfo")
    if listing.is_file():
        for line in listing.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
