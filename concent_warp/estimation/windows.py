"""Short windows of demonstrations, each simulated from the state that was measured at its start.

Where motion is chaotic, as in impacts and tumbling, a small difference at the start grows until the simulation tells
nothing of the geometry. Windows of 0.1-0.3 s keep the prediction in touch with the measurement (multiple shooting).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.estimation.object_tracks import BodyTarget, Segment, whole
from concent_warp.estimation.state_estimator import StateEstimator
from concent_warp.model import Model
from concent_warp.recording.recording import Demonstration
from concent_warp.scene.scene import Scene
from concent_warp.simulate.replay import commands

SHIFT = 0.25
"""How far a start may move to a calmer moment, as a share of the stride."""
ROUGH = 10.0
"""A window whose start scatters more than this many times as much as usual is left out: an impact lies there."""
EARLY = 0.75
"""Contact must begin within this share of a window, so that something of its outcome is seen."""
FEWEST_FRAMES = 3
"""A window with fewer observed frames than this is left out."""


def windows(
    scene: Scene,
    demonstration: Demonstration,
    bodies: tuple[str, ...],
    length: float,
    stride: float | None = None,
    *,
    only_contact: bool = True,
) -> list[Segment]:
    """Cut a demonstration into windows with initial states from the measurements.

    Args:
        scene: The scene.
        demonstration: What was commanded and measured.
        bodies: Bodies with contact geometry; those that move and were observed become targets.
        length: Length of a window [s].
        stride: Time from one start to the next [s]; by default the length, so that windows do not overlap. A start
            moves to the calmest moment nearby, because a velocity is not to be had in the middle of an impact.
        only_contact: Leave out windows in which the bodies fly freely: these say nothing of the geometry. That is
            told by the measured acceleration, not by any geometry.

    Raises:
        RecordingError: A length is not right, nothing was observed, or the state in the middle was not measured.
    """
    stride = length if stride is None else stride
    if not (0 < length < np.inf and 0 < stride < np.inf):
        raise RecordingError("windows: length and stride must be times", expected="> 0 s", found=(length, stride))
    full = whole(scene, demonstration, bodies)
    measured = StateEstimator.of(Model(scene), demonstration)
    clock = np.unique(np.concatenate([t.time for t in full.targets]))
    rough = measured.scatter(clock)
    free = {t.body for t in full.targets} & {b.name for b in measured.bodies}
    touching = measured.in_contact(sorted(free), clock) if free else np.ones(len(clock), dtype=bool)
    result = []
    for start in calm_starts(clock, rough, length, stride):
        within = (clock >= start) & (clock <= start + EARLY * length)
        if only_contact and not touching[within].any():
            continue
        if (segment := _cut(measured, demonstration, full, float(start), length)) is not None:
            result.append(segment)
    return result


def calm_starts(clock: np.ndarray, rough: np.ndarray, length: float, stride: float) -> np.ndarray:
    """Return the starts of the windows [s]: about a stride apart, each at the calmest of the times nearby."""
    result = []
    last = float(clock[-1])
    for wish in np.arange(float(clock[0]), last - length + 1e-9 + SHIFT * stride, stride):
        near = np.flatnonzero((np.abs(clock - wish) <= SHIFT * stride + 1e-9) & (clock <= last - length + 1e-9))
        if len(near) and rough[best := near[rough[near].argmin()]] <= ROUGH:
            result.append(clock[best])
    return np.unique(result)


def _cut(
    measured: StateEstimator, demonstration: Demonstration, full: Segment, start: float, length: float
) -> Segment | None:
    """Return one window of a demonstration; None where too little was observed in it."""
    model = measured.compiled
    targets = []
    for target in full.targets:
        inside = (target.time > start + 1e-9) & (target.time <= start + length + 1e-9)
        if inside.sum() >= FEWEST_FRAMES:
            targets.append(BodyTarget(target.body, target.anchor, target.time[inside] - start, target.points[inside]))
    if not targets:
        return None
    steps = int(np.ceil(length / model.opt.timestep - 1e-9))
    ctrl = commands(model, demonstration, steps, start)
    joints = {address: replace(channel, time=channel.time - start) for address, channel in full.joints.items()}
    state = measured.states(np.array([start]))
    return Segment(f"{full.name}@{start:.3f}", state.qpos[0], state.qvel[0], ctrl, tuple(targets), joints)


def hold_out(segments: Sequence[Sequence[Segment]], share: float) -> list[Segment]:
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
