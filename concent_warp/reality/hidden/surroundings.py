"""Hidden effects of the surroundings: a table that is not level, air.

Air: quadratic drag 0.5 rho C A |v - w| (v - w) of the body's velocity against the wind, A its projected area, and
the lift 0.5 rho V omega x v of a spinning body (the coefficient of Auton, J. Fluid Mech. 183, 1987).
"""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.reality.hidden.hidden_effect import Builder, HiddenEffectOfRig
from concent_warp.reality.rigs.rig import Rig
from concent_warp.reality.world import HiddenEffect

AIR_DENSITY = 1.2
"""Density of air times a drag factor of 1 [kg/m^3]."""


def gravity_tilt(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return a tilt of the table against gravity: about x [rad], and by -0.6 of it about y."""
    turn = magnitude * np.array([1.0, -0.6, 0.0])
    down = np.array(rig.scene.model.opt.gravity)
    angle = float(np.linalg.norm(turn))
    axis = turn / angle
    # Rodrigues' formula.
    turned = down * np.cos(angle) + np.cross(axis, down) * np.sin(angle) + axis * (axis @ down) * (1 - np.cos(angle))

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        compensated = 1 - model.body_gravcomp
        data.xfrc_applied[1:, :3] += (model.body_mass * compensated)[1:, None] * (turned - down)

    truth = {"x": float(turn[0]), "y": float(turn[1])}
    return HiddenEffectOfRig("gravity_tilt", HiddenEffect("gravity_tilt", force=force), truth)


def air(density: float, wind: np.ndarray, body: str) -> HiddenEffect:
    """Return the effect of air of a density times drag factor [kg/m^3] that moves with `wind` (3,) [m/s]."""

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        b = model.body(body).id
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, b, velocity, 0)
        against = velocity[3:] - wind
        area, volume = shadow(model, b, data.xmat[b].reshape(3, 3).T @ against)
        data.xfrc_applied[b, :3] -= 0.5 * density * area * np.linalg.norm(against) * against
        data.xfrc_applied[b, :3] += 0.5 * density * volume * np.cross(velocity[:3], against)

    return HiddenEffect("air", force=force)


def shadow(model: mujoco.MjModel, body: int, direction: np.ndarray) -> tuple[float, float]:
    """Return the area [m^2] that a body's only geom shows along a direction (3,), body frame, and its volume [m^3].

    Raises:
        ValueError: It is neither a sphere nor a box.
    """
    geom = int(model.body_geomadr[body])
    size, kind = model.geom_size[geom], int(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return float(np.pi * size[0] ** 2), float(4 / 3 * np.pi * size[0] ** 3)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        faces = 4 * np.array([size[1] * size[2], size[2] * size[0], size[0] * size[1]])
        unit = np.abs(direction) / max(float(np.linalg.norm(direction)), 1e-9)
        return float(faces @ unit), float(8 * size.prod())
    raise ValueError(f"no shadow of geom {model.geom(geom).name!r}")


def air_drag(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the drag of still air of a density times drag factor [kg/m^3]."""
    return HiddenEffectOfRig("air_drag", air(magnitude, np.zeros(3), rig.body), {"density": magnitude}, (rig.body,))


def wind(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the drag of wind [m/s] along -x, and half as much along y; a drag factor of 1."""
    velocity = magnitude * np.array([-1.0, 0.5, 0.0])
    truth = dict(zip("xyz", map(float, velocity), strict=True))
    return HiddenEffectOfRig("wind", air(AIR_DENSITY, velocity, rig.body), truth, (rig.body,))


WORLD: dict[str, Builder] = {f.__name__: f for f in (gravity_tilt, air_drag, wind)}
