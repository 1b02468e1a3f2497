"""Play between drive and link as a force."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from concent_warp.effects.law import Law
from concent_warp.effects.select import driven_joints

if TYPE_CHECKING:
    import mujoco_warp as mjw
    import warp as wp


class DeadZone(Law):
    """Takes back the part of a servo's force that an error within the play makes: a dead zone of the error is left.

    With e the error, l the length, kp the gain and g the gear, the force f(e) = clip(kp e + b - kv l') becomes
    f(e - clip(e, -|g| play / 2, |g| play / 2)). The parameter is the width of the play at the joint, shape (1,).
    """

    def __init__(self, actuators: np.ndarray) -> None:
        """Act on position-controlled actuators of single joints, ids of shape (n,)."""
        self.actuators = np.asarray(actuators, dtype=np.int32)
        self._joints: np.ndarray | None = None
        self._device: wp.array[Any] | None = None

    def apply(self, m: mujoco.MjModel, d: mujoco.MjData, values: np.ndarray) -> None:
        """See `Law.apply`."""
        a = self.actuators
        if self._joints is None:
            self._joints = np.array([driven_joints(m, int(i))[0] for i in a])
        dof = m.jnt_dofadr[self._joints]
        gear, kp, bias = m.actuator_gear[a, 0], m.actuator_gainprm[a, 0], m.actuator_biasprm[a]
        half = 0.5 * max(float(values[0]), 0.0) * np.abs(gear)
        command = within(d.ctrl[a], m.actuator_ctrlrange[a], m.actuator_ctrllimited[a])
        length = gear * d.qpos[m.jnt_qposadr[self._joints]]
        force = kp * command + bias[:, 0] + bias[:, 1] * length + bias[:, 2] * gear * d.qvel[dof]
        less = force - kp * np.minimum(np.maximum(command - length, -half), half)
        limits, limited = m.actuator_forcerange[a], m.actuator_forcelimited[a]
        np.add.at(d.qfrc_applied, dof, gear * (within(less, limits, limited) - within(force, limits, limited)))

    def launch(self, m: mjw.Model, d: mjw.Data, values: wp.array[Any]) -> None:
        """See `Law.launch`."""
        import warp as wp

        from concent_warp.kernels import laws

        if self._device is None:
            self._device = wp.array(self.actuators, dtype=int)
        laws.dead_zone(m, d, self._device, values)


def within(value: np.ndarray, limits: np.ndarray, limited: np.ndarray) -> np.ndarray:
    """Return values, shape (n,), within limits, shape (n, 2), where they are limited, shape (n,) bool."""
    return np.where(limited, np.minimum(np.maximum(value, limits[:, 0]), limits[:, 1]), value)
