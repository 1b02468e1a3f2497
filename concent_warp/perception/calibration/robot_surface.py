"""The robot's surface as a camera sees it, at given joint angles and from a given pose."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.perception.calibration.joint_motion import JointMotion

ROBOT_GROUP, OTHER_GROUP = 5, 4
"""Geom groups of the robot and of all else."""
COLLISION_GROUP = 3
"""Group from which on geoms of a body are not shown where it has others, as in MuJoCo's viewer."""
VELOCITY_STEP = 0.005
"""Half of the time over which the velocity of a surface point is taken [s]."""
BISECTIONS = 5
"""Halvings of a pixel step by which the robot's outline is found."""


@dataclass(frozen=True)
class Surface:
    """Points of the robot's surface that a camera sees."""

    pixels: np.ndarray
    """Where they are in the image [px], shape (n, 2)."""
    points: np.ndarray
    """World frame [m], shape (n, 3)."""
    normals: np.ndarray
    """Unit normals, world frame, shape (n, 3)."""
    velocities: np.ndarray
    """World frame [m/s], shape (n, 3)."""

    def facing(self, pose: np.ndarray) -> np.ndarray:
        """Return the cosine of the angle between normal and view from a camera pose (4, 4), shape (n,)."""
        view = pose[:3, 3] - self.points
        return np.einsum("ni,ni->n", self.normals, view) / np.linalg.norm(view, axis=1)

    def only(self, rows: np.ndarray) -> Surface:
        """Return some of the points, by rows or by a mask."""
        return Surface(self.pixels[rows], self.points[rows], self.normals[rows], self.velocities[rows])


