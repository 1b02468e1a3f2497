"""Sliding friction as a force of its own at each contact point, by the textbook's law rather than the simulator's.

MuJoCo's contacts of the two bodies are made frictionless; what rubs is computed here: the normal forces of the step
before, the velocity at each point, and the friction that dissipates most among those that a friction ellipse allows
(Moreau's principle): f = -N (mu_x^2 v_x, mu_y^2 v_y) / |(mu_x v_x, mu_y v_y)|. Below a creep speed it fades, so that a
body comes to rest within microns; it does not hold a body on a slope.
"""

from __future__ import annotations

from collections.abc import Callable

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


def rub(coefficients: Coefficients, body: str, surface: str) -> Callable[[mujoco.MjModel, mujoco.MjData], None]:
    """Return the force hook of a body that slides on a level, fixed geom."""

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        b, ground = model.body(body).id, model.geom(surface).id
        centre = data.xipos[b]
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, b, velocity, 0)
        for i in range(data.ncon):
            contact = data.contact[i]
            pair = set(contact.geom.tolist())
            if ground not in pair or contact.efc_address < 0:
                continue
            if model.geom_bodyid[(pair - {ground}).pop()] != b:
                continue
            normal = data.efc_force[contact.efc_address]
            arm = contact.pos - centre
            slip = (velocity[3:] + np.cross(velocity[:3], arm))[:2]
            mu = coefficients(data.time, contact.pos)
            length = np.sqrt((mu * slip) @ (mu * slip) + (mu.max() * CREEP) ** 2)
            push = np.array([*(-normal * mu**2 * slip / length), 0.0])
            data.xfrc_applied[b, :3] += push
            data.xfrc_applied[b, 3:] += np.cross(arm, push)

    return force
