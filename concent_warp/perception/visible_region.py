"""Pixels of a depth image in which a body of known shape and pose is visible."""

from __future__ import annotations

import copy

import mujoco
import numpy as np

from concent_warp.perception.pinhole import Pinhole, pixel_grid
from concent_warp.perception.rigid_motion import inverse, transformed

BODY_GEOM_GROUP = 5
"""Geom group that the body's geoms are put into, so that rays meet no others."""


class BodyShape:
    """Geoms of one body, for ray casting at any pose of the body."""

    def __init__(self, model: mujoco.MjModel, qpos: np.ndarray, body: str) -> None:
        """Take the geoms of `body` from a compiled scene; `qpos` (nq,) is the initial state."""
        self.model = copy.copy(model)
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = qpos
        mujoco.mj_forward(self.model, self.data)
        row = self.model.body(body).id
        own = self.model.geom_bodyid == row
        self.model.geom_group[:] = np.where(own, BODY_GEOM_GROUP, 0)
        self.start = np.eye(4)
        """Pose of the body at the start, shape (4, 4)."""
        self.start[:3, :3] = self.data.xmat[row].reshape(3, 3)
        self.start[:3, 3] = self.data.xpos[row]
        centre = self.data.geom_xpos[own] - self.data.xpos[row]
        self.reach = float((np.linalg.norm(centre, axis=1) + self.model.geom_rbound[own]).max())
        """Radius of a sphere around the body frame that holds all geoms [m]."""

    def depth(self, camera: Pinhole, pose: np.ndarray, height: int, width: int) -> np.ndarray:
        """Return the depth [m] of the body alone at `pose` (4, 4), shape (height, width); 0 where it is not."""
        result = np.zeros((height, width))
        centre, distance = camera.project(pose[:3, 3])
        if distance <= self.reach:
            return result
        half = self.reach * camera.intrinsics[[0, 1], [0, 1]] / (distance - self.reach)
        low = np.clip(np.floor(centre - half), 0, [width, height]).astype(int)
        high = np.clip(np.ceil(centre + half) + 1, 0, [width, height]).astype(int)
        window = np.s_[low[1] : high[1], low[0] : high[0]]
        pixels = pixel_grid(height, width)[window].reshape(-1, 2)
        if not len(pixels):
            return result
        # The rays are transformed to the initial pose of the body, so that the compiled scene stays unchanged.
        back = self.start @ inverse(pose)
        origin = transformed(back, camera.position[None])[0]
        ray = camera.rays(pixels) @ (back[:3, :3] @ camera.pose[:3, :3]).T
        length = np.linalg.norm(ray, axis=1)
        group = np.zeros(6, dtype=np.uint8)
        group[BODY_GEOM_GROUP] = 1
        hit = cast_rays(self.model, self.data, origin, ray / length[:, None], group)
        # Rays are scaled to a depth of 1, so depth is distance over length.
        result[window] = np.where(hit >= 0, hit / length, 0.0).reshape(result[window].shape)
        return result


def visible_mask(expected: np.ndarray, measured: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the pixels in which a body is visible, shape (H, W) bool.

    Args:
        expected: Depth of the body alone [m], shape (H, W), 0 outside it.
        measured: Measured depth [m], shape (H, W), 0 where there is none.
        tolerance: Largest difference between the two [m].
    """
    return (expected > 0) & (measured > 0) & (np.abs(measured - expected) < tolerance)


def cast_rays(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    origin: np.ndarray,
    direction: np.ndarray,
    group: np.ndarray | None = None,
) -> np.ndarray:
    """Return the distance [m] to the first geom along each ray, shape (n,); -1 where there is none.

    One `mj_ray` a ray: `mj_multiRay` leaves out geoms too early and misses one hit in a thousand.

    Args:
        model: Compiled scene.
        data: Its state, kinematics done.
        origin: Where the rays start [m], world frame, shape (3,).
        direction: Unit vectors, world frame, shape (n, 3).
        group: Which of the six geom groups are met, shape (6,) uint8; None for all.
    """
    geom = np.zeros(1, dtype=np.int32)
    return np.array([mujoco.mj_ray(model, data, origin, ray, group, 1, -1, geom, None) for ray in direction])
