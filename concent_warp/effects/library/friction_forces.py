"""Joint friction that depends on speed or load: the friction loss, set anew before each step."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from concent_warp.effects.force_model import ForceModel

if TYPE_CHECKING:
    import mujoco_warp as mjw
    import warp as wp


class DofForce(ForceModel):
    """A force model that acts on some degrees of freedom."""

    def __init__(self, dof: np.ndarray) -> None:
        """Act on the degrees of freedom `dof`, shape (n,) int."""
        self.dof = np.asarray(dof, dtype=np.int32)
        self._device: wp.array[Any] | None = None

    def device_dof(self) -> wp.array[Any]:
        """Return `dof` on Warp's current device."""
        import warp as wp

        if self._device is None:
            self._device = wp.array(self.dof, dtype=int)
        return self._device


class StribeckFriction(DofForce):
    """Friction loss + extra exp(-(qd / speed)^2); parameters are the extras, shape (n,), then the speed.

    qd is the velocity in the middle of the step, after the acceleration of the step before: stick-slip feeds on lag.
    """

    edits = ("dof_frictionloss",)

    def apply(self, m: mujoco.MjModel, d: mujoco.MjData, values: np.ndarray) -> None:
        """See `ForceModel.apply`."""
        self.bound(m, d, values)()

    def bound(self, m: mujoco.MjModel, d: mujoco.MjData, values: np.ndarray) -> Callable[[], None]:
        """See `ForceModel.bound`."""
        loss, qvel, qacc, half = m.dof_frictionloss, d.qvel, d.qacc, 0.5 * m.opt.timestep
        speed = max(float(values[-1]), 1e-6)
        rows = [(int(i), max(float(extra), 0.0)) for i, extra in zip(self.dof, values[:-1], strict=True)]

        def act() -> None:
            for i, extra in rows:
                ratio = (qvel[i] + half * qacc[i]) / speed
                loss[i] += extra * math.exp(-ratio * ratio)

        return act

    def launch(self, m: mjw.Model, d: mjw.Data, values: wp.array[Any]) -> None:
        """See `ForceModel.launch`."""
        from concent_warp.kernels import force_models

        force_models.add_stribeck_friction(m, d, self.device_dof(), values)


class LoadFriction(DofForce):
    """Friction loss + c |tau_m - tau_e| / 2, of the step before; parameters are the c, shape (n,).

    tau_m is what the motor exerts, tau_e what the link's weight and motion do; in a static hold they are opposite, and
    half their difference is the torque that the gears carry.
    """

    edits = ("dof_frictionloss",)

    def apply(self, m: mujoco.MjModel, d: mujoco.MjData, values: np.ndarray) -> None:
        """See `ForceModel.apply`."""
        self.bound(m, d, values)()

    def bound(self, m: mujoco.MjModel, d: mujoco.MjData, values: np.ndarray) -> Callable[[], None]:
        """See `ForceModel.bound`."""
        loss, motor, weight = m.dof_frictionloss, d.qfrc_actuator, d.qfrc_bias
        rows = [(int(i), 0.5 * max(float(c), 0.0)) for i, c in zip(self.dof, values, strict=True)]

        def act() -> None:
            for i, share in rows:
                loss[i] += share * abs(motor[i] + weight[i])

        return act

    def launch(self, m: mjw.Model, d: mjw.Data, values: wp.array[Any]) -> None:
        """See `ForceModel.launch`."""
        from concent_warp.kernels import force_models

        force_models.add_load_friction(m, d, self.device_dof(), values)
