"""Hidden effects in drives: commands late or smoothed, weak or limited motors, wrong zeros."""

from __future__ import annotations

from collections import deque

import mujoco
import numpy as np

from concent_warp.reality.hidden.hidden_effect import (
    Builder,
    Drive,
    HiddenEffectOfRig,
    PerTrialState,
    drives,
    true_values,
)
from concent_warp.reality.rigs.rig import Rig, perform
from concent_warp.reality.world import HiddenEffect


class CommandDelay(PerTrialState):
    """Commands pass through a queue and act after a delay; over a step, the mean of what acts in it."""

    def __init__(self, delay: float) -> None:
        super().__init__()
        self.delay = delay
        self.queue: deque[tuple[float, np.ndarray]] = deque()

    def __call__(self, now: float, ctrl: np.ndarray) -> np.ndarray:
        """Return what acts over the step that begins now."""
        elapsed = self.step(now)
        if elapsed is None:
            self.queue.clear()
            self.queue.append((-np.inf, ctrl.copy()))
        self.queue.append((now + self.delay, ctrl.copy()))
        while len(self.queue) > 1 and self.queue[1][0] <= now + 1e-9:
            self.queue.popleft()
        if elapsed is None:
            return self.queue[0][1]
        starts = [min(max((start - now) / elapsed, 0.0), 1.0) for start, _ in self.queue] + [1.0]
        return np.diff(starts) @ np.stack([value for _, value in self.queue])


class CommandLag(PerTrialState):
    """Set points follow the commands by dy/dt = (u - y) / time constant."""

    def __init__(self, time_constant: float) -> None:
        super().__init__()
        self.time_constant = time_constant
        self.y = np.zeros(0)

    def __call__(self, now: float, ctrl: np.ndarray) -> np.ndarray:
        """Return what acts over the step that begins now: the mean of the set point over it."""
        elapsed = self.step(now)
        if elapsed is None:
            self.y = ctrl.copy()
            return self.y
        before = self.y
        self.y = ctrl + (before - ctrl) * np.exp(-elapsed / self.time_constant)
        return ctrl + self.time_constant * (before - self.y) / elapsed


def arm_only(rig: Rig, hook: CommandDelay | CommandLag) -> HiddenEffect:
    """Return the effect of a hook on the commands of the arm; the gripper's pass."""
    columns = [rig.scene.model.actuator(d.actuator).id for d in drives(rig)]

    def command(now: float, ctrl: np.ndarray) -> np.ndarray:
        changed = ctrl.copy()
        changed[columns] = hook(now, ctrl)[columns]
        return changed

    return HiddenEffect(type(hook).__name__, command=command)


def actuator_delay(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of commands that act later [s]."""
    return HiddenEffectOfRig(
        "actuator_delay", arm_only(rig, CommandDelay(magnitude)), {"delay": magnitude}, actuator_names(drives(rig))
    )


def actuator_lag(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of set points that follow with a time constant [s]."""
    return HiddenEffectOfRig(
        "actuator_lag", arm_only(rig, CommandLag(magnitude)), {"time_constant": magnitude}, actuator_names(drives(rig))
    )


def actuator_gain(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of a factor [-] on the force of every drive."""
    found = drives(rig)

    def edit(spec: mujoco.MjSpec) -> None:
        for d in found:
            actuator = spec.actuator(d.actuator)
            actuator.gainprm = magnitude * np.array(actuator.gainprm)
            actuator.biasprm = magnitude * np.array(actuator.biasprm)
            # The armature that compensates the nominal time step is proportional to the damping.
            spec.joint(d.joint).armature += (magnitude - 1.0) * rig.physics.armature.get(d.joint, 0.0)

    truth = true_values("gain", actuator_names(found), np.full(len(found), magnitude))
    return HiddenEffectOfRig("actuator_gain", HiddenEffect("actuator_gain", edit=edit), truth, actuator_names(found))


def actuator_saturation(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of a limit [N m or N] of every drive."""
    found = drives(rig)

    def edit(spec: mujoco.MjSpec) -> None:
        for d in found:
            limit = min(magnitude, d.limit)
            spec.actuator(d.actuator).forcerange = [-limit, limit]

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        # At its limit a drive does not damp, so the armature that compensates the nominal time step is removed.
        for d in found:
            joint, command = model.joint(d.joint), data.ctrl[model.actuator(d.actuator).id]
            dof = joint.dofadr[0]
            if abs(d.kp * (command - data.qpos[joint.qposadr[0]]) - d.kv * data.qvel[dof]) > min(magnitude, d.limit):
                data.qfrc_applied[dof] += rig.physics.armature.get(d.joint, 0.0) * data.qacc[dof]

    effect = HiddenEffect("actuator_saturation", edit=edit, force=force)
    return HiddenEffectOfRig("actuator_saturation", effect, {"limit": magnitude}, actuator_names(found))


def peak_drive_force(rig: Rig, demonstrations: int, seed: int) -> float:
    """Return the force [N m or N] that the most loaded drive exceeds 1 % of the time, without hidden effects.

    Loads differ between motions and seeds; a limit that is observable on all of them is proportional to this.
    """
    model, seen = rig.world().compile(), []
    columns = [model.joint(d.joint).dofadr[0] for d in drives(rig)]
    watch = HiddenEffect("strain", force=lambda _model, data: seen.append(np.abs(data.qfrc_actuator[columns])))
    for k in range(demonstrations * rig.throws):
        perform(model, rig.plan(np.random.default_rng([seed, k]), k), [watch], rig.physics)
    return float(np.quantile(seen, 0.99, axis=0).max())


def joint_offset(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of true angles beyond those of encoder and drive [rad or m], in alternate directions."""
    found = drives(rig)
    m = rig.scene.model
    offset = magnitude * np.array([(-1.0) ** k for k in range(len(found))])
    columns = [m.actuator(d.actuator).id for d in found]
    sensors = {}
    for i in range(m.nsensor):
        if m.sensor_type[i] == mujoco.mjtSensor.mjSENS_JOINTPOS:
            joint = m.joint(m.sensor_objid[i]).name
            sensors[m.sensor(i).name] = next((o for d, o in zip(found, offset, strict=True) if d.joint == joint), 0.0)

    def command(now: float, ctrl: np.ndarray) -> np.ndarray:
        del now
        shifted = ctrl.copy()
        shifted[columns] += offset
        return shifted

    def measure(name: str, time: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return time, value - sensors.get(name, 0.0)

    joints = tuple(d.joint for d in found)
    effect = HiddenEffect("joint_offset", command=command, measure=measure)
    return HiddenEffectOfRig("joint_offset", effect, true_values("offset", joints, offset), joints)


def actuator_names(found: tuple[Drive, ...]) -> tuple[str, ...]:
    """Return the actuators of drives."""
    return tuple(d.actuator for d in found)


DRIVES: dict[str, Builder] = {
    f.__name__: f
    for f in (
        actuator_gain,
        actuator_saturation,
        actuator_delay,
        actuator_lag,
        joint_offset,
    )
}
