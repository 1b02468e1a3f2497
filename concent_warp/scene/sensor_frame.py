"""Where on a body the frame lies that a frame sensor measures: a marker, a geom, a centre of mass, the body itself.

It may be measured in the world, or in a frame that stands in it, as that of a camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

OBJECT = mujoco.mjtObj
TURN, DISTANCE = 1e-9, 1e-12
"""Rotation [rad] and distance [m] below which frames are the same."""


@dataclass(frozen=True)
class SensorFrame:
    """A frame that is fixed to a body, and the one in which it is measured."""

    body: int
    """Index of the body."""
    offset: np.ndarray
    """Its origin [m], in the body's frame, shape (3,)."""
    turn: Rotation
    """Rotation from it to the body's frame."""
    base_origin: np.ndarray
    """Origin of the frame in which it is measured [m], in the world, shape (3,)."""
    base_turn: Rotation
    """Rotation from that frame to the world."""

    @property
    def is_body(self) -> bool:
        """Whether what is measured is the body's own frame in the world."""
        turned = max(float(self.turn.magnitude()), float(self.base_turn.magnitude())) > TURN
        return not self.is_beside and not turned and float(np.abs(self.base_origin).max()) <= DISTANCE

    @property
    def is_beside(self) -> bool:
        """Whether its origin is not the body's."""
        return float(np.abs(self.offset).max()) > DISTANCE

    def place_in_world(self, value: np.ndarray) -> np.ndarray:
        """Return measured positions (..., 3) of its origin [m] as positions in the world."""
        return self.base_origin + self.base_turn.apply(value)

    def body_in_world(self, value: np.ndarray) -> Rotation:
        """Return measured orientations, quaternions wxyz (..., 4), as rotations from the body's frame to the world."""
        return self.base_turn * Rotation.from_quat(value, scalar_first=True) * self.turn.inv()


def sensor_frame(m: mujoco.MjModel, row: int) -> SensorFrame | None:
    """Return the frame that a sensor measures; None where it measures none, or relative to one that may move.

    Args:
        m: The compiled model.
        row: Index of the sensor.
    """
    found = _on_body(m, int(m.sensor_objtype[row]), int(m.sensor_objid[row]))
    if found is None:
        return None
    if m.sensor_refid[row] < 0:
        return SensorFrame(*found, np.zeros(3), Rotation.identity())
    base = _on_body(m, int(m.sensor_reftype[row]), int(m.sensor_refid[row]))
    if base is None or m.body_weldid[base[0]] or m.body_mocapid[base[0]] >= 0:
        return None
    d = mujoco.MjData(m)
    mujoco.mj_kinematics(m, d)
    stands = Rotation.from_quat(d.xquat[base[0]], scalar_first=True)
    return SensorFrame(*found, d.xpos[base[0]] + stands.apply(base[1]), stands * base[2])


def _on_body(m: mujoco.MjModel, kind: int, target: int) -> tuple[int, np.ndarray, Rotation] | None:
    """Return the body that an object is on, its origin there [m] and the rotation from its frame to the body's."""
    if kind == OBJECT.mjOBJ_XBODY:
        return target, np.zeros(3), Rotation.identity()
    if kind == OBJECT.mjOBJ_BODY:
        body, offset, turn = target, m.body_ipos[target], m.body_iquat[target]
    elif kind == OBJECT.mjOBJ_SITE:
        body, offset, turn = int(m.site_bodyid[target]), m.site_pos[target], m.site_quat[target]
    elif kind == OBJECT.mjOBJ_GEOM:
        body, offset, turn = int(m.geom_bodyid[target]), m.geom_pos[target], m.geom_quat[target]
    elif kind == OBJECT.mjOBJ_CAMERA:
        body, offset, turn = int(m.cam_bodyid[target]), m.cam_pos[target], m.cam_quat[target]
    else:
        return None
    return body, np.array(offset), Rotation.from_quat(turn, scalar_first=True)
