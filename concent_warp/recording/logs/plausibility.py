"""Checks that only an import can make: a log against itself, before its names and units are gone.

Degrees for radians, a wrong sign and stamps of two clocks. What a recording must fulfil anyway is in `validation`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.recording.logs.cfg import PlausibilityCfg
from concent_warp.recording.logs.numbers import Numbers
from concent_warp.recording.unwind import TURN, continued, wraps

DEGREE = math.pi / 180
COUNTS = 720.0
"""Whole numbers above this are counts of an encoder rather than angles in degrees."""


def check_numbers(channels: Sequence[Numbers], cfg: PlausibilityCfg) -> Iterator[RecordingError]:
    """Yield what is wrong with units and signs of joints."""
    suspects, channels = set(), [_continued(one) for one in channels]
    for one in channels:
        if one.target.position and (error := _degrees(one, cfg)):
            suspects.add(one.label)
            yield error
    positions = {c.target.joint: c for c in channels if c.target.position and not c.target.command}
    for one in channels:
        beside = positions.get(one.target.joint)
        if beside is None or one.label in suspects or beside.label in suspects:
            continue
        if one.target.position and one.target.command and (error := _against_command(beside, one, cfg)):
            yield error
        if one.target.velocity and (error := _against_speed(beside, one, cfg)):
            yield error


def check_delays(delays: Mapping[str, float | None], cfg: PlausibilityCfg) -> RecordingError | None:
    """Return what is wrong with the stamps of channels: two clocks that differ.

    Args:
        delays: Median of reception less time [s] by channel; None where its times are those of reception.
        cfg: Thresholds.
    """
    if all(one is None for one in delays.values()):
        return None
    known = {name: one or 0.0 for name, one in delays.items()}
    early, late = min(known, key=lambda n: known[n]), max(known, key=lambda n: known[n])
    apart = known[late] - known[early]
    if apart <= cfg.max_clock_difference:
        return None
    return RecordingError(
        "the stamps are of two clocks that are not synchronised", where=late,
        expected=f"about the delay of {early}, {known[early]:.3g} s from stamp to reception",
        found=f"{known[late]:.3g} s",
        fix="take the times of reception, [clock] NAME = { use = \"received\" }, or state the offset of one of them",
    )  # fmt: skip


def check_overlap(times: Mapping[str, np.ndarray]) -> RecordingError | None:
    """Return what is wrong where a channel ends before the others begin, or begins after they end."""
    many = {name: (time[0], time[-1]) for name, time in times.items() if len(time) > 1}
    for name, (start, stop) in many.items():
        others = [span for other, span in many.items() if other != name]
        if not others:
            return None
        first, last = min(span[0] for span in others), max(span[1] for span in others)
        if start > last or stop < first:
            return RecordingError(
                "its clock does not overlap with those of the other channels", where=name,
                expected=f"times from {first:.3f} to {last:.3f} s", found=f"{start:.3f} to {stop:.3f} s",
                fix="set its unit or offset in [clock], or take the times of reception with use = \"received\"",
            )  # fmt: skip
    return None


def _continued(one: Numbers) -> Numbers:
    """Return the angles of a joint without the jumps of an instrument that begins anew after each turn."""
    target, value = one.target, one.value[:, 0]
    narrow = target.range is not None and target.range[1] - target.range[0] < TURN
    if not target.position or target.quantity != "angle" or narrow or not wraps(one.time, value, TURN):
        return one
    return replace(one, value=continued(value)[:, None])


def _degrees(one: Numbers, cfg: PlausibilityCfg) -> RecordingError | None:
    """Return what is wrong with the positions of a hinge: outside of the range, or faster than a joint is."""
    if one.target.quantity != "angle":
        return None
    value = one.value[:, 0]
    fix = (
        'write unit = "deg" in the map, or check its scale'
        if one.unit is None
        else f"check unit = {one.unit!r}, scale and offset"
    )
    counts = one.unit is None and _are_counts(value)
    if counts:
        fix = 'if these are counts of an encoder, write unit = "turn" and scale = 1 / (counts a turn) in the map'
    if one.target.range is not None:
        low, high = one.target.range[0] - cfg.range_margin, one.target.range[1] + cfg.range_margin
        known = value[np.isfinite(value)]
        outside = float(np.mean((known < low) | (known > high)))
        if outside > cfg.outside_share:
            inside = float(np.mean((known * DEGREE >= low) & (known * DEGREE <= high)))
            degrees = inside > 1 - cfg.outside_share and np.abs(known).max() > math.pi
            otherwise = fix if counts else "check unit, sign and offset in the map, or the range in the scene"
            return RecordingError(
                "its values look like degrees" if degrees else "its values are outside the range of the joint",
                where=one.where, expected=f"{one.target.range[0]:.3g} to {one.target.range[1]:.3g} rad of "
                f"{one.target.joint or one.target.name!r}",
                found=f"{known.min():.4g} to {known.max():.4g} from {one.source}",
                fix=fix if degrees else otherwise,
            )  # fmt: skip
    speed = _speed(one.time, value)
    if not one.target.command and len(speed) and (fast := float(np.quantile(speed, 0.95))) > cfg.max_joint_speed:
        degrees = fast * DEGREE <= cfg.max_joint_speed
        what = "its speeds look like degrees" if degrees else "its speeds are those of no joint"
        return RecordingError(
            what, where=one.where, expected=f"at most {cfg.max_joint_speed:g} rad/s",
            found=f"{fast:.4g} rad/s from {one.source}", fix=f"{fix}, or check the unit of its clock",
        )  # fmt: skip
    return None


def _are_counts(value: np.ndarray) -> bool:
    """Return whether angles (T,), as they are in the log, are whole numbers beyond two turns in degrees."""
    known = value[np.isfinite(value)]
    return bool(len(known) and (known == np.round(known)).all() and np.abs(known).max() > COUNTS)


def _against_command(measured: Numbers, command: Numbers, cfg: PlausibilityCfg) -> RecordingError | None:
    """Return what is wrong where a joint does not follow its servo's command: sign or unit."""
    row = np.searchsorted(command.time, measured.time, side="right") - 1
    seen = (row >= 0) & np.isfinite(measured.value[:, 0])
    if seen.sum() < 10:
        return None
    moved, asked = measured.value[seen, 0], command.value[row[seen], 0]
    error = _unit_ratio(measured, command, float(moved.std()), float(asked.std()), cfg)
    if error or min(moved.std(), asked.std()) < cfg.min_motion:
        return error
    correlation = float(np.corrcoef(moved, asked)[0, 1])
    if correlation < -cfg.min_correlation:
        return RecordingError(
            "the joint moves against its command", where=measured.where, expected=f"the sign of {command.label}",
            found=f"correlation {correlation:.2f} of {measured.source} with {command.source}",
            fix="write sign = -1 for one of them",
        )  # fmt: skip
    return None


