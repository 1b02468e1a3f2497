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
        self._device: wp.array[Any] | None = None

    def apply(self, m: mujoco.MjModel, d: mujoco.MjData, values: np.ndarray) -> None:
        """See `Law.apply`."""
        half = 0.5 * max(float(values[0]), 0.0)
        for a in self.actuators:
            joint = driven_joints(m, int(a))[0]
            dof = m.jnt_dofadr[joint]
            gear, kp, bias = m.actuator_gear[a, 0], m.actuator_gainprm[a, 0], m.actuator_biasprm[a]
            command = np.clip(d.ctrl[a], *m.actuator_ctrlrange[a]) if m.actuator_ctrllimited[a] else d.ctrl[a]
            length = gear * d.qpos[m.jnt_qposadr[joint]]
            change = -kp * np.clip(command - length, -abs(gear) * half, abs(gear) * half)
            if m.actuator_forcelimited[a]:
                force = kp * command + bias[0] + bias[1] * length + bias[2] * gear * d.qvel[dof]
                limits = m.actuator_forcerange[a]
                change = np.clip(force + change, *limits) - np.clip(force, *limits)
            d.qfrc_applied[dof] += gear * change

    def launch(self, m: mjw.Model, d: mjw.Data, values: wp.array[Any]) -> None:
        """See `Law.launch`."""
        import warp as wp

        from concent_warp.kernels import laws

        if self._device is None:
            self._device = wp.array(self.actuators, dtype=int)
        laws.dead_zone(m, d, self._device, values)
