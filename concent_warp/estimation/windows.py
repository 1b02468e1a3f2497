"""Short windows of demonstrations, each simulated from the state that was measured at its start.

Where motion is chaotic, as in impacts and tumbling, a small difference at the start grows until the simulation tells
nothing of the geometry. Windows of 0.1-0.3 s keep the prediction in touch with the measurement (multiple shooting).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.estimation.joint_motion import JointMotion, joint_motion
from concent_warp.estimation.local_polynomial import BodyMotion, body_motion
from concent_warp.estimation.object_tracks import BodyTarget, Segment, whole
from concent_warp.recording.recording import Demonstration
from concent_warp.scene.scene import Scene
from concent_warp.simulate.replay import commands

SHIFT = 0.25
"""How far a start may move to a calmer moment, as a share of the stride."""
ROUGH = 10.0
"""A window whose start scatters more than this many times as much as usual is left out: an impact lies there."""
SUPPORTED = 0.3
"""A body is in contact while its acceleration differs from free fall by more than this share of gravity, or of 1 g
where there is none."""
EARLY = 0.75
"""Contact must begin within this share of a window, so that something of its outcome is seen."""
FEWEST_FRAMES = 3
"""A window with fewer observed frames than this is left out."""


@dataclass(frozen=True)
class Measured:
    """How everything in a scene that can move was seen to move."""

    scene: Scene
    demonstration: Demonstration
    bodies: dict[str, BodyMotion]
    """Free bodies by name."""
    joints: JointMotion

    @staticmethod
    def of(scene: Scene, demonstration: Demonstration, qpos: np.ndarray) -> Measured:
        """Read off a demonstration that starts at `qpos` (nq,).

        Raises:
            RecordingError: The state of some joint or free body was not measured.
        """
        model = scene.model
        bodies = {}
        for joint in np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)):
            name = model.body(int(model.jnt_bodyid[joint])).name
            motion = body_motion(scene, demonstration, name, qpos)
            if motion is None:
                raise RecordingError(
                    "a window cannot start where a free body was not seen",
                    where=demonstration.name,
                    expected=f"points, or position and orientation sensors, of {name!r}",
                    fix="record them, or fit whole demonstrations",
                )
            bodies[name] = motion
        return Measured(scene, demonstration, bodies, joint_motion(model, demonstration))

    def state(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the state at a time [s], qpos (nq,) and qvel (nv,)."""
        model = self.scene.model
        qpos, qvel = model.qpos0.copy(), np.zeros(model.nv)
        for name, motion in self.bodies.items():
            joint = model.body(name).jntadr[0]
            place, speed = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
            qpos[place : place + 7], qvel[speed : speed + 6] = motion.state(time)
        position, velocity = self.joints.at(time)
        qpos[model.jnt_qposadr[self.joints.joints]] = position
        qvel[model.jnt_dofadr[self.joints.joints]] = velocity
        return qpos, qvel

    def roughness(self, time: np.ndarray) -> np.ndarray:
        """Return how much the samples around each time scatter about a smooth motion, relative to the median, (T,)."""
        signals = [s for motion in self.bodies.values() for s in (motion.position, motion.orientation)]
        signals += [signal for _, signal, _ in self.joints.readings]
        scatter = np.array([[signal.at(float(now)).scatter for now in time] for signal in signals])
        return (scatter / np.maximum(np.median(scatter, axis=1, keepdims=True), 1e-12)).max(axis=0)

    def supported(self, bodies: Sequence[str], time: np.ndarray) -> np.ndarray:
        """Return when any of some bodies was in contact, by its acceleration, shape (T,) bool."""
        gravity = self.scene.model.opt.gravity
        size = float(np.linalg.norm(gravity)) or 9.81
        result = np.zeros(len(time), dtype=bool)
        for name in bodies:
            estimates = [self.bodies[name].position.through(float(now)) for now in time]
            noise = float(np.median([e.second_error for e in estimates]))
            off = np.linalg.norm([e.second - gravity for e in estimates], axis=1)
            result |= off > max(SUPPORTED * size, 3 * noise)
        return result


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
    measured = Measured.of(scene, demonstration, full.qpos)
    clock = np.unique(np.concatenate([t.time for t in full.targets]))
    rough = measured.roughness(clock)
    free = tuple(t.body for t in full.targets if t.body in measured.bodies)
    touching = measured.supported(free, clock) if free else np.ones(len(clock), dtype=bool)
    result = []
    for start in calm_starts(clock, rough, length, stride):
        within = (clock >= start) & (clock <= start + EARLY * length)
        if only_contact and not touching[within].any():
            continue
        if (segment := _cut(measured, full, float(start), length)) is not None:
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


def _cut(measured: Measured, full: Segment, start: float, length: float) -> Segment | None:
    """Return one window of a demonstration; None where too little was observed in it."""
    model = measured.scene.model
    targets = []
    for target in full.targets:
        inside = (target.time > start + 1e-9) & (target.time <= start + length + 1e-9)
        if inside.sum() >= FEWEST_FRAMES:
            targets.append(BodyTarget(target.body, target.anchor, target.time[inside] - start, target.points[inside]))
    if not targets:
        return None
    steps = int(np.ceil(length / model.opt.timestep - 1e-9))
    ctrl = commands(model, measured.demonstration, steps, start)
    joints = {address: replace(channel, time=channel.time - start) for address, channel in full.joints.items()}
    return Segment(f"{full.name}@{start:.3f}", *measured.state(start), ctrl, tuple(targets), joints)


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
