"""Sliding friction as a force of its own at each contact point, by the textbook's law rather than the simulator's.

MuJoCo's contacts of the two bodies are made frictionless; what rubs is computed here from the normal forces N of the
step before and the velocity v at each point: f = -N (mu_x v_x, mu_y v_y) / |v|, Coulomb's law with a tensor of friction
where a surface has a grain (Zmitrowicz, "A theoretical model of anisotropic dry friction", Wear 73(1), 1981). Below a
creep speed it fades, so that a body comes to rest within microns; it does not hold a body on a slope.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import mujoco
import numpy as np

CREEP = 2e-3
"""Speed below which friction fades [m/s]; the step must be short against CREEP / (mu g)."""
Coefficients = Callable[[float, np.ndarray], np.ndarray]
"""Given time [s] and a point [m], world frame, returns the coefficients along the world's x and y (2,) [-]."""


def frictionless(spec: mujoco.MjSpec, *geoms: str) -> None:
    """Take the simulator's own friction from geoms."""
    for name in geoms:
        spec.geom(name).condim = 1
        spec.geom(name).friction = [1e-6, 1e-6, 1e-6]


def normal_forces(
    model: mujoco.MjModel, data: mujoco.MjData, body: str, surface: str
) -> Iterator[tuple[np.ndarray, float]]:
    """Yield place [m], world frame, and normal force [N] of each contact of a body with a geom, of the step before."""
    b, ground = model.body(body).id, model.geom(surface).id
    wrench = np.zeros(6)
    for i in range(data.ncon):
        contact = data.contact[i]
        pair = contact.geom
        if contact.efc_address < 0 or ground not in pair:
            continue
        other = pair[0] if pair[1] == ground else pair[1]
        if model.geom_bodyid[other] == b:
            mujoco.mj_contactForce(model, data, i, wrench)
            yield contact.pos, float(wrench[0])


def rub(
    coefficients: Coefficients, body: str, surface: str, share: float = 1.0
) -> Callable[[mujoco.MjModel, mujoco.MjData], None]:
    """Return the force hook of a body that slides on a level, fixed geom; a share of -1 takes friction back."""

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        b = model.body(body).id
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, b, velocity, 0)
        for place, normal in normal_forces(model, data, body, surface):
            arm = place - data.xipos[b]
            slip = (velocity[3:] + np.cross(velocity[:3], arm))[:2]
            mu = coefficients(data.time, place)
            along = -share * normal * mu * slip / np.hypot(np.linalg.norm(slip), CREEP)
            push = np.array([*along, 0.0])
            data.xfrc_applied[b, :3] += push
            data.xfrc_applied[b, 3:] += np.cross(arm, push)

    return force
