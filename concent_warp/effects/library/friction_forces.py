"""Joint friction that depends on speed or load: the friction loss, set anew before each step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from concent_warp.effects.compiled_forces import Row, add_load, add_stribeck
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
    acts = staticmethod(add_stribeck)

    def rows(self, m: mujoco.MjModel, values: np.ndarray) -> list[Row]:
        """See `ForceModel.rows`."""
        half, speed = 0.5 * float(m.opt.timestep), max(float(values[-1]), 1e-6)
        every = zip(self.dof, values[:-1], strict=True)
        return [([int(i)], [max(float(extra), 0.0), half, speed]) for i, extra in every]

    def launch(self, m: mjw.Model, d: mjw.Data, values: wp.array[Any]) -> None:
        """See `ForceModel.launch`."""
        from concent_warp.kernels import force_models

        force_models.add_stribeck_friction(m, d, self.device_dof(), values)


class LoadFriction(DofForce):
    """Friction loss + c (|tau_m| + |tau_e|) / 2, of the step before; parameters are the c, shape (n,).

    tau_m is what the motor exerts, tau_e what the link's weight and motion do; in a static hold they are opposite, and
    each is the torque that the gears carry. The source of `LoadDependentFriction` has their difference, or a
    coefficient for each; their sum explains measured logs of a servo better (`benchmarks.diagnose.real`).
    """

    edits = ("dof_frictionloss",)
    acts = staticmethod(add_load)

    def rows(self, m: mujoco.MjModel, values: np.ndarray) -> list[Row]:
        """See `ForceModel.rows`."""
        del m
        return [([int(i)], [0.5 * max(float(c), 0.0)]) for i, c in zip(self.dof, values, strict=True)]

    def launch(self, m: mjw.Model, d: mjw.Data, values: wp.array[Any]) -> None:
        """See `ForceModel.launch`."""
        from concent_warp.kernels import force_models

        force_models.add_load_friction(m, d, self.device_dof(), values)