def _against_speed(position: Numbers, speed: Numbers, cfg: PlausibilityCfg) -> RecordingError | None:
    """Return what is wrong where the velocity of a joint is not the slope of its position."""
    kept = np.isfinite(position.value[:, 0])
    if kept.sum() < 10:
        return None
    time = position.time[kept]
    slope = np.gradient(position.value[kept, 0], time)
    seen = (speed.time >= time[0]) & (speed.time <= time[-1]) & np.isfinite(speed.value[:, 0])
    there, measured = np.interp(speed.time[seen], time, slope), speed.value[seen, 0]
    if seen.sum() < 10 or np.std(position.value[kept, 0]) < cfg.min_motion:
        return None
    if error := _unit_ratio(speed, position, float(measured.std()), float(there.std()), cfg):
        return error
    if measured.std() > 0 and there.std() > 0 and np.corrcoef(measured, there)[0, 1] < -cfg.min_correlation:
        return RecordingError(
            "the velocity of the joint has the other sign than the change of its position", where=speed.where,
            found=f"{speed.source} beside {position.source}", fix="write sign = -1 for one of them",
        )  # fmt: skip
    return None


def _unit_ratio(
    one: Numbers, other: Numbers, of_one: float, of_other: float, cfg: PlausibilityCfg
) -> RecordingError | None:
    """Return what is wrong where two motions of one joint differ as degrees and radians, or mm and m, do."""
    quantities = {one.target.quantity, other.target.quantity}
    if min(of_one, of_other) <= 0 or not quantities & {"angle", "length"}:
        return None
    (low, high), words, least = (
        (cfg.unit_ratio, "degrees beside radians", 0.0)
        if "angle" in quantities
        else (cfg.length_ratio, "millimetres beside metres", cfg.min_slide)
    )
    ratio = of_one / of_other
    if min(of_one, of_other) < least:
        return None
    if max(of_one, of_other) < cfg.min_motion or not (low < ratio < high or low < 1 / ratio < high):
        return None
    large, small = (one, other) if ratio > 1 else (other, one)
    return RecordingError(
        f"it moves as much as {words}", where=large.where,
        expected=f"the motion of {small.label}, {min(of_one, of_other):.3g} (standard deviation)",
        found=f"{max(of_one, of_other):.3g}, {max(ratio, 1 / ratio):.1f} times as much",
        fix=f"check the units of {large.source} and {small.source}",
    )  # fmt: skip


def _speed(time: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return the speeds between samples, missing ones left out."""
    kept = np.isfinite(value)
    return np.abs(np.diff(value[kept]) / np.diff(time[kept])) if kept.sum() > 1 else np.zeros(0)
