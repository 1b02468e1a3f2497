"""Hidden effects where bodies touch: friction of several kinds, softness and rebound, adhesion, grip."""

from __future__ import annotations

from functools import partial

import mujoco
import numpy as np

from concent_warp.reality.hidden.hidden_effect import Builder, HiddenEffectOfRig
from concent_warp.reality.rigs.rig import Rig
from concent_warp.reality.sliding_friction import Coefficients, apply_sliding_friction, frictionless, normal_forces
from concent_warp.reality.world import HiddenEffect

FADE_RATE = 0.05
"""Turning speed below which torsional and rolling friction fade [rad/s]."""


def nominal_friction(rig: Rig) -> float:
    """Return the nominal coefficient of sliding friction of the surface [-]."""
    return float(rig.scene.model.geom(rig.surface).friction[0])


def with_friction(rig: Rig, name: str, coefficients: Coefficients) -> HiddenEffect:
    """Return the effect of other coefficients of sliding, which may depend on time and place.

    If Reality computes friction by its own formula, only the difference is added: friction is linear in the
    coefficients.
    """
    if rig.physics.force is None:
        geoms = (rig.surface, *(rig.scene.model.geom(g).name for g in body_geoms(rig)))
        edit = partial(frictionless, geoms=geoms)
        return HiddenEffect(name, edit=edit, force=apply_sliding_friction(coefficients, rig.body, rig.surface))
    mu = nominal_friction(rig)
    return HiddenEffect(name, force=apply_sliding_friction(lambda t, p: coefficients(t, p) - mu, rig.body, rig.surface))


def body_geoms(rig: Rig) -> np.ndarray:
    """Return the geoms of the rig's body, ids of shape (n,)."""
    return np.flatnonzero(rig.scene.model.geom_bodyid == rig.scene.model.body(rig.body).id)


def sliding_friction(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of another coefficient [-]."""
    effect = with_friction(rig, "sliding_friction", lambda _t, _p: np.array([magnitude, magnitude]))
    return HiddenEffectOfRig("sliding_friction", effect, {"coefficient": magnitude}, (rig.body,))


def anisotropic_friction(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of friction along the surface's y that is that along x times a ratio [-]."""
    mu = nominal_friction(rig) * np.array([1.0, magnitude])
    effect = with_friction(rig, "anisotropic_friction", lambda _t, _p: mu)
    return HiddenEffectOfRig("anisotropic_friction", effect, {"ratio": magnitude}, (rig.body,))


def turning_friction(rig: Rig, magnitude: float, *, rolling: bool) -> HiddenEffect:
    """Return a torque of `magnitude` [m] times the normal force against turning about the normal, or across it.

    Friction against rotation about the other axes is nominal. Both torques are computed here, not by MuJoCo's contacts,
    which have one cone for sliding and rotation and a smallest coefficient.
    """
    nominal = rig.scene.model.geom(rig.surface).friction[1:]
    about, across = (nominal[0], magnitude) if rolling else (magnitude, nominal[1])

    def edit(spec: mujoco.MjSpec) -> None:
        for geom in (spec.geom(rig.surface), *spec.body(rig.body).geoms):
            geom.condim = 3

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        body = model.body(rig.body).id
        normal = float(normal_forces(model, data, body, model.geom(rig.surface).id)[1].sum())
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
        for coefficient, part in ((about, [0, 0, 1]), (across, [1, 1, 0])):
            spin = velocity[:3] * part
            data.xfrc_applied[body, 3:] -= coefficient * normal * spin / np.hypot(np.linalg.norm(spin), FADE_RATE)

    return HiddenEffect("rolling_friction" if rolling else "torsional_friction", edit=edit, force=force)


def torsional_friction(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of another coefficient against spinning in place [m]."""
    effect = turning_friction(rig, magnitude, rolling=False)
    return HiddenEffectOfRig("torsional_friction", effect, {"coefficient": magnitude}, (rig.body,))


def rolling_friction(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of another coefficient against rolling [m]."""
    effect = turning_friction(rig, magnitude, rolling=True)
    return HiddenEffectOfRig("rolling_friction", effect, {"coefficient": magnitude}, (rig.body,))


def contact_compliance(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of another damping ratio [-] of the contact, and of a time constant that goes with its root."""
    nominal = rig.scene.model.geom(rig.surface).solref
    time_constant = float(nominal[0] * np.sqrt(magnitude / nominal[1]))

    def edit(spec: mujoco.MjSpec) -> None:
        for geom in (spec.geom(rig.surface), *spec.body(rig.body).geoms):
            geom.solref = [time_constant, magnitude]

    truth = {"time_constant": time_constant, "damping_ratio": magnitude}
    return HiddenEffectOfRig("contact_compliance", HiddenEffect("contact_compliance", edit=edit), truth, (rig.body,))


def adhesion(rig: Rig, magnitude: float, *, gap: float = 1e-3) -> HiddenEffectOfRig:
    """Return a force [N] that pulls each lower corner of a box to the surface while it is within a gap [m] of it."""
    half = rig.scene.model.geom_size[body_geoms(rig)[0]]
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        b, ground = model.body(rig.body).id, model.geom(rig.surface).id
        normal = data.geom_xmat[ground].reshape(3, 3)[:, 2]
        arm = (half * signs) @ data.xmat[b].reshape(3, 3).T
        height = (data.xpos[b] + arm - data.geom_xpos[ground]) @ normal
        for lever in arm[height < gap]:
            pull = -magnitude * normal
            data.xfrc_applied[b, :3] += pull
            data.xfrc_applied[b, 3:] += np.cross(data.xpos[b] + lever - data.xipos[b], pull)

    return HiddenEffectOfRig("adhesion", HiddenEffect("adhesion", force=force), {"force": magnitude}, (rig.body,))


def grip_force(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of a factor [-] on the gripper's stiffness, damping and limit."""

    def edit(spec: mujoco.MjSpec) -> None:
        for name in rig.grippers:
            actuator = spec.actuator(name)
            actuator.gainprm = magnitude * np.array(actuator.gainprm)
            actuator.biasprm = magnitude * np.array(actuator.biasprm)
            actuator.forcerange = magnitude * np.array(actuator.forcerange)

    return HiddenEffectOfRig("grip_force", HiddenEffect("grip_force", edit=edit), {"gain": magnitude}, rig.grippers)


def pad_friction(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of another friction coefficient of the pads on the grasped object [-]."""

    def edit(spec: mujoco.MjSpec) -> None:
        for name in rig.pads:
            geom = spec.geom(name)
            geom.friction = [magnitude, *np.array(geom.friction)[1:]]
            geom.priority = 2

    m = rig.scene.model
    fingers = tuple(m.body(m.geom(name).bodyid[0]).name for name in rig.pads)
    return HiddenEffectOfRig(
        "pad_friction", HiddenEffect("pad_friction", edit=edit), {"coefficient": magnitude}, fingers
    )


CONTACT: dict[str, Builder] = {
    f.__name__: f
    for f in (
        sliding_friction,
        anisotropic_friction,
        torsional_friction,
        rolling_friction,
        contact_compliance,
        adhesion,
        grip_force,
        pad_friction,
    )
}
