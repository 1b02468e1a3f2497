"""Where on a body the frame lies that a frame sensor measures: a marker, a geom, a centre of mass, the body itself."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

OBJECT = mujoco.mjtObj


@dataclass(frozen=True)
class SensorFrame:
    """A frame that is fixed to a body."""

    body: int
    """Index of the body."""
    offset: np.ndarray
    """Its origin [m], in the body's frame, shape (3,)."""
    turn: Rotation
    """Rotation from it to the body's frame."""

    @property
    def is_body(self) -> bool:
        """Whether it is the body's own frame."""
        return not self.is_beside and float(self.turn.magnitude()) < 1e-9

    @property
    def is_beside(self) -> bool:
        """Whether its origin is not the body's."""
        return bool(np.abs(self.offset).max() > 1e-12)


def sensor_frame(m: mujoco.MjModel, row: int) -> SensorFrame | None:
    """Return the frame that a sensor measures in the world; None where it measures none, or relative to another one.

    Args:
        m: The compiled model.
        row: Index of the sensor.
    """
    if m.sensor_refid[row] >= 0:
        return None
    target, kind = int(m.sensor_objid[row]), int(m.sensor_objtype[row])
    if kind == OBJECT.mjOBJ_XBODY:
        return SensorFrame(target, np.zeros(3), Rotation.identity())
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
    return SensorFrame(body, np.array(offset), Rotation.from_quat(turn, scalar_first=True))
