"""Sliding friction as a force at each contact point by Coulomb's formula, in place of the simulator's contact model.

MuJoCo's contacts of the two bodies are frictionless; the force is computed from the normal forces N of the previous
step and the velocity v at each point: f = -N (mu_x v_x, mu_y v_y) / |v|, with an anisotropic coefficient of friction
(Zmitrowicz, "A theoretical model of anisotropic dry friction", Wear 73(1), 1981). Below `FADE_SPEED` it fades, so that
a body comes to rest within microns; a body on a slope creeps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import numpy as np

FADE_SPEED = 2e-3
"""Speed below which friction fades [m/s]; the step must be short against FADE_SPEED / (mu g)."""
Coefficients = Callable[[float, np.ndarray], np.ndarray]
"""Given time [s] and a point [m], world frame, returns the coefficients along the world's x and y (2,) [-]."""


def frictionless(spec: mujoco.MjSpec, geoms: Sequence[str]) -> None:
    """Take the simulator's own friction from geoms."""
    for name in geoms:
        spec.geom(name).condim = 1
        spec.geom(name).friction = [1e-6, 1e-6, 1e-6]


def normal_forces(model: mujoco.MjModel, data: mujoco.MjData, body: int, surface: int) -> tuple[np.ndarray, np.ndarray]:
    """Return places [m], world frame, shape (n, 3), and normal forces [N] (n,) of the contacts of a body with a geom.

    Those of the step before; the world has elliptic cones, whose first force is the normal one.
    """
    contact = data.contact
    geom, address = contact.geom, contact.efc_address
    if not len(address):
        return np.zeros((0, 3)), np.zeros(0)
    other = np.where(geom[:, 0] == surface, geom[:, 1], geom[:, 0])
    rows = (geom == surface).any(axis=1) & (address >= 0) & (model.geom_bodyid[other] == body)
    return contact.pos[rows], data.efc_force[address[rows]]


def apply_sliding_friction(
    coefficients: Coefficients, body: str, surface: str
) -> Callable[[mujoco.MjModel, mujoco.MjData], None]:
    """Return the force hook of a body that slides on a level, fixed geom."""
    velocity = np.zeros(6)

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        b = model.body(body).id
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, b, velocity, 0)
        wx, wy, wz, vx, vy, _ = velocity
        centre = data.xipos[b]
        for place, normal in zip(*normal_forces(model, data, b, model.geom(surface).id), strict=True):
            x, y, z = place - centre
            slip_x, slip_y = vx + wy * z - wz * y, vy + wz * x - wx * z
            pressure = normal / (slip_x**2 + slip_y**2 + FADE_SPEED**2) ** 0.5
            mu_x, mu_y = coefficients(data.time, place)
            push_x, push_y = -pressure * mu_x * slip_x, -pressure * mu_y * slip_y
            data.xfrc_applied[b] += (push_x, push_y, 0.0, -z * push_y, z * push_x, x * push_y - y * push_x)

    return force
