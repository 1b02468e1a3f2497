"""Hidden effects in joints: friction by a bristle model, damping, springs, rotor inertia, wrong support of the weight.

Friction follows Canudas de Wit, Olsson, Astrom, Lischinsky, "A new model for control of systems with friction", IEEE
Trans. Automatic Control 40(3), 1995 (LuGre): dz/dt = v - sigma |v| z / g(v), force sigma z + sigma_1 dz/dt. The
bristles are so stiff that a joint at rest gives by a tenth of a milliradian only.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import mujoco
import numpy as np

from concent_warp.reality.hidden.hidden_effect import Builder, HiddenEffectOfRig, PerTrialState, drives, true_values
from concent_warp.reality.rigs.rig import Rig
from concent_warp.reality.world import HiddenEffect

BRISTLE_DEFLECTION = {"hinge": 1e-4, "slide": 1e-5}
"""How far bristles give before they slip [rad], [m]."""
SPRING_REST = {"hinge": -0.3, "slide": -0.03}
"""Where hidden springs rest [rad], [m]."""
Level = Callable[[mujoco.MjModel, mujoco.MjData, int], float]
"""Given model, data and degree of freedom, returns the friction at steady sliding [N m or N]."""


class Bristles(PerTrialState):
    """Friction of one joint."""

    def __init__(self, joint: str, level: Level) -> None:
        super().__init__()
        self.joint, self.level = joint, level
        self.bend = 0.0

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Add the friction of this step."""
        if self.step(data.time) is None:
            self.bend = 0.0
        joint = model.joint(self.joint)
        dof = int(joint.dofadr[0])
        give = BRISTLE_DEFLECTION["slide" if joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE else "hinge"]
        speed, dt = float(data.qvel[dof]), model.opt.timestep
        level = max(self.level(model, data, dof), 1e-9)
        before = self.bend
        self.bend = give * np.sign(speed) + (before - give * np.sign(speed)) * np.exp(-abs(speed) * dt / give)
        stiffness = level / give
        inertia = float(model.dof_M0[dof])
        # Half of critical damping while the bristles bend; none when they slip.
        force = stiffness * self.bend + np.sqrt(stiffness * inertia) * (self.bend - before) / dt
        data.qfrc_applied[dof] -= np.clip(force, -2 * level, 2 * level)


def friction(name: str, levels: dict[str, Level]) -> HiddenEffect:
    """Return the effect of bristles in joints."""
    bristles = [Bristles(joint, level) for joint, level in levels.items()]

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        for bristle in bristles:
            bristle(model, data)

    return HiddenEffect(name, force=force)


