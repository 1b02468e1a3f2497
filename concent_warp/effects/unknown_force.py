"""A non-parametric force: a sum of Gaussian basis functions of joint position, velocity or body position.

It is not registered as an effect; it represents forces that no effect of the library can produce. Basis functions are
exp(-x^2 / 2) with x the distance from a centre in widths.
"""

from __future__ import annotations

from typing import Literal

import mujoco
import numpy as np

from concent_warp.effects.compiled_forces import Row, push_body_by_bump, push_by_bump
from concent_warp.effects.effect import Effect, Parameter
from concent_warp.effects.force_model import ForceModel

NEGLIGIBLE_SIZE = 1e-12
"""Sizes of basis functions below this count as zero [N or N m]."""


class UnknownJointForce(ForceModel):
    """On each of some joints a force that depends on the joint's own position, or velocity.

    Parameters are the sizes of the basis functions over their scale, joint by joint, shape (n K,).
    """

    acts = staticmethod(push_by_bump)

    def __init__(self, of: np.ndarray, dof: np.ndarray, centre: np.ndarray, scale: np.ndarray, *, moving: bool) -> None:
        """Set the basis functions.

        Args:
            of: Where in the positions, or the velocities if `moving`, each joint is, shape (n,) int.
            dof: Its degree of freedom, shape (n,) int.
            centre: Centres of the basis functions, evenly spaced by their width [rad, m, rad/s or m/s], shape (n, K).
            scale: [N m or N], shape (n,).
            moving: Whether it depends on the velocity.
        """
        self.of, self.dof, self.centre, self.scale, self.moving = of, dof, centre, scale, moving

    @property
    def count(self) -> int:
        """Number of parameters."""
        return self.centre.size

    def rows(self, m: mujoco.MjModel, values: np.ndarray) -> list[Row]:
        """See `ForceModel.rows`."""
        del m
        width = self.centre[:, 1] - self.centre[:, 0]
        sizes = values.reshape(self.centre.shape) * self.scale[:, None]
        return [
            (
                [int(self.dof[i]), int(self.of[i]), int(self.moving)],
                [float(self.centre[i, k]), 1.0 / float(width[i]), float(sizes[i, k])],
            )
            for i, k in np.argwhere(np.abs(sizes) > NEGLIGIBLE_SIZE)
        ]


Way = Literal["field", "brake", "drag", "turning"]
"""How a force on a body acts: along each axis of the world by place; against the velocity by place, or by speed; as a
torque against the turning by its rate."""
WAYS: tuple[Way, ...] = ("field", "brake", "drag", "turning")
"""The same, by their numbers in `concent_warp.effects.compiled_forces`."""


class UnknownBodyForce(ForceModel):
    """On a free body a force that depends on where it is, or a resistance that depends on that or on its speed.

    Parameters are the sizes of the basis functions over their scale, shape (K,), or (3 K,) along x, y and z of each.
    """

    acts = staticmethod(push_body_by_bump)

    def __init__(
        self,
        body: int,
        place: int,
        dof: int,
        centre: np.ndarray,
        width: float,
        scale: float,
        way: Way,
        fade_speed: float = 2e-3,
    ) -> None:
        """Set the basis functions.

        Args:
            body: Id.
            place: Of its free joint in the positions.
            dof: Of its free joint.
            centre: Centres [m], shape (K, 3), or [m/s or rad/s], shape (K, 1).
            width: Of the basis functions, in the same unit.
            scale: [N or N m].
            way: See `Way`.
            fade_speed: Speed [m/s], or rate [rad/s] over ten, below which a force against the motion fades out.
        """
        self.body, self.place, self.dof = body, place, dof
        self.centre, self.width, self.scale, self.way, self.fade_speed = centre, width, scale, way, fade_speed

    @property
    def count(self) -> int:
        """Number of parameters."""
        return len(self.centre) * (3 if self.way == "field" else 1)

    def rows(self, m: mujoco.MjModel, values: np.ndarray) -> list[Row]:
        """See `ForceModel.rows`."""
        del m
        sizes = np.reshape(values, (len(self.centre), -1)) * self.scale
        fade_speed = 10 * self.fade_speed if self.way == "turning" else self.fade_speed
        indices = [self.body, self.place, self.dof, WAYS.index(self.way)]
        centre, size = (np.pad(a, ((0, 0), (0, 3 - a.shape[1]))) for a in (self.centre, sizes))
        return [
            (indices, [*centre[k].tolist(), 1.0 / self.width, *size[k].tolist(), fade_speed])
            for k in np.flatnonzero((np.abs(sizes) > NEGLIGIBLE_SIZE).any(axis=1)).tolist()
        ]


class UnknownForce(Effect):
    """A non-parametric force, see this module; it is not registered."""

    name = "unknown_force"
    family = "world"
    kind = "none"
    summary = "A force that is a smooth function of where something is or of how fast it moves."
    source = "Gaussian bumps"
    signature = "anything that depends on place or speed"
    engines = ("mujoco",)

    def __init__(self, words: str, force_model: UnknownJointForce | UnknownBodyForce) -> None:
        """Make it from a force model and a description of what this depends on."""
        super().__init__()
        self.words, self._force_model = words, force_model

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return the sizes of the bumps."""
        return tuple(Parameter(f"size[{k}]", "-", 0.0, -100.0, 100.0, 1.0) for k in range(self._force_model.count))

    def force_model(self, m: mujoco.MjModel) -> UnknownJointForce | UnknownBodyForce:  # noqa: ARG002
        """Return the force."""
        return self._force_model
