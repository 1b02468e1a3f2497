"""The cutting of recordings into windows that a simulation can follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.estimation.noise import pooled_noise
from concent_warp.estimation.sensors import kind_and_unit
from concent_warp.fit.effects.guided_replay import GuidedReplay
from concent_warp.fit.effects.observation import ObservedRecording, Window, first_time, start_spread
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.fit.effects.prediction import turn
from concent_warp.fit.effects.scatter import touches, with_scatter
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.replay import commands
from concent_warp.simulate.select import EngineName, make_engine

if TYPE_CHECKING:
    from concent_warp.estimation.state_estimator import StateEstimator
    from concent_warp.model import Model
    from concent_warp.recording.recording import Demonstration, Recording


LEAST_FLIGHT = 3
"""Least time between two rebounds over `ObservationCfg.max_transient` [-]."""


def channel_noises(model: Model, recording: Recording, cfg: ObservationCfg | None = None) -> dict[str, float]:
    """Return the noise of each channel that the model's sensors predict, standard deviation of a component.

    Args:
        model: The model.
        recording: What was measured.
        cfg: Settings.

    Raises:
        RecordingError: A channel has another dimension than its sensor, or no channel can be compared at all.
    """
    cfg, m = cfg or ObservationCfg(), model.compile()
    found: dict[str, float] = {}
    names = dict.fromkeys(name for d in recording.demonstrations for name in d.measured)
    known = {m.sensor(i).name for i in range(m.nsensor)}
    for name in names:
        if name not in known:
            raise RecordingError(
                f"a measurement of a sensor {name!r} that the model lacks",
                where=recording.source,
                expected=f"one of {sorted(known)}",
            )
        row = m.sensor(name).id
        channels = [d.measured[name] for d in recording.demonstrations if name in d.measured]
        if any(c.value.shape[1] != m.sensor_dim[row] for c in channels):
            raise RecordingError(
                f"sensor {name!r} measures another number of values than the model's",
                where=recording.source,
                expected=int(m.sensor_dim[row]),
                found=[c.value.shape[1] for c in channels],
            )
        if sum(int(np.isfinite(c.value).any(axis=1).sum()) for c in channels) < 2:
            continue
        kind, unit = kind_and_unit(m, row)
        std = pooled_noise(channels, kind).std
        found[name] = std if np.isfinite(std) and std > 0 else cfg.noise_of_unit(unit)
    count = sum(
        int(np.isfinite(d.measured[name].value).sum())
        for name in found
        for d in recording.demonstrations
        if name in d.measured
    )
    if count < cfg.min_values:
        raise RecordingError(
            "too little was measured to compare a model with",
            where=recording.source,
            expected=f"at least {cfg.min_values} finite values in channels that the model's sensors predict",
            found=count,
        )
    return found


def observe(
    model: Model,
    recording: Recording,
    *,
    length: float | None = None,
    noise: Mapping[str, float] | None = None,
    engine: EngineName = "mujoco",
    seed: int = 0,
    cfg: ObservationCfg | None = None,
) -> list[Window]:
    """Return the windows of all demonstrations of a recording.

    Args:
        model: The model that is to follow them.
        recording: What was commanded and measured.
        length: Length of a window [s]; by default as long as the model's motion keeps close to where it started, with
            free bodies that can be touched at most `ObservationCfg.max_contact_length`.
        noise: Standard deviation of a component of each channel; by default stated or estimated.
        engine: Which engine simulates.
        seed: Seed of the disturbances from which the growth of differences is estimated.
        cfg: Settings.

    Raises:
        RecordingError: There is too little to compare.
    """
    cfg = cfg or ObservationCfg()
    source = ObservedRecording(model, recording, noise or channel_noises(model, recording, cfg), cfg)
    windows: list[Window] = []
    rough = has_touchable_free_body(model.compile())
    longest = cfg.max_contact_length if rough else cfg.max_length
    for number, d in enumerate(recording.demonstrations):
        channels = [c for c in source.noise if c in d.measured]
        last = max((float(d.measured[c].time[-1]) for c in channels), default=0.0)
        start = 0.0 if d.qpos is not None or d.action else first_time(d, channels)
        measured = source.measured(d) or (source.guided(d) if rough else None)
        most = np.inf
        while start < last - 1e-6:
            end = last
            if measured is not None:
                reach = length
                if reach is None:
                    found = proportional_span(source, d, start, min(last, start + longest), engine, seed)
                    # Once a replay has fallen from the balance, errors grow no more, and do not end the window.
                    most = min(most, cfg.balanced_factor * found.length) if found.unstable else most
                    reach = min(found.length, most)
                end = np.inf if last - start - reach < cfg.min_length else _calmest(measured, start, reach, cfg)
                end = end if last - end >= cfg.min_length else last
            if (window := source.window(number, start, end)) is not None:
                windows.append(window)
            start = end
    if not windows:
        raise RecordingError("nothing was measured that a model could be compared with", where=recording.source)
    if moves_untouched(model, windows, engine):
        return [replace(w, smooth=True) for w in windows]
    return with_scatter(model, windows, engine, cfg)


def moves_untouched(model: Model, windows: Sequence[Window], engine: EngineName) -> bool:
    """Return whether nothing touches anything in the model's motion from the estimated state of each window on.

    It is taken that something does where a body moves freely.
    """
    m = model.compile()
    if (m.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)).any():
        return False
    if not _can_touch(m):
        return True
    return all(touches(model, w, engine) is False for w in windows)


def _can_touch(m: mujoco.MjModel) -> bool:
    """Return whether something in a scene can touch, by the masks of its geoms or as a stated pair."""
    return bool(m.npair or (m.geom_contype | m.geom_conaffinity).any())


def _may_rebound(m: mujoco.MjModel) -> bool:
    """Return whether a body on joints may rebound and fly on: something can touch, and no drive presses it."""
    return _can_touch(m) and not m.nu


def has_touchable_free_body(m: mujoco.MjModel) -> bool:
    """Return whether a body moves freely in a scene in which something can touch."""
    return bool((m.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)).any()) and _can_touch(m)


def keeps_close(
    source: ObservedRecording, d: Demonstration, start: float, last: float, engine: EngineName, seed: int
) -> float:
    """Return the length of `proportional_span` [s]."""
    return proportional_span(source, d, start, last, engine, seed).length


class ProportionalSpan(NamedTuple):
    """For how long the effects of errors of an initial state stay in proportion to them, and small."""

    length: float
    """Duration [s]."""
    unstable: bool
    """Whether they have grown by too much at its end, as those of an unstable machine."""


def proportional_span(
    source: ObservedRecording, d: Demonstration, start: float, last: float, engine: EngineName, seed: int
) -> ProportionalSpan:
    """Return for how long the effects of errors of an initial state stay in proportion to them, and small."""
    cfg, m = source.cfg, source.model.compile()
    span = min(last - start, cfg.max_length)
    steps = max(int(np.ceil(span / m.opt.timestep)), 1)
    state = source.state(d, start)
    noise = {c: source.noise[c] for c in source.noise if c in d.measured}
    spread = start_spread(m, noise, cfg) / cfg.state_noise
    rng = np.random.default_rng(seed)
    offsets = [np.zeros(2 * m.nv)]
    for _ in range(cfg.probe_pairs):
        offset = rng.normal(size=2 * m.nv) * spread
        offsets += [offset, -offset]
    near, rough = len(offsets), has_touchable_free_body(m)
    # Smooth motion has no numerical scatter: what small offsets change there is in proportion to them.
    if rough:
        offsets += list(cfg.scatter_offset * cfg.state_noise * spread * rng.normal(size=(cfg.probe_pairs, 2 * m.nv)))
    positions, velocities = np.tile(state.qpos, (len(offsets), 1)), np.tile(state.qvel, (len(offsets), 1))
    for row, offset in enumerate(offsets):
        mujoco.mj_integratePos(m, positions[row], offset[: m.nv], 1.0)
        velocities[row] += offset[m.nv :]
    every = max(int(0.01 / m.opt.timestep), 1)
    record = np.arange(0, steps + 1, every)
    simulator = make_engine(engine, source.model.with_payloads(d.payloads))
    variants = Variants(len(offsets), qpos=positions, qvel=velocities)
    rollout = simulator.run(variants, commands(m, d, steps, start), record=record, bodies=[]).numpy()
    curved, grown = np.zeros((2, len(record)))
    for name, std in noise.items():
        row = m.sensor(name).id
        address, dim = m.sensor_adr[row], m.sensor_dim[row]
        value = rollout.sensordata[:, :, address : address + dim]
        away = np.stack([_away(value[0], one, turns=dim == 4) for one in value]) / std
        # inf - inf between two samples that diverge
        with np.errstate(invalid="ignore"):
            bend = np.quantile(_rms(away[1:near:2] + away[2:near:2]) / 2, 0.8, axis=0)
            scatter = np.sqrt((_rms(away[near:]) ** 2).mean(axis=0)) if rough else np.zeros(len(record))
        scatter = np.clip(np.nan_to_num(scatter), 0.0, cfg.max_scatter_noise)
        curved = np.maximum(curved, np.nan_to_num(bend / np.hypot(1.0, scatter), nan=np.inf))
        with np.errstate(invalid="ignore", over="ignore"):
            grown = np.maximum(grown, np.nan_to_num(np.sqrt((_rms(away[1:near]) ** 2).mean(axis=0)), nan=np.inf))
    passing = round(cfg.max_transient / (every * m.opt.timestep)) if _may_rebound(m) and not rough else 0
    end = _end_of_proportion(curved > cfg.max_curvature, passing)
    grown_end = None if rough else _end_of_stability(grown, cfg)
    unstable = grown_end is not None and (end is None or grown_end <= end)
    end = grown_end if unstable else end
    reach = span if end is None else float(record[end] * m.opt.timestep)
    return ProportionalSpan(float(np.clip(reach, cfg.min_length, span)), unstable)


def _end_of_stability(grown: np.ndarray, cfg: ObservationCfg) -> int | None:
    """Return where differences of the initial state have grown exponentially by too much, None where they never have.

    Those of a body that moves on without a force double over the second half of any time, those of one in a constant
    field quadruple; those of an unstable machine grow by a factor that itself grows.

    Args:
        grown: Differences over the noise, shape (T,), at equal distances in time from 0 on.
        cfg: Settings.
    """
    half = grown[(np.arange(len(grown)) + 1) // 2]
    too_large = (grown > cfg.max_growth * np.maximum(half, 1.0)) & (grown > cfg.least_growth)
    return int(np.argmax(too_large)) if too_large.any() else None


def _end_of_proportion(wild: np.ndarray, most: int) -> int | None:
    """Return where a window ends, by whether differences are out of proportion, shape (T,) bool; None at the end.

    A first run of these that is short is passed over, as of one rebound after which a body flies; midway between it and
    the next one the state is known best, before what follows of that. It is not where another short one begins soon:
    then contacts are made and broken. A long one is no contact, but differences that have grown since the rebound.

    Args:
        wild: Whether differences are out of proportion.
        most: Most values of a run that is passed over.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], wild, [False]]).astype(int)))
    runs = [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]
    if not runs:
        return None
    begin, end = runs[0]
    if end - begin > most or end == len(wild):
        return begin
    if len(runs) == 1:
        return None
    following, last = runs[1]
    broken = last - following <= most and following - end < LEAST_FLIGHT * most
    return begin if broken else (end + following) // 2


def _away(start: np.ndarray, end: np.ndarray, *, turns: bool) -> np.ndarray:
    """Return differences of readings (T, dim), rotation vectors (T, 3) where these are orientations."""
    return turn(start, end) if turns else end - start


def _rms(value: np.ndarray) -> np.ndarray:
    """Return the root mean square over the last axis."""
    return np.sqrt((value**2).mean(axis=-1))


def _calmest(measured: StateEstimator | GuidedReplay, start: float, reach: float, cfg: ObservationCfg) -> float:
    """Return the time at which a window ends [s]: late, and not in an impact, where velocities are unknown.

    Where a part of the motion was not measured, it is one at which replays tell it; infinite where there is none.
    """
    times = start + np.linspace(reach, 0.35 * reach, 27)
    if isinstance(measured, GuidedReplay):
        known = measured.is_known(times)
        if not known.any():
            later = measured.time[measured.time > start + reach]
            times, known = later, measured.is_known(later)
        if not known.any():
            return np.inf
        times = times[known]
    rough = measured.scatter_of_both_sides(times)
    calm = np.flatnonzero(rough < cfg.max_scatter)
    return float(times[calm[0] if len(calm) else rough.argmin()])
