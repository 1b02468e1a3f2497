"""Channels of numbers of a log in SI, as a map states them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.recording.logs.cfg import PlausibilityCfg
from concent_warp.recording.logs.log_map import ClockEntry, LogMap, NumberEntry
from concent_warp.recording.logs.readers.log import Episode, Images, Signal
from concent_warp.recording.logs.targets import Target
from concent_warp.recording.logs.units import SHARES, SI, TIMES, UNITS, contrary_unit, named_unit

UNSEEN = Signal("", np.zeros(0), np.zeros(0))
"""In place of a component that the log does not have."""
LATEST = 4.1e9
"""The year 2100 in seconds since 1970 [s]."""


@dataclass(frozen=True)
class Numbers:
    """One channel for the recording, before its time 0 is known."""

    target: Target
    source: str
    """Where it comes from, for messages."""
    where: str
    """Its place in the map."""
    time: np.ndarray
    """[s], shape (T,), on the log's clock."""
    value: np.ndarray
    """[SI], shape (T, n)."""
    unit: str | None
    """Unit of the log that the map states."""
    noise_std: float | None = None
    delay: float | None = None
    """Median of reception less time [s]; None where the log has one clock."""
    repeated: int = 0
    """Samples that were dropped since another one has their stamp."""
    empty: int = 0
    """Rows that were dropped since they are of other channels."""
    behind: int = 0
    """Samples that were behind a later one, and were put before it."""

    @property
    def label(self) -> str:
        """Kind and name in the recording."""
        return f"{'action' if self.target.command else 'measured'}/{self.target.name}"


def expanded(
    entries: Mapping[str, NumberEntry], known: Mapping[str, Target], episode: Episode, mapping: LogMap, kind: str
) -> dict[str, NumberEntry]:
    """Return entries without wildcards: those with a ``*`` in name and source become one for each channel that fits.

    Raises:
        RecordingError: A wildcard stands alone or fits nothing, or the scene lacks an actuator or sensor.
    """
    found = {name: entry for name, entry in entries.items() if "*" not in name}
    for name in found:
        if name not in known:
            what = "actuator" if kind == "action" else "sensor"
            raise RecordingError(
                f"the scene has no such {what}", where=mapping.where(kind, name),
                expected=f"one of {sorted(known)}" if known else f"a scene with named {what}s",
            )  # fmt: skip
    for name, entry in entries.items():
        if "*" not in name:
            continue
        source = entry.source[0] if len(entry.source) == 1 else ""
        if name.count("*") != 1 or source.count("*") != 1:
            raise RecordingError(
                "a wildcard has no counterpart", where=mapping.where(kind, name),
                expected='one * in the name and one in the source, as "*_position" and "state/*.pos"', found=source,
            )  # fmt: skip
        before, after = map(re.escape, source.split("*"))
        named = {
            name.replace("*", hit[1]): one
            for one in episode.signals
            if (hit := re.fullmatch(f"{before}([^/]+){after}", one))
        }
        fitting = {target: one for target, one in named.items() if target in known}
        if not fitting:
            raise RecordingError(
                "a wildcard fits nothing", where=mapping.where(kind, name), expected=f"one of {sorted(known)}",
                found=f"{sorted(named)[:12]} from {len(episode.signals)} channels",
            )  # fmt: skip
        found |= {t: replace(entry, source=(one,)) for t, one in fitting.items() if t not in found}
    return found


def converted(
    entry: NumberEntry, target: Target, episode: Episode, mapping: LogMap, cfg: PlausibilityCfg
) -> Numbers | None:
    """Return a channel in SI; None for a constant command, which has no times of its own.

    Raises:
        RecordingError: The log has no such channel, it has another size, or its unit is not one of the target's.
    """
    where = mapping.where("action" if target.command else "measured", target.name)
    if entry.constant is not None:
        if entry.source or not target.command:
            expected = "a constant command, or a source"
            raise RecordingError("constant is only for commands without a source", where=where, expected=expected)
        return None
    signals = _sources(entry, target, episode, where)
    clocks = [mapping.clock_of(signal.name) for signal in signals]
    first = signals[0]
    if entry.unit is None and entry.scale == 1:
        for signal in signals:
            _check_name(signal.name, target, where)
    if any(not np.array_equal(signal.time, first.time) for signal in signals[1:]):
        raise RecordingError(
            "the numbers of one channel have different times", where=where, expected="channels of one topic or feature",
            found=[signal.name for signal in signals],
        )  # fmt: skip
    raw = np.stack([signal.value for signal in signals], axis=1)
    filled = np.asarray(np.isfinite(raw).any(axis=1) | (not first.sparse))
    first, raw = first.only(filled), raw[filled]
    time, kept, repeated = clean_times(first, clocks[0], cfg)
    value = _in_si(raw[kept], entry, target, where)
    if target.command:
        finite = np.isfinite(value).all(axis=1)
        time, value = time[finite], value[finite]
    if not len(time) or np.isnan(value).all():
        raise RecordingError("the channel has no samples", where=where, found=first.name, fix="leave it out of the map")
    source = ", ".join(dict.fromkeys(signal.name for signal in signals))
    if len(signals) > 1 and len(entry.source) == 1:
        source = entry.source[0]
    delay = delay_of(first, clocks[0])
    empty, behind = int((~filled).sum()), int((_behind(times_of(first, clocks[0])) > 0).sum())
    return Numbers(target, source, where, time, value, entry.unit, entry.noise_std, delay, repeated, empty, behind)


