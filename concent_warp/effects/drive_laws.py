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


class LooseGear(Law):
    """Lets a servo's force through to the link only where its rotor presses on an end of the play.

    The rotor, without mass, is ahead of the link by x, |x| <= |g| play / 2, with g the gear. With e the error of the
    link, l its length, kp and kv the gains, the servo's force on it is f(x) = kp (e - x) - kv l'. Within the play
    kv (l' + x') = kp (e - x) and nothing gets through; at the ends f(x) does while it presses that way. A step in which
    the rotor arrives counts in proportion to the time that is left. The parameter is the width of the play at the
    joint, shape (1,); x is kept in the user data.
    """

    def __init__(self, actuators: np.ndarray, first: int) -> None:
        """Act on position-controlled actuators of single joints, ids of shape (n,); user data begin at `first`."""
        self.actuators = np.asarray(actuators, dtype=np.int32)
        self.first = first
        self._joints: np.ndarray | None = None
        self._device: wp.array[Any] | None = None

    def apply(self, m: mujoco.MjModel, d: mujoco.MjData, values: np.ndarray) -> None:
        """See `Law.apply`."""
        a, play, dt = self.actuators, float(values[0]), m.opt.timestep
        if play <= 0:
            return
        if self._joints is None:
            self._joints = np.array([driven_joints(m, int(i))[0] for i in a])
        dof = m.jnt_dofadr[self._joints]
        gear, kp, bias = m.actuator_gear[a, 0], m.actuator_gainprm[a, 0], m.actuator_biasprm[a]
        half, kv = 0.5 * play * np.abs(gear), np.maximum(-bias[:, 2], 1e-9 * kp)
        speed = gear * d.qvel[dof]
        command = within(d.ctrl[a], m.actuator_ctrlrange[a], m.actuator_ctrllimited[a])
        error = command + (bias[:, 0] + bias[:, 1] * gear * d.qpos[m.jnt_qposadr[self._joints]]) / kp
        force = kp * error + bias[:, 2] * speed
        ahead = d.userdata[self.first + a] if d.time else np.clip(force / kp, -half, half)
        alone = error + (ahead - error) * np.exp(-dt * kp / kv) - speed * dt
        after = np.clip(alone, -half, half)
        share = (alone - after) / np.where(alone == after, 1.0, alone - ahead)
        d.userdata[self.first + a] = after
        through = share * (kp * (error - after) + bias[:, 2] * speed)
        limits, limited = m.actuator_forcerange[a], m.actuator_forcelimited[a]
        change = within(through, limits, limited) - within(force, limits, limited)
        np.add.at(d.qfrc_applied, dof, gear * change)

    def launch(self, m: mjw.Model, d: mjw.Data, values: wp.array[Any]) -> None:
        """See `Law.launch`."""
        import warp as wp

        from concent_warp.kernels import laws

        if self._device is None:
            self._device = wp.array(self.actuators, dtype=int)
        laws.loose_gear(m, d, self._device, self.first, values)


def within(value: np.ndarray, limits: np.ndarray, limited: np.ndarray) -> np.ndarray:
    """Return values, shape (n,), within limits, shape (n, 2), where they are limited, shape (n,) bool."""
    return np.where(limited, np.minimum(np.maximum(value, limits[:, 0]), limits[:, 1]), value)
