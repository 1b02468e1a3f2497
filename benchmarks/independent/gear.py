"""A gear between motor and link: a rotor with inertia behind a spring, which may have play.

The servo controls the rotor's angle r: J r'' = kp (u - r) - kv r' - T, with the torque T = K e + D e' on the link of
angle q, where e is the twist r - q beyond the play and T is 0 within it. Angles and inertia are those at the joint:
the motor's by the gear ratio and its square.
"""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.reality.hidden.hidden_effect import Drive, PerTrialState

SUBSTEPS = 4
"""Rotor steps in a step of the world."""


class Gear(PerTrialState):
    """The gear of one drive."""

    def __init__(self, drive: Drive, stiffness: float, damping_ratio: float, play: float = 0.0) -> None:
        """Take a spring's stiffness [N m/rad or N/m], its damping over the critical one [-], the play [rad or m]."""
        super().__init__()
        self.drive, self.stiffness, self.damping_ratio, self.half = drive, stiffness, damping_ratio, 0.5 * play
        self.inertia, self.kp, self.kv = 0.0, drive.kp, drive.kv
        self.angle, self.speed = 0.0, 0.0
        self.time: list[float] = []
        self.twist: list[float] = []
        """Rotor less link at the beginning of each step [rad or m]."""

    def edit(self, spec: mujoco.MjSpec) -> None:
        """Take rotor inertia and servo out of a world, and keep their values."""
        joint, actuator = spec.joint(self.drive.joint), spec.actuator(self.drive.actuator)
        self.inertia, self.kp, self.kv = joint.armature, actuator.gainprm[0], -actuator.biasprm[2]
        joint.armature = 0.0
        actuator.gainprm, actuator.biasprm = 0 * np.array(actuator.gainprm), 0 * np.array(actuator.biasprm)

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Add the torque on the link over this step to `qfrc_applied`."""
        joint = model.joint(self.drive.joint)
        dof = joint.dofadr[0]
        link, rate = float(data.qpos[joint.qposadr[0]]), float(data.qvel[dof])
        if self.step(data.time) is None:
            self.angle, self.speed, self.time, self.twist = link, rate, [], []
        self.time.append(float(data.time))
        self.twist.append(self.angle - link)
        command = float(data.ctrl[model.actuator(self.drive.actuator).id])
        data.qfrc_applied[dof] += self._turn(command, link, rate, model.opt.timestep)

    def _turn(self, command: float, link: float, rate: float, dt: float) -> float:
        """Return the mean torque on the link over a step, in which the rotor is moved on."""
        damping = 2 * self.damping_ratio * (self.stiffness * self.inertia) ** 0.5
        limit, part, total = self.drive.limit, dt / SUBSTEPS, 0.0
        for _ in range(SUBSTEPS):
            twist = self.angle - link
            beyond = twist - min(max(twist, -self.half), self.half)
            torque = 0.0
            if beyond or not self.half:
                torque = self.stiffness * beyond + damping * (self.speed - rate)
                if self.half and torque * beyond < 0:  # teeth do not pull
                    torque = 0.0
            servo = min(max(self.kp * (command - self.angle) - self.kv * self.speed, -limit), limit)
            self.speed += part * (servo - torque) / self.inertia
            self.angle += part * self.speed
            link += part * rate
            total += torque / SUBSTEPS
        return total