def joint_friction(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return Coulomb friction [N m or N] of the strongest drive, less of weaker ones."""
    found = drives(rig)
    torque = np.array([magnitude * d.weight for d in found])
    levels: dict[str, Level] = {d.joint: lambda _m, _d, _i, t=t: t for d, t in zip(found, torque, strict=True)}
    joints = tuple(d.joint for d in found)
    return HiddenEffectOfRig(
        "joint_friction", friction("joint_friction", levels), true_values("torque", joints, torque), joints
    )


def stribeck_friction(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return friction [N m or N] at rest that fades with speed."""
    found = drives(rig)
    speed = 0.03 if rig.slides else 0.3
    extra = np.array([magnitude * d.weight for d in found])

    def level(model: mujoco.MjModel, data: mujoco.MjData, dof: int, *, top: float) -> float:
        # That of the step's middle: what falls with speed and lags behind it makes stick-slip of its own.
        middle = data.qvel[dof] + 0.5 * model.opt.timestep * data.qacc[dof]
        return top * float(np.exp(-((middle / speed) ** 2)))

    levels: dict[str, Level] = {d.joint: partial(level, top=t) for d, t in zip(found, extra, strict=True)}
    joints = tuple(d.joint for d in found)
    truth = {**true_values("extra", joints, extra), "speed": speed}
    return HiddenEffectOfRig("stribeck_friction", friction("stribeck_friction", levels), truth, joints)


def load_friction(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return friction by a coefficient [-] of the load between motor and link, the mean of both sides' torques."""
    joints = tuple(d.joint for d in drives(rig))

    def level(model: mujoco.MjModel, data: mujoco.MjData, dof: int) -> float:
        del model
        return magnitude * 0.5 * abs(data.qfrc_actuator[dof] + data.qfrc_bias[dof])

    truth = true_values("coefficient", joints, np.full(len(joints), magnitude))
    return HiddenEffectOfRig("load_friction", friction("load_friction", dict.fromkeys(joints, level)), truth, joints)


def joint_damping(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return viscous friction beyond the nominal one [N m s/rad or N s/m] of the strongest drive."""
    found = drives(rig)
    added = np.array([magnitude * d.weight for d in found])
    joints = tuple(d.joint for d in found)
    nominal = np.array([rig.scene.model.dof_damping[rig.scene.model.joint(j).dofadr[0]] for j in joints])

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        for joint, damping in zip(joints, added, strict=True):
            dof = model.joint(joint).dofadr[0]
            data.qfrc_applied[dof] -= damping * data.qvel[dof]

    truth = true_values("damping", joints, nominal + added)
    return HiddenEffectOfRig("joint_damping", HiddenEffect("joint_damping", force=force), truth, joints)


def joint_stiffness(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return springs of a stiffness [N m/rad or N/m] on the strongest drive, of less on weaker ones."""
    found = drives(rig)
    stiffness = np.array([magnitude * d.weight for d in found])
    joints = tuple(d.joint for d in found)
    slides = [rig.scene.model.joint(j).type[0] == mujoco.mjtJoint.mjJNT_SLIDE for j in joints]
    rest = np.array([SPRING_REST["slide" if slide else "hinge"] for slide in slides])

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        for name, spring, zero in zip(joints, stiffness, rest, strict=True):
            joint = model.joint(name)
            data.qfrc_applied[joint.dofadr[0]] -= spring * (data.qpos[joint.qposadr[0]] - zero)

    truth = {**true_values("stiffness", joints, stiffness), **true_values("preload", joints, stiffness * rest)}
    return HiddenEffectOfRig("joint_stiffness", HiddenEffect("joint_stiffness", force=force), truth, joints)


def armature(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return rotor inertia beyond the nominal one [kg m^2 or kg] of the strongest drive."""
    found = drives(rig)
    added = np.array([magnitude * d.weight for d in found])
    joints = tuple(d.joint for d in found)
    nominal = np.array([rig.scene.model.dof_armature[rig.scene.model.joint(j).dofadr[0]] for j in joints])

    def edit(spec: mujoco.MjSpec) -> None:
        for joint, inertia in zip(joints, added, strict=True):
            spec.joint(joint).armature += inertia

    return HiddenEffectOfRig(
        "armature", HiddenEffect("armature", edit=edit), true_values("inertia", joints, nominal + added), joints
    )


def gravity_compensation(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of a controller that holds up each link by a share [-] of its weight too much."""
    m = rig.scene.model
    free = {m.jnt_bodyid[j] for j in range(m.njnt) if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE}
    links = tuple(m.body(b).name for b in range(1, m.nbody) if b not in free and m.body_mass[b] > 0)
    links = tuple(name for name in links if m.body(name).dofnum[0] or m.body(name).parentid[0])

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        for link in links:
            body = model.body(link)
            data.xfrc_applied[body.id, 2] += magnitude * 9.81 * body.mass[0]

    effect = HiddenEffect("gravity_compensation", force=force)
    return HiddenEffectOfRig("gravity_compensation", effect, {"share": magnitude}, links)


JOINTS: dict[str, Builder] = {
    f.__name__: f
    for f in (
        joint_friction,
        stribeck_friction,
        load_friction,
        joint_damping,
        joint_stiffness,
        armature,
        gravity_compensation,
    )
}
