"""Fusion of several probes' estimates of one target, converted to one place and one clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from tapetum.errors import InputError
from tapetum.track.kalman import NORMAL, Series
from tapetum.track.places import Places
from tapetum.track.smooth import quantities_in
from tapetum.track.tables import ENDS, MOMENT, plain, track_schema

__all__ = ["Fused", "Fusion", "Places", "at_times", "combine", "fuse", "fuse_tracks"]

Array = NDArray[np.float64]
GAZE = ("gaze_x", "gaze_y")


@dataclass(frozen=True)
class Fused:
    """Joint estimates of several probes at N moments.

    Parameters
    ----------
    value, lower, upper
        [N, K] estimates and 90 % intervals; NaN where no probe measures.
    used
        [N, M] which of the M probes contribute to a row.
    consistency
        [N] probability of so large a disagreement by chance (χ² over all quantities); NaN where a row has one probe.
    disagree
        [N] whether probes contradict each other and it is unknown which is right: the interval then spans them.
    """

    value: Array
    lower: Array
    upper: Array
    used: NDArray[np.bool_]
    consistency: Array
    disagree: NDArray[np.bool_]


@dataclass(frozen=True)
class Fusion:
    """A table of fused tracks, with the number of rows that each probe contributed to.

    Parameters
    ----------
    table
        A table of tracks, readable by `read_tracks`, with two more columns: `probes`, the number of probes in the row,
        and `consistency`, as of `Fused`.
    used
        Rows that each probe contributed to.
    dropped
        Rows in which a probe was left out because the others contradict it.
    disagree
        Rows in which probes contradict each other and nothing decides between them.
    """

    table: pa.Table
    used: tuple[int, ...]
    dropped: int
    disagree: int


def combine(value: Array, deviation: Array, correlation: float = 0.5) -> tuple[Array, Array]:
    """Weight estimates so that the variance of their mean is least.

    Parameters
    ----------
    value, deviation
        [M, N] estimates of M probes and their standard deviations; NaN where there is none.
    correlation
        Of the errors of any two probes. 0: inverse-variance weights. 1: covariance intersection, safe whatever the
        correlation; of a single number it takes the narrowest interval (Julier and Uhlmann, Proc. ACC (1997)).

    Returns
    -------
    value, deviation
        [N]; NaN where none measures.

    Raises
    ------
    InputError
        When the correlation is out of range.

    Notes
    -----
    Best linear unbiased (Bar-Shalom and Campo, IEEE Trans. Aerosp. Electron. Syst. 22, 803 (1986)), with non-negative
    weights: a guessed correlation must not subtract a poor estimate from a good one.
    """
    if not 0 <= correlation <= 1:
        raise InputError(f"must lie from 0 to 1, is {correlation}", where="correlation", remedy="1 is always safe")
    # Just below 1, so that equally wide intervals share the weight.
    rho = min(correlation, 1 - 1e-9)
    kept = np.isfinite(value) & np.isfinite(deviation) & (deviation > 0)
    weight = np.zeros_like(deviation)
    for _ in range(len(value)):
        inverse = np.divide(1.0, deviation, out=np.zeros_like(deviation), where=kept)
        count = kept.sum(axis=0)
        shared = rho * inverse.sum(axis=0) / (1 - rho + rho * count)
        weight = inverse * (inverse - shared)
        negative = kept & (weight < 0)
        if not negative.any():
            break
        # Drop the most uncertain estimate of negative weight, then weight the others again.
        worst = np.where(negative, deviation, -np.inf).argmax(axis=0)
        rows = np.flatnonzero(negative.any(axis=0))
        kept[worst[rows], rows] = False
    total = weight.sum(axis=0)
    none = total <= 0
    weight = weight / np.where(none, 1.0, total)
    known, wide = np.where(kept, value, 0.0), np.where(kept, deviation, 0.0)
    variance = (1 - rho) * ((weight * wide) ** 2).sum(axis=0) + rho * (weight * wide).sum(axis=0) ** 2
    return np.where(none, np.nan, (weight * known).sum(axis=0)), np.where(none, np.nan, np.sqrt(variance))


def _disagreement(value: Array, deviation: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return χ² and its degrees of freedom, [N] each, of estimates [M, N, K] that should be the same for all M."""
    # Correlated errors differ less: ignoring the correlation makes the test cautious.
    mean = combine(value.reshape(len(value), -1), deviation.reshape(len(value), -1), 0.0)[0].reshape(value.shape[1:])
    squared = np.nansum(((value - mean) / deviation) ** 2, axis=(0, 2))
    return squared, np.maximum(np.isfinite(value).sum(axis=0) - 1, 0).sum(axis=1)