def _check_name(name: str, target: Target, where: str) -> None:
    """Refuse a channel without a unit in the map whose name states one that is not of SI, or of another quantity."""
    si = SI[target.quantity]
    if unit := named_unit(name, target.quantity):
        other = f'unit = "{si}" if its values are in {si}' if si else "the unit that holds"
        raise RecordingError(
            f"its name states {unit}, and the map no unit", where=where, expected="a unit or a scale", found=name,
            fix=f'write unit = "{unit}" in the map, or {other}',
        )  # fmt: skip
    if unit := contrary_unit(name, target.quantity):
        raise RecordingError(
            f"its name states {unit}, which is no unit of {target.quantity}, and the map no unit", where=where,
            expected=f"a channel in {si}, or a scale", found=name,
            fix=f'map another channel, or write unit = "{si}" if its values are in {si}',
        )  # fmt: skip


def times_of(stream: Signal | Images, clock: ClockEntry) -> np.ndarray:
    """Return the times of a channel [s] by its clock, shape (T,).

    Raises:
        RecordingError: The stamps are in another unit than stated.
    """
    given = stream.received if clock.use == "received" and stream.received is not None else stream.time
    time = np.asarray(given, dtype=float)
    if clock.rate is not None:
        return time / clock.rate + clock.offset
    images = isinstance(stream, Images)
    if len(time) > 2 and ((np.diff(np.sort(time)) == 1).all() if images else stream.frames):
        other = "timestamps.csv" if images else "a column time in the table"
        fix = f'write [clock] "{stream.name}" = {{ rate = FRAMES_PER_SECOND }} in the map, or {other}'
        found = f"{np.nanmin(time):g} to {np.nanmax(time):g}"
        raise RecordingError("the stamps look like numbers of frames", where=stream.name, found=found, fix=fix)
    time = time * TIMES[clock.unit] + clock.offset
    middle = float(np.median(time)) if len(time) else 0.0
    if middle > LATEST:
        # Seconds since 1970 in a wrong unit: the one that leads to this century.
        guess = next((unit for unit, size in TIMES.items() if middle * size < LATEST), "ns")
        raise RecordingError(
            f"the stamps look like {guess}", where=stream.name, expected="seconds", found=f"{middle:.4g}",
            fix=f'write [clock] "{stream.name}" = {{ unit = "{guess}" }} in the map',
        )  # fmt: skip
    return time


def delay_of(stream: Signal | Images, clock: ClockEntry) -> float | None:
    """Return the median of reception less time [s]; None where the log does not tell one from the other."""
    if stream.received is None or clock.use == "received" or clock.rate is not None:
        return None
    return float(np.median(stream.received - (stream.time * TIMES[clock.unit] + clock.offset)))


def clean_times(stream: Signal | Images, clock: ClockEntry, cfg: PlausibilityCfg) -> tuple[np.ndarray, np.ndarray, int]:
    """Return increasing times [s], shape (n,), the rows that they are of, shape (n,) int, and how many were dropped.

    Of samples with one stamp the last is kept. Samples that are a few periods out of order are sorted.

    Raises:
        RecordingError: Too many stamps are repeated, they are in another unit, or the clock runs back.
    """
    time = times_of(stream, clock)
    _check_order(time, stream, clock, cfg)
    rows = np.argsort(time, kind="stable")
    rows = rows[np.isfinite(time[rows])]
    ordered = time[rows]
    last = np.append(ordered[1:] > ordered[:-1], True) if len(ordered) else np.zeros(0, bool)
    repeated = int(len(time) - last.sum())
    if repeated > cfg.max_repeated * len(time):
        fix = "mend the log"
        if stream.received is not None:
            fix += f', or take the times of reception: [clock] "{stream.name}" = {{ use = "received" }}'
        raise RecordingError(f"{repeated} of {len(time)} stamps are repeated or missing", where=stream.name, fix=fix)
    return ordered[last], rows[last], repeated


