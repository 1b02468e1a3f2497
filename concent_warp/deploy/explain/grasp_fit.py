"""The pose of a grasped object nearest to a given one at which the fingers do not overlap with it on one side only.

A pose that is a millimetre off along the fingers' axis has one finger deep in the object and the other off it, and a
simulation from there throws the object out of the hand. Linearised contacts, d_c depths along normals n_c at r_c from
the object's origin, give its move (p, w) by regularised least squares: sum ((d_c - n_c . (p + w x r_c)) / s)^2 +
(p / s_p)^2 + (w / s_w)^2, a few times. Overlaps from both sides balance and stay, as those of a firm grasp should.
"""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.deploy.explain.cfg import ContactStartCfg

SMALL = 0.05
"""Largest part of a move, in standard deviations, from which on the fit ends."""


class GraspFit:
    """Fits an object between the fingers."""

    def __init__(self, m: mujoco.MjModel, body: int, cfg: ContactStartCfg) -> None:
        """Prepare for a compiled model in which `body` is free."""
        self._m, self._data, self._cfg = m, mujoco.MjData(m), cfg
        self._address = int(m.jnt_qposadr[m.body_jntadr[body]])
        self._mine = m.geom_bodyid == body
        # What moves, but is no other free object, is the robot.
        free = {b for b in range(m.nbody) if m.body_jntnum[b] and int(m.jnt_type[m.body_jntadr[b]]) == 0}
        self._robot = np.array([m.body_weldid[b] != 0 and b not in free for b in m.geom_bodyid])
        self._scale = np.array([cfg.position_std] * 3 + [cfg.orientation_std] * 3)

    def __call__(self, qpos: np.ndarray) -> np.ndarray:
        """Return positions (nq,) with the object fitted between the fingers."""
        found = qpos.copy()
        position, quaternion = found[self._address :][:3], found[self._address + 3 :][:4]
        turn, turned = np.zeros(4), np.zeros(4)
        for _ in range(self._cfg.grasp_iterations):
            rows, depths = self._overlaps(found)
            if not len(depths):
                break
            rows = rows * self._scale / self._cfg.penetration_std
            step = np.linalg.solve(rows.T @ rows + np.eye(6), rows.T @ (depths / self._cfg.penetration_std))
            position += step[:3] * self._scale[:3]
            rotation = step[3:] * self._scale[3:]
            if (angle := float(np.linalg.norm(rotation))) > 0:
                mujoco.mju_axisAngle2Quat(turn, rotation / angle, angle)
                mujoco.mju_mulQuat(turned, turn, quaternion)
                quaternion[:] = turned
            if np.abs(step).max() < SMALL:
                break
        return found

    def _overlaps(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the overlaps with the robot: how a move makes them shallower (C, 6), and their depths (C,) [m]."""
        d = self._data
        d.qpos[:] = qpos
        mujoco.mj_kinematics(self._m, d)
        mujoco.mj_collision(self._m, d)
        first, second = d.contact.geom.T
        sign = 1.0 * (self._mine[second] & self._robot[first]) - (self._mine[first] & self._robot[second])
        kept = np.flatnonzero((sign != 0) & (d.contact.dist < 0))
        n = sign[kept, None] * d.contact.frame[kept, :3]
        r = d.contact.pos[kept] - qpos[self._address : self._address + 3]
        turning = r[:, [1, 2, 0]] * n[:, [2, 0, 1]] - r[:, [2, 0, 1]] * n[:, [1, 2, 0]]
        return np.hstack([n, turning]), -d.contact.dist[kept]