def fuse(
    value: ArrayLike, lower: ArrayLike, upper: ArrayLike, *, correlation: float = 0.5, alpha: float = 1e-3
) -> Fused:
    """Fuse the estimates of several probes, moment by moment.

    Parameters
    ----------
    value, lower, upper
        [M, N, K] estimates of K quantities by M probes at N moments, with 90 % intervals, already as the first probe
        would see them. NaN, or an infinite interval, where a probe measures nothing.
    correlation
        As of `combine`.
    alpha
        Probability below which a disagreement is not chance. Of three probes or more, the one that the others
        contradict most is then left out, and so on; of two the interval spans both.

    Raises
    ------
    InputError
        When shapes differ, or there are fewer than two probes.
    """
    x, low, high = (np.array(one, dtype=np.float64) for one in (value, lower, upper))
    if x.ndim != 3 or not x.shape == low.shape == high.shape:
        shapes = f"{x.shape}, {low.shape} and {high.shape}"
        raise InputError(f"value, lower and upper must be [M, N, K] alike, are {shapes}", where="fuse")
    if len(x) < 2:
        raise InputError(f"{len(x)} probe alone cannot be fused", where="fuse", remedy="give two or more")
    deviation = (high - low) / 2 / NORMAL
    bad = ~(np.isfinite(x) & np.isfinite(deviation) & (deviation > 0))
    x[bad], deviation[bad] = np.nan, np.nan
    disagree = np.zeros(x.shape[1], bool)
    used: NDArray[np.bool_] = np.asarray(np.isfinite(x).any(axis=2)).T
    squared, freedom = _disagreement(x, deviation)
    # Two probes that measure different quantities have nothing to compare.
    consistency = np.where(freedom > 0, chi2.sf(squared, np.maximum(freedom, 1)), np.nan)
    for n in np.flatnonzero(consistency < alpha):
        chance = float(consistency[n])
        while chance < alpha:
            if used[n].sum() < 3:
                disagree[n] = True
                break
            trials = {int(m): _without(x[:, n], deviation[:, n], int(m)) for m in np.flatnonzero(used[n])}
            worst = max(trials, key=lambda m: trials[m])
            x[worst, n], deviation[worst, n], used[n, worst] = np.nan, np.nan, False
            chance = trials[worst]
    flat = x.reshape(len(x), -1)
    mean, spread = (one.reshape(x.shape[1:]) for one in combine(flat, deviation.reshape(flat.shape), correlation))
    below, above = mean - NORMAL * spread, mean + NORMAL * spread
    if disagree.any():
        below[disagree] = np.nanmin((x - NORMAL * deviation)[:, disagree], axis=0)
        above[disagree] = np.nanmax((x + NORMAL * deviation)[:, disagree], axis=0)
    return Fused(mean, below, above, used, consistency, disagree)


def _without(value: Array, deviation: Array, probe: int) -> float:
    """Return the probability of so large a disagreement among the other probes."""
    rest = np.arange(len(value)) != probe
    squared, freedom = _disagreement(value[rest][:, None], deviation[rest][:, None])
    return float(chi2.sf(squared[0], freedom[0])) if freedom[0] else 1.0


def at_times(series: Series, times: Array, max_gap: float | None = None) -> tuple[Array, Array, Array]:
    """A quantity at other times [N], in seconds: value, lower and upper, by linear interpolation between rows.

    They are NaN outside the series and between rows more than `max_gap` seconds apart, by default three times the usual
    step.
    """
    rows = series.measured
    known = series.times[rows]
    if not len(known):
        unknown = np.full(len(times), np.nan)
        return unknown, unknown, unknown
    if max_gap is None:
        max_gap = 3 * float(np.median(np.diff(known))) if len(known) > 1 else 0.0
    after = np.clip(np.searchsorted(known, times), 0, len(known) - 1)
    near = known[after] - known[np.maximum(after - 1, 0)] <= max_gap
    there = (known[after] == times) | ((times >= known[0]) & (times <= known[-1]) & near)
    # The mean of two rows' errors is narrower than either; the interval does not claim that.
    told = (np.interp(times, known, one[rows]) for one in (series.value, series.half_width))
    value, half = (np.where(there, one, np.nan) for one in told)
    return value, value - half, value + half


def _timeline(clocks: Sequence[Array]) -> Array:
    """The first probe's times, and of every other those at which no earlier probe has one."""
    line = np.unique(clocks[0])
    for clock in clocks[1:]:
        apart = float(np.median(np.diff(clock))) / 2 if len(clock) > 1 else 0.0
        right = np.searchsorted(line, clock)
        near = line[np.clip([right - 1, right], 0, len(line) - 1)]
        line = np.union1d(line, clock[np.abs(clock - near).min(axis=0) > apart])
    return line


