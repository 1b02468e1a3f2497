"""Hidden effects that the library lacks: cogging, a cable, a magnet, a rough patch, warming up, slosh, failures."""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.reality.hidden.contact import nominal_friction, with_friction
from concent_warp.reality.hidden.hidden_effect import Builder, HiddenEffectOfRig, drives, fixed_inertia
from concent_warp.reality.hidden.joints import Level, friction
from concent_warp.reality.rigs.rig import Rig
from concent_warp.reality.world import HiddenEffect

COGGING_RIPPLES = 14
"""Ripples of cogging a turn."""
COGGING_PITCH = 0.04
"""Ripples of a linear motor, one in this length [m]."""
CABLE_ANCHOR = np.array([-0.3, 0.4, 0.0])
"""Where the cable is fixed [m]."""
PATCH_POSITION = np.array([0.03, 0.02])
"""Place of the magnet and of the rough patch on the table [m]."""


def cogging(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return a torque that ripples with the angle, as magnets pass teeth [N m or N]."""
    pitch = 2 * np.pi / COGGING_PITCH if rig.slides else COGGING_RIPPLES

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        for d in drives(rig):
            joint = model.joint(d.joint)
            phase = pitch * data.qpos[joint.qposadr[0]]
            data.qfrc_applied[joint.dofadr[0]] += magnitude * d.weight * np.sin(phase)

    return HiddenEffectOfRig("cogging", HiddenEffect("cogging", force=force))


def cable(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the force of a cable [N/m] as long as the distance to the resting body: slack on one side, else taut."""
    rest = data_at_rest(rig)
    slack = np.linalg.norm(CABLE_ANCHOR - cable_end(rig, rest, rest.model.body(rig.body).id))

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        b = model.body(rig.body).id
        end = cable_end(rig, data, b)
        way = CABLE_ANCHOR - end
        length = np.linalg.norm(way)
        if length > slack:
            pull = magnitude * (length - slack) * way / length
            data.xfrc_applied[b, :3] += pull
            data.xfrc_applied[b, 3:] += np.cross(end - data.xipos[b], pull)

    return HiddenEffectOfRig("cable", HiddenEffect("cable", force=force))


def data_at_rest(rig: Rig) -> mujoco.MjData:
    """Return data of the nominal model in its initial state."""
    model = rig.scene.model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def cable_end(rig: Rig, data: mujoco.MjData, body: int) -> np.ndarray:
    """Return where a cable is tied [m], shape (3,): to a body that is tracked, or to the last site."""
    return data.xipos[body] if rig.body_tracked else data.site_xpos[-1]


def magnet(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the force of a magnet under the table that pulls the body sideways [N] when it is near."""
    reach = 0.05

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        b = model.body(rig.body).id
        way = PATCH_POSITION - data.xipos[b, :2]
        data.xfrc_applied[b, :2] += magnitude * way / reach * np.exp(0.5 - 0.5 * (way @ way) / reach**2)

    return HiddenEffectOfRig("magnet", HiddenEffect("magnet", force=force))


def patch(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of a place on the table where the coefficient of friction differs [-]."""
    mu, radius = nominal_friction(rig), 0.05

    def coefficients(time: float, point: np.ndarray) -> np.ndarray:
        del time
        rough = float(np.linalg.norm(point[:2] - PATCH_POSITION) < radius)
        return np.full(2, mu + magnitude * rough)

    return HiddenEffectOfRig("patch", with_friction(rig, "patch", coefficients))


def warming(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the friction of a cold drive [N m or N], which vanishes within a few seconds."""
    levels: dict[str, Level] = {
        d.joint: lambda _m, s, _i, w=d.weight: magnitude * w * float(np.exp(-max(s.time, 0.0) / 2.0))
        for d in drives(rig)
    }
    return HiddenEffectOfRig("warming", friction("warming", levels))


def dropout(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of drives that lose a share of their force [-] for 0.3 s, twice."""
    found = drives(rig)

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        if any(start <= data.time < start + 0.3 for start in (2.1, 5.3)):
            for d in found:
                data.qfrc_applied[model.joint(d.joint).dofadr[0]] -= magnitude * d.error_force(model, data)

    return HiddenEffectOfRig("dropout", HiddenEffect("dropout", force=force))


def slosh(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of a share of the body's mass [-] that swings in it on springs, at 3 Hz."""

    def edit(spec: mujoco.MjSpec) -> None:
        body = fixed_inertia(spec, rig.body)
        part = magnitude * body.mass
        body.mass -= part
        inner = body.add_body(name="slosh", pos=body.ipos)
        inner.explicitinertial = True
        inner.mass, inner.inertia = part, [1e-6 * part] * 3
        stiffness = part * (2 * np.pi * 3.0) ** 2
        for axis in ([1, 0, 0], [0, 1, 0]):
            inner.add_joint(
                type=mujoco.mjtJoint.mjJNT_SLIDE,
                axis=axis,
                stiffness=[stiffness, 0, 0],
                damping=[0.1 * np.sqrt(stiffness * part), 0, 0],
            )

    return HiddenEffectOfRig("slosh", HiddenEffect("slosh", edit=edit))


OUTSIDE: dict[str, Builder] = {f.__name__: f for f in (cogging, cable, magnet, patch, warming, dropout, slosh)}
