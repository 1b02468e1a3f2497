"""What nobody measures about a real task: friction, masses and gains that differ from the nominal model's.

They are sampled once for each demonstration or episode, and neither the model nor the policy is told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.checks import PositiveInterval


@dataclass(frozen=True)
class VariationCfg:
    """Ranges of Reality's unmeasured parameters; values are uniform within them."""

    friction: PositiveInterval = (0.2, 0.5)
    """Sliding friction coefficient of the objects [-]; all objects of an episode share one value."""
    grip: PositiveInterval = (0.8, 1.2)
    """Factor on the sliding friction of the gripper's fingers [-]; a grasp has the larger friction of object and
    finger."""
    mass: PositiveInterval = (0.9, 1.1)
    """Factor on mass and inertia of each object [-]."""
    gain: PositiveInterval = (0.95, 1.05)
    """Factor on the gain of each position control [-]."""
    enabled: bool = True
    """Whether they vary; if not, Reality shares these parameters with the nominal model."""

    def sample(
        self,
        model: mujoco.MjModel,
        objects: Sequence[str],
        fingers: Sequence[str],
        worlds: int,
        rng: np.random.Generator,
    ) -> dict[str, np.ndarray]:
        """Return sampled fields of N worlds, by name; empty if nothing varies.

        Args:
            model: Reality, compiled.
            objects: Names of the objects' bodies.
            fingers: Names of the geoms that grasp.
            worlds: N.
            rng: Source of the samples.

        Returns:
            Values of fields of the model, shape (N, ...) each.
        """
        if not self.enabled:
            return {}
        friction = np.tile(model.geom_friction, (worlds, 1, 1))
        bodies = [model.body(name).id for name in objects]
        friction[:, np.isin(model.geom_bodyid, bodies), 0] = rng.uniform(*self.friction, (worlds, 1))
        friction[:, [model.geom(name).id for name in fingers], 0] *= rng.uniform(*self.grip, (worlds, 1))
        mass, inertia = np.tile(model.body_mass, (worlds, 1)), np.tile(model.body_inertia, (worlds, 1, 1))
        heavier = rng.uniform(*self.mass, (worlds, len(bodies)))
        mass[:, bodies] *= heavier
        inertia[:, bodies] *= heavier[..., None]
        gain, bias = (np.tile(p, (worlds, 1, 1)) for p in (model.actuator_gainprm, model.actuator_biasprm))
        stronger = rng.uniform(*self.gain, (worlds, model.nu))
        gain[:, :, 0] *= stronger
        bias[:, :, 1] *= stronger
        return {
            "geom_friction": friction,
            "body_mass": mass,
            "body_inertia": inertia,
            "actuator_gainprm": gain,
            "actuator_biasprm": bias,
        }