class RobotSurface:
    """Casts rays at those bodies of a scene whose joints have readings, and at what carries them."""

    def __init__(self, motion: JointMotion) -> None:
        """Take the geoms of the robot from a scene."""
        self.motion = motion
        self.model = copy.copy(motion.model)
        self.data = mujoco.MjData(self.model)
        model, bodies = self.model, set()
        for row in range(1, model.nbody):
            chain, at = [], row
            while at:
                chain.append(at)
                at = int(model.body_parentid[at])
            joints = [
                j for b in chain for j in range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b])
            ]
            if joints and all(j in motion.readings for j in joints):
                bodies.update(chain)
        self.own = np.isin(model.geom_bodyid, list(bodies))
        for body in bodies:
            geoms = np.flatnonzero(model.geom_bodyid == body)
            shown = [g for g in geoms if model.geom_group[g] < COLLISION_GROUP]
            self.own[[g for g in geoms if shown and g not in shown]] = False
        model.geom_group[:] = np.where(self.own, ROBOT_GROUP, OTHER_GROUP)
        self.reach = model.geom_rbound.copy()
        self.mask = np.zeros(6, dtype=np.uint8)
        self.mask[ROBOT_GROUP] = 1

    def seen(
        self, time: float, pose: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], count: int
    ) -> tuple[Surface, Surface]:
        """Return the visible surface on a grid of pixels, and the outline of the robot in the image.

        Args:
            time: Time by the robot's clock [s].
            pose: Camera-to-world, shape (4, 4).
            intrinsics: Pinhole matrix [px], shape (3, 3).
            size: Width and height of the image [px].
            count: Pixels of the grid, over the image.
        """
        ahead, behind = (self.motion.angles(np.array([time + s]))[0] for s in (VELOCITY_STEP, -VELOCITY_STEP))
        frames = []
        for qpos in (ahead, behind, self.motion.angles(np.array([time]))[0]):
            self.data.qpos[:] = qpos
            mujoco.mj_kinematics(self.model, self.data)
            frames.append((self.data.geom_xpos.copy(), self.data.geom_xmat.reshape(-1, 3, 3).copy()))
        step = max(np.sqrt(size[0] * size[1] / count), 1.0)
        # At the centres of pixels, where depth is measured.
        columns, rows = (np.unique(np.arange(step / 2, n - 1, step).round()) for n in size)
        grid = np.stack(np.meshgrid(columns, rows), axis=-1)
        inverse = np.linalg.inv(intrinsics)
        hit, normal, geom = (a.reshape(*grid.shape[:2], -1) for a in self._cast(grid.reshape(-1, 2), pose, inverse))
        on = hit[..., 0] > 0
        surface = self._surface(grid[on], hit[on][:, 0], normal[on], geom[on][:, 0], pose, inverse, frames)
        edges = [self._outline(grid, on, axis, pose, inverse) for axis in (0, 1)]
        pixels = np.concatenate(edges)
        hit, normal, geom = self._cast(pixels, pose, inverse)
        good = hit > 0
        outline = self._surface(pixels[good], hit[good], normal[good], geom[good], pose, inverse, frames)
        return surface, outline

    def _cast(
        self, pixels: np.ndarray, pose: np.ndarray, inverse: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return depth [m] (-1 where nothing is), normal and geom of the first hit of rays through pixels (n, 2)."""
        rays = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ inverse.T @ pose[:3, :3].T
        length = np.linalg.norm(rays, axis=1)
        depth, normal = np.full(len(pixels), -1.0), np.zeros((len(pixels), 3))
        geom, origin = np.zeros(len(pixels), dtype=int), pose[:3, 3].copy()
        # Rays that pass all bounding spheres are not cast.
        unit = rays / length[:, None]
        near = np.zeros(len(pixels), dtype=bool)
        for g in np.flatnonzero(self.own):
            to = self.data.geom_xpos[g] - origin
            near |= (np.linalg.norm(np.cross(unit, to), axis=1) < self.reach[g]) & (unit @ to > 0)
        number, across = np.zeros(1, dtype=np.int32), np.zeros(3)
        for i in np.flatnonzero(near):
            distance = mujoco.mj_ray(self.model, self.data, origin, unit[i], self.mask, 1, -1, number, across)
            if distance > 0:
                depth[i], geom[i], normal[i] = distance / length[i], number[0], across
        return depth, normal, geom

    def _outline(
        self, grid: np.ndarray, on: np.ndarray, axis: int, pose: np.ndarray, inverse: np.ndarray
    ) -> np.ndarray:
        """Return pixels just inside the outline, shape (n, 2), between neighbours of a grid along an axis."""
        one, other = (grid[:-1], grid[1:]) if axis == 0 else (grid[:, :-1], grid[:, 1:])
        first, second = (on[:-1], on[1:]) if axis == 0 else (on[:, :-1], on[:, 1:])
        change = first != second
        swap = (second & ~first)[change][:, None]
        inside, outside = np.where(swap, other[change], one[change]), np.where(swap, one[change], other[change])
        for _ in range(BISECTIONS):
            middle = (inside + outside) / 2
            hit = (self._cast(middle, pose, inverse)[0] > 0)[:, None]
            inside, outside = np.where(hit, middle, inside), np.where(hit, outside, middle)
        return inside

    def _surface(
        self,
        pixels: np.ndarray,
        depth: np.ndarray,
        normals: np.ndarray,
        geoms: np.ndarray,
        pose: np.ndarray,
        inverse: np.ndarray,
        frames: list[tuple[np.ndarray, np.ndarray]],
    ) -> Surface:
        """Return points of the surface with their velocities; `frames` are those of geoms after, before and now."""
        rays = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ inverse.T
        points = depth[:, None] * rays @ pose[:3, :3].T + pose[:3, 3]
        (after, turn_after), (before, turn_before), (place, turn) = frames
        local = np.einsum("nji,nj->ni", turn[geoms], points - place[geoms])
        ahead = after[geoms] + np.einsum("nij,nj->ni", turn_after[geoms], local)
        behind = before[geoms] + np.einsum("nij,nj->ni", turn_before[geoms], local)
        return Surface(pixels, points, normals, (ahead - behind) / (2 * VELOCITY_STEP))
