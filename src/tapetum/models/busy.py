"""How much of its time a GPU works: kernels' own times, over a few steps."""

from __future__ import annotations

import time
from collections.abc import Iterable

import torch
from torch.profiler import ProfilerActivity, profile

__all__ = ["BusySample", "covered"]

_STEPS = 8


def covered(spans: Iterable[tuple[float, float]]) -> float:
    """Return the length of the union of spans (start, end), in their unit."""
    total, reached = 0.0, float("-inf")
    for start, end in sorted(spans):
        total += max(0.0, end - max(start, reached))
        reached = max(reached, end)
    return total


class BusySample:
    """Measures the share of time in which a kernel runs, over a few steps of a loop.

    Two CUDA events around a step would count as work the gaps between its kernels, of which a small network has
    many; torch's profiler knows each kernel's own time.

    Parameters
    ----------
    device
        Where kernels run.
    first
        Number of the first step that is measured; a negative one measures nothing.
    steps
        How many are.

    Attributes
    ----------
    share
        0 ... 1; None where nothing was measured.
    """

    def __init__(self, device: torch.device, first: int, steps: int = _STEPS) -> None:
        self._device, self._first, self._after = device, first, first + steps
        self._profile: profile | None = None
        self._start = 0.0
        self.share: float | None = None

    def before(self, step: int) -> None:
        """Say that a step begins."""
        if step == self._first >= 0:
            on_gpu = self._device.type == "cuda"
            kinds = [ProfilerActivity.CUDA if on_gpu else ProfilerActivity.CPU]
            self._profile = profile(activities=kinds, acc_events=True)
            self._wait()
            self._profile.start()
            self._start = time.perf_counter()
        elif step == self._after:
            self.end()

    def end(self) -> None:
        """Say that the loop is over, where it may be before the sample is full."""
        if self._profile is None:
            return
        self._wait()
        seconds = time.perf_counter() - self._start
        self._profile.stop()
        # The profiler counts in microseconds.
        spans = [
            (event.time_range.start, event.time_range.end)
            for event in self._profile.events() or ()
            if event.device_type.name == self._device.type.upper()
        ]
        self._profile = None
        # No kernels: the profiler was not let near the GPU's counters. That says nothing about the GPU.
        self.share = min(1.0, covered(spans) * 1e-6 / seconds) if spans else None

    def _wait(self) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