def _behind(time: np.ndarray) -> np.ndarray:
    """Return how far each stamp is behind the latest one before it [s], shape (T,); 0 where there is none."""
    known = np.where(np.isfinite(time), time, -np.inf)
    with np.errstate(invalid="ignore"):
        behind = np.maximum.accumulate(known) - time
    return np.where(np.isfinite(behind), behind, 0.0)


def _check_order(time: np.ndarray, stream: Signal | Images, clock: ClockEntry, cfg: PlausibilityCfg) -> None:
    """Refuse stamps [s], shape (T,), of a clock that was set back or started anew: sorted, they would interleave."""
    behind = _behind(time)
    if not behind.any():
        return
    steps = np.diff(time[np.isfinite(time)])
    period = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    late = np.flatnonzero(behind > cfg.max_back_step * period * (1 + 1e-6))
    if not len(late):
        return
    row = int(late[0])
    fix = "cut the log there into two, or sort its rows if only their order is wrong"
    if stream.received is not None and clock.use != "received":
        fix += f', or take the times of reception: [clock] "{stream.name}" = {{ use = "received" }}'
    raise RecordingError(
        f"time runs back by {behind[row]:.4g} s", where=stream.place(row),
        expected=f"stamps that increase, but for up to {cfg.max_back_step:g} periods of {period:.3g} s",
        found=f"{time[row]:.4f} s after {time[row] + behind[row]:.4f} s", fix=fix,
    )  # fmt: skip


def _sources(entry: NumberEntry, target: Target, episode: Episode, where: str) -> list[Signal]:
    """Return the signals of an entry, as many as the target has numbers."""
    if not entry.source:
        raise RecordingError("the entry has no source", where=where, fix="write source = ..., or constant = ...")
    signals: list[Signal] = []
    for source in entry.source:
        if not source:
            signals.append(UNSEEN)
            continue
        if not (found := episode.find(source)):
            known = sorted(episode.signals)
            near = [name for name in known if source.split("/")[0] in name] or known
            raise RecordingError(
                "the log has no such channel", where=where, found=repr(source),
                expected=f"one of {near[:20]}{' and more' if len(near) > 20 else ''}",
            )  # fmt: skip
        signals += found
    if len(signals) != target.size:
        listed = [signal.name for signal in signals[:12]]
        fix = "name the channels one by one: source = [...]"
        raise RecordingError(
            "wrong number of channels", where=where, expected=f"{target.size} for {target.name!r}",
            found=f"{len(signals)}: {listed}", fix=fix,
        )  # fmt: skip
    first = next(signal for signal in signals if signal is not UNSEEN)
    if target.quantity == "orientation":
        if UNSEEN in signals:
            raise RecordingError("a quaternion is whole or missing", where=where, found=list(entry.source))
        return _w_first(signals, entry.order)
    unseen = replace(first, value=np.full(len(first.value), np.nan))
    return [unseen if signal is UNSEEN else signal for signal in signals]


def _w_first(signals: Sequence[Signal], order: str) -> list[Signal]:
    """Return the components of a quaternion in the order w x y z, by the last letter of their names or as stated."""
    ends = [re.split(r"[^a-z]+", signal.name.lower())[-1][-1:] for signal in signals]
    if order:
        ends = list(order)
    if sorted(ends) == sorted("wxyz"):
        return [signals[ends.index(axis)] for axis in "wxyz"]
    return list(signals)


def _in_si(raw: np.ndarray, entry: NumberEntry, target: Target, where: str) -> np.ndarray:
    """Return values in SI of values of the log, shape (T, n)."""
    unit = entry.unit
    if unit is None:
        return entry.sign * entry.scale * raw + entry.offset
    if unit in SHARES:
        if target.range is None:
            fix = "give the joint a range in the scene, or use scale and offset"
            raise RecordingError(f"{unit} of {target.name!r}, which has no range", where=where, fix=fix)
        low, high = SHARES[unit]
        share = (entry.scale * raw - low) / (high - low)
        share = 1 - share if entry.sign < 0 else share
        return target.range[0] + share * (target.range[1] - target.range[0]) + entry.offset
    quantity, factor = UNITS[unit]
    if target.quantity not in (quantity, "any"):
        raise RecordingError(
            f"{target.name!r} has no unit {unit}", where=where, expected=f"a unit of {target.quantity}",
            found=f"one of {quantity}", fix=f"its unit in SI is {SI[target.quantity] or 'none'}",
        )  # fmt: skip
    return entry.sign * entry.scale * factor * raw + entry.offset
