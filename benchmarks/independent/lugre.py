"""Joint friction with bristles, integrated with the world.

Canudas de Wit, Olsson, Astrom, Lischinsky, "A new model for control of systems with friction", IEEE Trans. Automatic
Control 40(3), 1995: dz/dt = v - s0 |v| z / g(v), force s0 z + s1 dz/dt, g the friction at steady sliding.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import mujoco
import numpy as np

from concent_warp.reality.hidden.hidden_effect import PerTrialState

Level = Callable[[mujoco.MjModel, mujoco.MjData, int], float]
"""Given model, data and degree of freedom, returns friction at steady sliding [N m or N]."""
PRESLIDING = {"hinge": 4e-4, "slide": 3e-5}
"""Deflection of the bristles at which they slip [rad], [m]; a joint at rest yields by as much."""
DAMPING_RATIO = 0.3
"""Damping of the bristles over the critical one [-]."""


class BristleFriction(PerTrialState):
    """Friction of one joint, the sum of several levels."""

    def __init__(self, joint: str, levels: Sequence[Level]) -> None:
        super().__init__()
        self.joint, self.levels = joint, list(levels)
        self.bend = 0.0

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Add the friction of this step to `qfrc_applied`."""
        joint = model.joint(self.joint)
        dof = int(joint.dofadr[0])
        if self.step(data.time) is None:
            self.bend = 0.0
        level = sum(f(model, data, dof) for f in self.levels)
        if level <= 0:
            return
        give = PRESLIDING["slide" if joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE else "hinge"]
        stiffness, speed, dt = level / give, float(data.qvel[dof]), model.opt.timestep
        before = self.bend
        # Implicit in z: stable for any speed.
        self.bend = (before + speed * dt) / (1 + abs(speed) * dt / give)
        damping = 2 * DAMPING_RATIO * np.sqrt(stiffness * float(model.dof_M0[dof]))
        force = stiffness * self.bend + damping * (self.bend - before) / dt
        data.qfrc_applied[dof] -= np.clip(force, -1.5 * level, 1.5 * level)


def bristles(levels: Mapping[str, Sequence[Level]]) -> Callable[[mujoco.MjModel, mujoco.MjData], None]:
    """Return the force hook of the friction of several joints."""
    found = [BristleFriction(joint, of) for joint, of in levels.items()]

    def act(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        for friction in found:
            friction(model, data)

    return act


def constant(value: float) -> Level:
    """Return a level that depends on nothing [N m or N]."""
    return lambda _model, _data, _dof: value