def _one_track(table: pa.Table, number: int | None, where: str) -> pa.Table:
    """Return the rows of one target: a track by its number, or all where no two are seen at once."""
    tracks = table["track"].to_numpy()
    if number is not None:
        if number not in tracks:
            has = ", ".join(str(one) for one in np.unique(tracks)[:10])
            raise InputError(f"no track {number}", where=where, remedy=f"it has {has}")
        return table.filter(pa.array(tracks == number))
    times, seen = table["time"].to_numpy(), np.ones(len(table), bool)
    if "seen" in table.column_names:
        seen = table["seen"].fill_null(False).to_numpy(zero_copy_only=False)
    if len(np.unique(times[seen])) < seen.sum():
        raise InputError("holds several tracks at once", where=where, remedy="name the target's track of each table")
    # A target that left and returned elsewhere is a new track, while the old one coasts beside it.
    order = np.lexsort((tracks, seen, times))
    last = np.append(np.diff(times[order]) > 0, True)
    return table.take(np.sort(order[last]))


def fuse_tracks(
    tables: Sequence[pa.Table],
    places: Places | Sequence[tuple[float, float]],
    *,
    tracks: Sequence[int | None] | None = None,
    starts: Sequence[float] | None = None,
    correlation: float = 0.5,
    max_gap: float | None = None,
    quantities: Sequence[str] | None = None,
    names: Sequence[str] | None = None,
) -> Fusion:
    """Fuse tables of tracks of probes that watch the same target, with the first one's gaze and clock.

    Parameters
    ----------
    tables
        One of each probe.
    places
        Where the probes stand; or the offset to add to each probe's gaze to make it the first one's, in fractions of
        the field, for small fields and probes near each other.
    tracks
        Which track of each table is the target. Not needed where no table has two at once.
    starts
        When each table's time is 0, in seconds of one clock. Default: by the tables' UTC, or all equal where one has
        none.
    correlation
        As of `combine`.
    max_gap
        Seconds between two rows of a probe beyond which it counts as lost; default: three times its usual step.
    quantities
        What to fuse; default: all that every table has.
    names
        Of the tables, for messages.

    Raises
    ------
    InputError
        When there is one probe only, a table has no intervals, tables have no quantity or no time in common, or a
        number does not fit.
    """
    called = list(names or (f"probe {m + 1}" for m in range(len(tables))))
    if len(tables) < 2:
        remedy = "give the tables of two probes or more"
        raise InputError("a single probe cannot be fused", where=called[0] if called else "fuse", remedy=remedy)
    standing = _checked(places, len(tables))
    for where, given in (("starts", starts), ("tracks", tracks)):
        if given is not None and len(given) != len(tables):
            raise InputError(f"{len(given)} for {len(tables)} probes", where=where, remedy="give one for each probe")
    begun = _starts(tables, called) if starts is None else starts
    told = [set(quantities_in(one, quantities, where=name)) for one, name in zip(tables, called, strict=True)]
    common = [name for name in quantities_in(tables[0], quantities, where=called[0]) if name in set.intersection(*told)]
    if not common:
        raise InputError("no quantity is in every table", where=", ".join(called), remedy="track with the same model")
    if ("gaze_x" in common) != ("gaze_y" in common):
        raise InputError("gaze needs both gaze_x and gaze_y", where="quantities", remedy="name both, or neither")
    chosen = tracks or [None] * len(tables)
    rows = [_one_track(t, number, name) for t, number, name in zip(tables, chosen, called, strict=True)]
    clocks = [t["time"].to_numpy() + (start - begun[0]) for t, start in zip(rows, begun, strict=True)]
    first, last = max(float(one[0]) for one in clocks), min(float(one[-1]) for one in clocks)
    if first > last:
        spans = ", ".join(f"{c[0]:.3f} to {c[-1]:.3f} s" for c in clocks)
        raise InputError(f"the probes' times do not overlap ({spans})", where=", ".join(called), remedy="give starts")
    times = _timeline(clocks)
    at = [_estimates(t, clock, common, times, max_gap) for t, clock in zip(rows, clocks, strict=True)]
    moved = [_moved(one, common, standing, m) for m, one in enumerate(at)]
    fused = fuse(*np.stack(moved, axis=1), correlation=correlation)
    before = np.stack([np.isfinite(one[0]).any(axis=1) for one in moved], axis=1)
    used, dropped = tuple(fused.used.sum(axis=0).tolist()), int((before & ~fused.used).any(axis=1).sum())
    return Fusion(_table(fused, common, times, rows, clocks), used, dropped, int(fused.disagree.sum()))


