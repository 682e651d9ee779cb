"""Output of `tapetum dataset info`: text lines or one JSON object."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray as xr

    from tapetum.data.doubles import Doubles
    from tapetum.data.leaks import Leak
    from tapetum.data.quality import DatasetQuality, Spread

__all__ = ["as_told", "left_out", "lines", "noticed"]

_LEVELS, _PLAIN = "▁▂▃▄▅▆▇█", ".:-=+*#@"


def as_told(dataset: xr.Dataset, quality: DatasetQuality, leaks: list[Leak]) -> dict[str, Any]:
    """Return all results as JSON values; infinite and NaN numbers become null."""
    told = asdict(quality)
    labels = {
        name: {**asdict(label), **{word: getattr(label.spread, word) for word in ("least", "mean", "most")}}
        for name, label in quality.labels.items()
    }
    told |= {"labels": labels, "recordings": dataset.tp.recordings, "leaks": [asdict(leak) for leak in leaks]}
    return _plain(told)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def left_out(recording: Mapping[str, Any]) -> str:
    """Return the number of images of a recording that were left out, and why; empty for none."""
    left = ", ".join(f"{why} {count}" for why, count in recording.get("left_out", {}).items() if count)
    return f" (left out: {left})" if left else ""


def lines(path: str, dataset: xr.Dataset, quality: DatasetQuality, leaks: list[Leak]) -> Iterator[str]:
    """Yield the lines of text."""
    split = f"{quality.train} to train on, {quality.test} to test"
    if quality.embargo:
        split += f", {quality.embargo} between them to neither"
    yield f"{path}: {quality.frames} crops of {quality.side} px: {split}"
    for name, label in quality.labels.items():
        if name == "device" and quality.classes:
            yield f"  device: {', '.join(f'{one} {count}' for one, count in quality.classes.items())}"
            continue
        span = f"{label.spread.least:.3f} to {label.spread.most:.3f}, mean {label.spread.mean:.3f} ({label.unit})"
        yield f"  {name}: {span} {_drawn(label.spread)}"
    if units := dataset.tp.units:
        yield f"  units: {len(units)} copies of cameras"
    told = dataset.tp.recordings
    for number, (name, (train, test)) in enumerate(zip(quality.recordings, quality.per_recording, strict=True)):
        counts = f"{train + test} frames"
        if len(told) == len(quality.recordings):
            one = told[number]
            counts = f"{one.get('used', train + test)} of {one.get('frames', train + test)} frames{left_out(one)}"
        yield f"  {name}: {counts}, {train} train, {test} test"
    if quality.quality is not None:
        one = quality.quality
        yield f"  label quality: {one.least:.2f} to {one.most:.2f}, median {one.median:.2f} {_drawn(one)}"
    off = quality.off_centre
    yield f"  signal over noise: {quality.snr.least:.0f} to {quality.snr.most:.0f}, median {quality.snr.median:.0f}"
    yield f"  off centre: median {off.median:.1f} px, at most {off.most:.1f} px"
    yield from (f"  {line}" for line in noticed(quality, leaks))


def noticed(quality: DatasetQuality, leaks: list[Leak]) -> list[str]:
    """Return a line for each fault, and one for the checks that found none."""
    from tapetum.data.doubles import NEAR_BITS
    from tapetum.data.quality import EMPTY_SNR, OFF_CENTRE, SATURATED_SHARE

    counts = {
        _doubled("{} exact duplicates", quality.exact): quality.exact.frames,
        _doubled("{} near duplicates", quality.near) + f" (at most {NEAR_BITS} of 256 bits apart)": quality.near.frames,
        f"{quality.saturated} saturated frames (over {SATURATED_SHARE:.2%} of pixels at full scale)": quality.saturated,
        f"{quality.empty} empty frames (SNR under {EMPTY_SNR:g})": quality.empty,
        f"{quality.badly_centred} frames off centre ({OFF_CENTRE:.0%} of the side or more)": quality.badly_centred,
        f"{quality.not_finite} frames with pixels that are no numbers": quality.not_finite,
        f"{quality.interleaved} test frames lie between train frames of their recording": quality.interleaved,
    }
    for name, label in quality.labels.items():
        counts[f"{name}: {label.not_finite} labels that are no numbers"] = label.not_finite
        counts[f"{name}: {label.out_of_range} labels that cannot be"] = label.out_of_range
    told = [line for line, count in counts.items() if count]
    if not told:
        told = ["no duplicates; no saturated, empty or badly centred frame; no impossible label"]
    found = [f"leak: {leak}" for leak in leaks if leak.verdict == "found"]
    told += found
    if not found and any(leak.verdict == "none" for leak in leaks):
        untested = any(leak.verdict == "untested" for leak in leaks)
        clean = "no label can be read from position, order or background"
        told.append("no leak in what could be tested" if untested else clean)
    whys: dict[str, list[str]] = {}
    for leak in leaks:
        if leak.verdict == "untested":
            whys.setdefault(leak.why, []).append(f"{leak.target} from {leak.name}")
    return told + [f"not tested: {', '.join(dict.fromkeys(what))}: {why}" for why, what in whys.items()]


def _doubled(words: str, doubles: Doubles) -> str:
    across = f", {doubles.across_split} across train and test" if doubles.across_split else ""
    first = f", first: frames {doubles.pairs[0][0]} and {doubles.pairs[0][1]}" if doubles.pairs else ""
    return words.format(doubles.frames) + across + first


def _drawn(spread: Spread) -> str:
    """Return a histogram in one line of text."""
    if not spread.counts or spread.least == spread.most:
        return ""
    levels, most = _LEVELS, max(spread.counts)
    try:
        levels.encode(sys.stdout.encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        levels = _PLAIN
    return "".join(" " if n == 0 else levels[min(7, 8 * n // most)] for n in spread.counts)
