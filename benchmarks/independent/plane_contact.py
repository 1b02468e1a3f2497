"""Contact of a free body with the plane z = 0 as forces at points of the body, in place of MuJoCo's contacts.

Normal force after Tsuji, Tanaka, Ishida, "Lagrangian numerical simulation of plug flow of cohesionless particles in a
horizontal pipe", Powder Technology 71(3), 1992, with a free exponent: N = k d^n + c d^((n - 1) / 2) d', not below 0, at
the penetration d; the restitution does not depend on the speed. Friction of Coulomb, regularised: -mu N v / sqrt(v^2 +
v0^2), with other coefficients along x and y where the surface has a grain; torques -m N w / sqrt(w^2 + w0^2) against
spinning about the normal and against rolling.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np


@dataclass(frozen=True)
class PlaneContact:
    """Contact of one body."""

    stiffness: float
    """k [N/m^n]."""
    exponent: float
    """n [-]."""
    damping: float
    """c [N s/m^((n + 1) / 2)]."""
    friction: tuple[float, float]
    """Coefficients along the world's x and y [-]."""
    spinning: float = 0.0
    """Coefficient of the torque about the normal [m]."""
    rolling: float = 0.0
    """Coefficient of the torque about tangents [m]."""
    slip_speed: float = 1e-3
    """v0 [m/s]."""
    turning_speed: float = 0.03
    """w0 [rad/s]."""
    patch: tuple[float, float, float, float] | None = None
    """Centre [m], radius [m] and additional coefficient [-] of a rough patch."""

    def force(self, body: str) -> Callable[[mujoco.MjModel, mujoco.MjData], None]:
        """Return the force hook of a free body with one geom, a box or a sphere, that does not collide otherwise."""
        cached: dict[int, tuple[np.ndarray, float]] = {}

        def act(model: mujoco.MjModel, data: mujoco.MjData) -> None:
            key = id(model)
            if key not in cached:
                cached.clear()
                cached[key] = self._points(model, model.body(body).id)
            self._apply(model, data, model.body(body).id, *cached[key])

        return act

    def _points(self, model: mujoco.MjModel, body: int) -> tuple[np.ndarray, float]:
        """Return the corners (n, 3) of a box [m], body frame, and 0; of a sphere its centre (1, 3) and its radius."""
        geom = int(model.body_geomadr[body])
        size, place = model.geom_size[geom], model.geom_pos[geom]
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
            return place[None].copy(), float(size[0])
        return place + _box_corners(size), 0.0

    def _apply(self, model: mujoco.MjModel, data: mujoco.MjData, body: int, points: np.ndarray, radius: float) -> None:
        """Add the forces of this state to `xfrc_applied`."""
        joint = model.body_jntadr[body]
        at, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        origin, rotation = data.qpos[at : at + 3], np.empty(9)
        mujoco.mju_quat2Mat(rotation, data.qpos[at + 3 : at + 7])
        frame = rotation.reshape(3, 3)
        place = points @ frame.T
        if origin[2] + place[:, 2].min() - radius > 0.0:
            return
        spin = frame @ data.qvel[dof + 3 : dof + 6]
        place[:, 2] -= radius
        inside = np.maximum(-(origin[2] + place[:, 2]), 0.0)
        if radius:  # the pressure on a ball that sinks in acts half way up
            place[:, 2] += 0.5 * inside
        velocity = data.qvel[dof : dof + 3] + np.cross(spin, place)
        n = self.exponent
        damped = self.damping * inside ** (0.5 * (n - 1)) * (inside > 0) * velocity[:, 2]
        normal = np.maximum(self.stiffness * inside**n - damped, 0.0)
        force = np.zeros((len(place), 3))
        force[:, 2] = normal
        mu = np.tile(self.friction, (len(place), 1))
        if self.patch is not None:
            x, y, extent, more = self.patch
            mu[np.hypot(origin[0] + place[:, 0] - x, origin[1] + place[:, 1] - y) < extent] += more
        slip = velocity[:, :2]
        force[:, :2] = -mu * normal[:, None] * slip / np.sqrt((slip**2).sum(axis=1) + self.slip_speed**2)[:, None]
        lever = place - frame @ model.body_ipos[body]
        torque = np.cross(lever, force).sum(axis=0)
        if self.spinning or self.rolling:
            across = spin[:2] / np.hypot(np.hypot(*spin[:2]), self.turning_speed)
            about = spin[2] / np.hypot(spin[2], self.turning_speed)
            torque -= normal.sum() * np.array([*(self.rolling * across), self.spinning * about])
        data.xfrc_applied[body, :3] += force.sum(axis=0)
        data.xfrc_applied[body, 3:] += torque


def _box_corners(half: np.ndarray) -> np.ndarray:
    """Return the corners of a box of half sizes (3,), shape (8, 3)."""
    return half * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