def _starts(tables: Sequence[pa.Table], called: Sequence[str]) -> list[float]:
    """Return when each table's time is 0, in seconds from the first one's, by UTC; zeros where none has it."""
    dated = [
        table.filter(pc.is_valid(table["utc_ns"])) if "utc_ns" in table.column_names else table.slice(0, 0)  # type: ignore[attr-defined]
        for table in tables
    ]
    without = [name for name, one in zip(called, dated, strict=True) if not len(one)]
    if len(without) == len(tables):
        return [0.0] * len(tables)
    if without:
        remedy = "say by --start (starts=) how much later each further table's time 0 is"
        raise InputError("has no UTC, which others have", where=", ".join(without), remedy=remedy)
    known = [(one["utc_ns"][0].as_py(), one["time"][0].as_py()) for one in dated]
    # Nanoseconds since 1970 are integers: a float would lose some hundreds.
    utc, time = known[0]
    return [(other - utc) / 1e9 - (later - time) for other, later in known]


def _checked(places: Places | Sequence[tuple[float, float]], count: int) -> Places | Array:
    number = len(places.places) if isinstance(places, Places) else len(places)
    if number != count:
        raise InputError(f"{number} places for {count} probes", where="places", remedy="give one for each probe")
    offsets = np.zeros((count, 2)) if isinstance(places, Places) else np.asarray(places, dtype=np.float64)
    if offsets.shape != (count, 2) or not np.isfinite(offsets).all():
        raise InputError("offsets must be pairs of finite numbers", where="places", remedy="give x and y")
    return places if isinstance(places, Places) else offsets


def _estimates(table: pa.Table, clock: Array, names: Sequence[str], times: Array, max_gap: float | None) -> Array:
    """Return value, lower and upper [3, N, K] of one probe at the common times."""
    found = [[table[name + end].cast(pa.float64()).to_numpy(zero_copy_only=False) for end in ENDS] for name in names]
    return np.stack([at_times(Series(clock, *ends), times, max_gap) for ends in found], axis=-1)


def _moved(told: Array, names: Sequence[str], places: Places | Array, probe: int) -> Array:
    """Return estimates [3, N, K] with the gaze as the first probe sees it."""
    if "gaze_x" not in names or probe == 0:
        return told
    k = [names.index(name) for name in GAZE]
    gaze = told[:, :, k]
    if isinstance(places, Places):
        new = places.to_first(probe, gaze)
        half = np.abs(new[2] - new[1]) / 2
        # A roll turns the offset: its error is perpendicular to it.
        shape = places.field[1] / places.field[0]
        across = np.abs(new[0] - gaze[0])[:, ::-1] * np.array([shape, 1 / shape])
        half = np.hypot(half, NORMAL * places.roll_spread * across)
        new = np.stack([new[0], new[0] - half, new[0] + half])
    else:
        new = gaze + places[probe] - places[0]
    moved = told.copy()
    moved[:, :, k] = new
    return moved


def _table(
    fused: Fused, names: Sequence[str], times: Array, rows: Sequence[pa.Table], clocks: Sequence[Array]
) -> pa.Table:
    """Fused rows as a table of tracks; the place in the picture is that of the first probe that has one."""
    schema = track_schema(names)
    schema = schema.append(pa.field("probes", pa.float64())).append(pa.field("consistency", pa.float64()))
    kept = ("x", "y", "snr", "peak_x", "peak_y", "diameter", "active", "name", *MOMENT)
    spots: dict[float, Mapping[str, Any]] = {}
    for table, clock in zip(reversed(rows), reversed(clocks), strict=True):
        shown = table.select([name for name in kept if name in table.column_names]).to_pylist()
        spots.update(zip(clock.tolist(), shown, strict=True))
    columns: dict[str, Any] = {
        "frame": range(len(times)),
        "time": times,
        "track": [1] * len(times),
        "seen": fused.used.any(axis=1),
        "probes": fused.used.sum(axis=1, dtype=float),
        "consistency": fused.consistency,
    }
    for end, values in zip(ENDS, (fused.value, fused.lower, fused.upper), strict=True):
        columns |= {name + end: values[:, k] for k, name in enumerate(names)}
    told = (dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True))
    records = [plain({**spots.get(row["time"], {}), **row}, schema.names) for row in told]
    return pa.Table.from_pylist(records, schema=schema)
