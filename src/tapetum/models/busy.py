"""Share of time in which a GPU runs kernels, measured by torch's profiler over a few steps."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch.profiler import ProfilerActivity, profile

__all__ = ["BusySample", "busy_share", "covered"]

_STEPS = 32


def covered(spans: Iterable[tuple[float, float]]) -> float:
    """Return the length of the union of spans (start, end), in their unit."""
    total, reached = 0.0, float("-inf")
    for start, end in sorted(spans):
        total += max(0.0, end - max(start, reached))
        reached = max(reached, end)
    return total


def busy_share(spans: Iterable[tuple[float, float]]) -> float:
    """Return which share of the time spans cover, over the later half of it: the profiler slows what it begins with."""
    spans = sorted(spans)
    last = max(end for _, end in spans)
    middle = (spans[0][0] + last) / 2
    later = [(max(start, middle), end) for start, end in spans if end > middle]
    return covered(later) / (last - middle) if later else 0.0


class BusySample:
    """Measures `share` (0 ... 1, None if not measured) of the time in which a kernel runs, over `steps` steps from
    `first` on.

    A negative `first` measures nothing. Two CUDA events around a step would count the gaps between its kernels as work;
    the profiler knows each kernel's own time.
    """

    def __init__(self, device: torch.device, first: int, steps: int = _STEPS) -> None:
        self._device, self._first, self._after = device, first, first + steps
        self._profile: profile | None = None
        self.share: float | None = None

    def before(self, step: int) -> None:
        """Mark the beginning of a step."""
        if step == self._first >= 0:
            on_gpu = self._device.type == "cuda"
            kinds = [ProfilerActivity.CUDA if on_gpu else ProfilerActivity.CPU]
            self._profile = profile(activities=kinds, acc_events=True)
            self._wait()
            self._profile.start()
        elif step == self._after:
            self.end()

    def end(self) -> None:
        """Mark the end of the loop, which may come before all steps are measured."""
        if self._profile is None:
            return
        self._wait()
        self._profile.stop()
        spans = [
            (event.time_range.start, event.time_range.end)
            for event in self._profile.events() or ()
            if event.device_type.name == self._device.type.upper()
        ]
        self._profile = None
        # Without kernels the profiler had no access to the GPU's counters: the share is unknown.
        self.share = busy_share(spans) if spans else None

    def _wait(self) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
