"""Short windows of demonstrations, each simulated from the state that was measured at its start.

In chaotic motion, as in impacts and tumbling, an error of the initial state grows until the simulation carries no
information on the geometry. Windows of 0.1-0.3 s keep the prediction near the measurement (multiple shooting).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from concent_warp.checks import Count, Share
from concent_warp.errors import RecordingError
from concent_warp.estimation.object_tracks import BodyTarget, ObjectTrackCfg, Segment, whole_demonstration
from concent_warp.estimation.state_estimator import StateEstimator
from concent_warp.model import Model
from concent_warp.recording.recording import Demonstration
from concent_warp.scene.scene import Scene
from concent_warp.simulate.replay import commands


@dataclass(frozen=True)
class WindowCfg:
    """Settings of the choice of windows."""

    max_shift: Share = 0.25
    """How far a start may move to a time with less scatter, as a share of the stride [-]."""
    max_scatter: float = 10.0
    """Scatter of the readings over its median above which a start is left out [-]: it lies in an impact."""
    contact_share: Share = 0.75
    """Contact must begin within this share of a window, so that its outcome is observed [-]."""
    min_frames: Count = 3
    """Fewest observed frames of a body in a window [-]."""
    tracks: ObjectTrackCfg = field(default_factory=ObjectTrackCfg)
    """How observations become target points."""


def cut_windows(
    scene: Scene,
    demonstration: Demonstration,
    bodies: tuple[str, ...],
    length: float,
    stride: float | None = None,
    *,
    only_contact: bool = True,
    cfg: WindowCfg | None = None,
) -> list[Segment]:
    """Cut a demonstration into windows with initial states from the measurements.

    Args:
        scene: The scene.
        demonstration: What was commanded and measured.
        bodies: Bodies with contact geometry; those that move and were observed become targets.
        length: Length of a window [s].
        stride: Time from one start to the next [s]; by default the length, so that windows do not overlap. A start
            moves to the time nearby with the least scatter, because an impact has no velocity.
        only_contact: Leave out windows in which the bodies fly freely, which carry no information on the geometry;
            contact is found by the measured acceleration.
        cfg: Settings.

    Raises:
        RecordingError: A length is not right, nothing was observed, or the state in the middle was not measured.
    """
    cfg = cfg or WindowCfg()
    stride = length if stride is None else stride
    if not (0 < length < np.inf and 0 < stride < np.inf):
        raise RecordingError("windows: length and stride must be times", expected="> 0 s", found=(length, stride))
    full = whole_demonstration(scene, demonstration, bodies, cfg.tracks)
    measured = StateEstimator.of(Model(scene), demonstration)
    clock = np.unique(np.concatenate([t.time for t in full.targets]))
    scatter = measured.scatter(clock)
    free = {t.body for t in full.targets} & {b.name for b in measured.bodies}
    touching = measured.in_contact(sorted(free), clock) if free else np.ones(len(clock), dtype=bool)
    result = []
    for start in window_starts(clock, scatter, length, stride, cfg):
        within = (clock >= start) & (clock <= start + cfg.contact_share * length)
        if only_contact and not touching[within].any():
            continue
        if (segment := _cut_window(measured, demonstration, full, float(start), length, cfg.min_frames)) is not None:
            result.append(segment)
    return result


def window_starts(
    clock: np.ndarray, scatter: np.ndarray, length: float, stride: float, cfg: WindowCfg | None = None
) -> np.ndarray:
    """Return the starts of windows [s]: about a stride apart, each at the time nearby with the least scatter.

    Args:
        clock: Times at which a window may start [s], shape (T,).
        scatter: Scatter of the readings around each, over the median [-], shape (T,).
        length: Length of a window [s].
        stride: Time from one start to the next [s].
        cfg: Settings.

    Returns:
        Times, shape (W,).
    """
    cfg = cfg or WindowCfg()
    result = []
    last = float(clock[-1])
    shift = cfg.max_shift * stride
    for wish in np.arange(float(clock[0]), last - length + 1e-9 + shift, stride):
        near = np.flatnonzero((np.abs(clock - wish) <= shift + 1e-9) & (clock <= last - length + 1e-9))
        if len(near) and scatter[best := near[scatter[near].argmin()]] <= cfg.max_scatter:
            result.append(clock[best])
    return np.unique(result)


def _cut_window(
    measured: StateEstimator,
    demonstration: Demonstration,
    full: Segment,
    start: float,
    length: float,
    min_frames: int,
) -> Segment | None:
    """Return one window of a demonstration; None where too little was observed in it."""
    model = measured.compiled
    targets = []
    for target in full.targets:
        inside = (target.time > start + 1e-9) & (target.time <= start + length + 1e-9)
        if inside.sum() >= min_frames:
            targets.append(BodyTarget(target.body, target.anchor, target.time[inside] - start, target.points[inside]))
    if not targets:
        return None
    steps = int(np.ceil(length / model.opt.timestep - 1e-9))
    ctrl = commands(model, demonstration, steps, start)
    joints = {address: replace(channel, time=channel.time - start) for address, channel in full.joints.items()}
    state = measured.states(np.array([start]))
    return Segment(f"{full.name}@{start:.3f}", state.qpos[0], state.qvel[0], ctrl, tuple(targets), joints)


def mark_held_out(segments: Sequence[Sequence[Segment]], share: float) -> list[Segment]:
    """Mark a share of the windows to choose the best estimate and not move it; takes and returns all of them.

    Args:
        segments: Windows of each demonstration. Whole demonstrations are held out where there are enough of them for
            that, else single windows.
        share: Share to hold out; every 1/share-th is.
    """
    if share <= 0:
        return [replace(s, held_out=False) for group in segments for s in group]
    every = max(round(1 / share), 2)
    filled = [group for group in segments if group]
    flat = [(d, s) for d, group in enumerate(filled) for s in group]
    by_demonstration = len(filled) >= every
    return [replace(s, held_out=(d if by_demonstration else i) % every == every - 1) for i, (d, s) in enumerate(flat)]
