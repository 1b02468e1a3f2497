"""Payloads: known weights that bodies carry during a demonstration, and that the scene does not have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np

from concent_warp.scene.scene import Scene

PAYLOAD_HEADER = ("body", "mass", "x", "y", "z", "ixx", "iyy", "izz")
"""Columns of a table of payloads."""
PAYLOAD_NUMBERS = len(PAYLOAD_HEADER) - 1
"""Mass, position and inertia of a payload."""
LEAST_INERTIA = 1e-9
"""Moment of inertia that the compiler accepts of a body, for payloads that are taken as points [kg m^2]."""


@dataclass(frozen=True)
class Payload:
    """A rigid weight fastened to a body for a whole demonstration.

    Mass and place are taken as exact: weigh it. Mass and load of what it hangs on differ then from those of other
    demonstrations by a known amount, which tells effects apart that are otherwise alike, such as another mass of the
    body and another gain of its drive.

    Example:
        >>> import concent_warp as cw
        >>> cw.Payload("arm", 0.25, (0.0, 0.0, -0.1)).inertia
        (0.0, 0.0, 0.0)
    """

    body: str
    """The body that carries it."""
    mass: float
    """[kg]"""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Its centre of mass [m], in the frame of the body."""
    inertia: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Its moments of inertia about its centre of mass [kg m^2], about axes parallel to those of the body; 0 for a
    weight that is small against its distance from what it turns about."""

    @property
    def numbers(self) -> tuple[float, ...]:
        """Mass, position and inertia, in this order."""
        return (self.mass, *self.position, *self.inertia)

    @staticmethod
    def of(body: str, numbers: Sequence[float] | np.ndarray) -> Payload:
        """Return the payload of a body from what `numbers` gives, shape (7,)."""
        mass, x, y, z, xx, yy, zz = (float(n) for n in numbers)
        return Payload(body, mass, (x, y, z), (xx, yy, zz))


def fasten(spec: mujoco.MjSpec, payloads: Sequence[Payload]) -> None:
    """Fasten payloads to the bodies of a spec, each a body of its own without a geom: nothing touches it."""
    taken = {body.name for body in spec.bodies}
    for k, payload in enumerate(payloads):
        name = f"{payload.body}_payload{k}"
        while name in taken:
            name += "_"
        taken.add(name)
        spec.body(payload.body).add_body(
            name=name,
            pos=payload.position,
            mass=payload.mass,
            ipos=np.zeros(3),  # where it is not given, the MJCF that is written lacks mass and inertia
            inertia=np.maximum(payload.inertia, LEAST_INERTIA),
            explicitinertial=True,
        )


@lru_cache(maxsize=64)
def scene_with_payloads(scene: Scene, payloads: tuple[Payload, ...]) -> Scene:
    """Return a scene in which bodies carry payloads; joints, geoms, actuators and sensors are the same."""
    spec = scene.spec()
    fasten(spec, payloads)
    return Scene.from_spec(spec, scene.source)
