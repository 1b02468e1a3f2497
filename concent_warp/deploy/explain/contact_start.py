"""Starts of trials that measurement and contact agree on.

A tracked pose is a millimetre off, and a simulation from there would begin with bodies inside one another. The pose of
the manipulated object is therefore the one of least cost: squared penetrations beyond those of a grasp, and squared
deviations from the tracked pose, each over its standard deviation. How far it had to move says how well the tracked
pose agrees with the grasp.
"""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from concent_warp.deploy.explain.cfg import ContactStartCfg
from concent_warp.deploy.explain.measured_start import MeasuredStart


class ContactStarts:
    """Moves the manipulated object of measured starts to where nothing overlaps."""

    def __init__(self, m: mujoco.MjModel, body: int, cfg: ContactStartCfg) -> None:
        """Prepare for a compiled model in which `body` is free."""
        self._m, self._data, self._body, self._cfg = m, mujoco.MjData(m), body, cfg
        self.address = int(m.jnt_qposadr[m.body_jntadr[body]])
        self._geoms = np.flatnonzero(m.geom_bodyid == body)

    def settled(self, start: MeasuredStart) -> tuple[MeasuredStart, np.ndarray]:
        """Return the start without overlaps, and the move of the object, position [m] and rotation vector, shape (6,).

        Args:
            start: As measured.
        """
        m, cfg = self._m, self._cfg
        self._place(start)
        scale = np.array([cfg.position_std] * 3 + [cfg.orientation_std] * 3)

        def cost(x: np.ndarray) -> float:
            self._data.qpos[self.address : self.address + 7] = moved(start.qpos[self.address :], x * scale)
            mujoco.mj_kinematics(m, self._data)
            mujoco.mj_collision(m, self._data)
            depth = 0.0
            for contact in self._data.contact:
                if self._body in m.geom_bodyid[contact.geom]:
                    depth += max(0.0, -float(contact.dist) - cfg.penetration) ** 2
            return depth / cfg.penetration_std**2 + float(x @ x)

        if cost(np.zeros(6)) == 0:
            return start, np.zeros(6)
        found = minimize(cost, np.zeros(6), method="Powell", options={"maxiter": cfg.iterations, "xtol": 0.02})
        qpos = start.qpos.copy()
        qpos[self.address : self.address + 7] = moved(start.qpos[self.address :], found.x * scale)
        return replace(start, qpos=qpos), found.x * scale

    def _place(self, start: MeasuredStart) -> None:
        """Set the model's state to a start."""
        m, d = self._m, self._data
        d.qpos[:], d.ctrl[:] = start.qpos, start.ctrl
        for body in range(m.nbody):
            if (row := int(m.body_mocapid[body])) >= 0 and (pose := start.fixtures.get(m.body(body).name)) is not None:
                d.mocap_pos[row], d.mocap_quat[row] = pose[:3], pose[3:]


def moved(pose: np.ndarray, move: np.ndarray) -> np.ndarray:
    """Return a pose (7,) shifted and turned in the world frame by position [m] and rotation vector, shape (6,)."""
    turn = Rotation.from_rotvec(move[3:]) * Rotation.from_quat(pose[3:7], scalar_first=True)
    return np.concatenate([pose[:3] + move[:3], turn.as_quat(scalar_first=True)])
