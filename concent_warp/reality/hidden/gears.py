"""Hidden effects between motor and link: backlash and compliance.

The servo drives a massless rotor of angle r against the transmitted torque T on the link of angle q: K (r - q) through
a spring; with backlash zero within the play, and at one of its ends the servo's torque, as long as it acts in that
direction. Within the play the rotor moves to the command u by kp (u - r) = kv dr/dt. The simulator's own servo is
switched off.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from concent_warp.reality.hidden.drives import actuator_names
from concent_warp.reality.hidden.hidden_effect import (
    Builder,
    Drive,
    HiddenEffectOfRig,
    PerTrialState,
    drives,
    true_values,
)
from concent_warp.reality.rigs.rig import Rig
from concent_warp.reality.world import HiddenEffect

ROTOR_SUBSTEPS = 20
"""Parts of a step in which a rotor crosses its play."""


class Rotor(PerTrialState):
    """The rotor of one drive."""

    def __init__(self, drive: Drive, column: int) -> None:
        super().__init__()
        self.drive, self.column = drive, column
        self.after = 0.0
        """Twist, that is rotor less link, after the last step [rad or m]."""
        self.share = 1.0
        """Of the drive's damping that the link feels [-]."""
        self.time: list[float] = []
        self.twist: list[float] = []
        """Twist at the beginning of each step."""

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Add what gets through to the link in this step."""
        joint = model.joint(self.drive.joint)
        q, rate = float(data.qpos[joint.qposadr[0]]), float(data.qvel[joint.dofadr[0]])
        if self.step(data.time) is None:
            self.after = 0.0
            self.time, self.twist = [], []
        self.time.append(data.time)
        self.twist.append(self.after)
        torque = self.turn(float(data.ctrl[self.column]), q, rate, model.opt.timestep)
        data.qfrc_applied[joint.dofadr[0]] += np.clip(torque, -self.drive.limit, self.drive.limit)

    def turn(self, command: float, q: float, rate: float, dt: float) -> float:
        """Return what gets through to the link over a step [N m or N], and set the twist after it."""
        raise NotImplementedError


class ElasticRotor(Rotor):
    """A rotor behind a spring; the servo takes the speed from the link, so that the rotor follows at once."""

    def __init__(self, drive: Drive, column: int, compliance: float) -> None:
        super().__init__(drive, column)
        self.stiffness = 1 / compliance
        self.share = 1 / (1 + drive.kp * compliance)

    def turn(self, command: float, q: float, rate: float, dt: float) -> float:
        """See `Rotor.turn`."""
        del dt
        d = self.drive
        self.twist[-1] = self.after = (d.kp * (command - q) - d.kv * rate) / (d.kp + self.stiffness)
        return self.stiffness * self.after


class BacklashRotor(Rotor):
    """A rotor with play."""

    def __init__(self, drive: Drive, column: int, play: float) -> None:
        super().__init__(drive, column)
        self.half = 0.5 * play

    def turn(self, command: float, q: float, rate: float, dt: float) -> float:
        """See `Rotor.turn`."""
        d, part = self.drive, dt / ROTOR_SUBSTEPS
        keep, through = np.exp(-d.kp * part / d.kv), 0.0
        link = q
        for _ in range(ROTOR_SUBSTEPS):
            alone = command + (link + self.after - command) * keep - (link + rate * part)
            link += rate * part
            self.after = min(max(alone, -self.half), self.half)
            torque = d.kp * (command - q - self.after) - d.kv * rate
            if abs(alone) > self.half and torque * self.after > 0:
                through += torque / ROTOR_SUBSTEPS
        return through


def with_rotors(rig: Rig, name: str, make: Callable[[Drive, int], Rotor], *, on_rotor: bool) -> HiddenEffect:
    """Return the effect of rotors in all drives; encoders read the rotor or the link."""
    m = rig.scene.model
    found = drives(rig)
    rotors = [make(d, m.actuator(d.actuator).id) for d in found]
    encoders: dict[str, Rotor] = {}
    for i in range(m.nsensor):
        if on_rotor and m.sensor_type[i] == mujoco.mjtSensor.mjSENS_JOINTPOS:
            joint = m.joint(m.sensor_objid[i]).name
            encoders |= {m.sensor(i).name: r for r in rotors if r.drive.joint == joint}

    def edit(spec: mujoco.MjSpec) -> None:
        for rotor in rotors:
            d = rotor.drive
            actuator, joint = spec.actuator(d.actuator), spec.joint(d.joint)
            actuator.gainprm, actuator.biasprm = 0 * np.array(actuator.gainprm), 0 * np.array(actuator.biasprm)
            # Damping at a step's beginning, not at its end as the simulator's servo has it, counts as less inertia.
            joint.armature += rotor.share * d.kv * spec.option.timestep
            joint.armature -= (1 - rotor.share) * rig.physics.armature.get(d.joint, 0.0)

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        for rotor in rotors:
            rotor(model, data)

    def measure(name: str, time: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if name not in encoders:
            return time, value
        rotor = encoders[name]
        return time, value + np.interp(time, rotor.time, rotor.twist)[:, None]

    return HiddenEffect(name, edit=edit, force=force, measure=measure)


def backlash(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return play of a full width [rad or m] between rotor and link; the encoder reads the link."""
    effect = with_rotors(rig, "backlash", lambda d, i: BacklashRotor(d, i, magnitude), on_rotor=False)
    return HiddenEffectOfRig("backlash", effect, {"play": magnitude}, actuator_names(drives(rig)))


def joint_compliance(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return a compliance [rad/(N m) or m/N] of the strongest drive's joint, more of others; encoders read rotors."""
    found = drives(rig)
    compliance = {d.actuator: magnitude / d.weight for d in found}
    effect = with_rotors(
        rig, "joint_compliance", lambda d, i: ElasticRotor(d, i, compliance[d.actuator]), on_rotor=True
    )
    truth = true_values("compliance", actuator_names(found), np.array(list(compliance.values())))
    return HiddenEffectOfRig("joint_compliance", effect, truth, actuator_names(found))


GEARS: dict[str, Builder] = {f.__name__: f for f in (backlash, joint_compliance)}
