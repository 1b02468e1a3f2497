"""One interface for two simulators: many variants of a model, simulated at once.

Time convention: step k starts at time k * dt. What a rollout records at step k is the state at that time, and the
sensors, body poses, contacts and contact forces that MuJoCo computes from this state and from the command held during
step k. So all fields of one record belong to the same instant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

if TYPE_CHECKING:
    import mujoco

    from concent_warp.effects.force_model import ForceModel
    from concent_warp.model import Model
    from concent_warp.scene.payloads import Payload

Contacts = Literal["none", "touched", "all"]
"""What a rollout keeps of the contacts: nothing, which geoms ever touched which bodies, or all of every step."""


@dataclass(frozen=True)
class Variants:
    """N variants of one model. What is None is as in the model."""

    count: int
    sphere_position: Any = None
    """Sphere centres [m], body frame, shape (N, S, 3); S counts the spheres of the model's geometry."""
    sphere_radius: Any = None
    """Sphere radii [m], shape (N, S)."""
    sphere_friction: Any = None
    """Sliding friction of the spheres [-], shape (N, S)."""
    fields: Mapping[str, Any] = field(default_factory=dict)
    """Values of `mujoco.MjModel` fields by name, each of shape (N, *field shape)."""
    qpos: Any = None
    """Initial generalised positions, shape (N, nq)."""
    qvel: Any = None
    """Initial generalised velocities, shape (N, nv)."""
    force_models: Sequence[tuple[ForceModel, Any]] | None = None
    """Force models that act, each with its parameters, shape (N, P); None: those of the model's effects with the
    model's values."""


@dataclass(frozen=True)
class ContactLog:
    """Every active contact of every simulated step; C rows, sorted by variant, then step, then geom pair."""

    variant: np.ndarray
    """Variant index, shape (C,)."""
    step: np.ndarray
    """Simulation step, shape (C,)."""
    geom: np.ndarray
    """Geom ids of the compiled model, shape (C, 2), the smaller id first."""
    position: np.ndarray
    """Contact point [m], world frame, shape (C, 3)."""
    normal: np.ndarray
    """Unit normal, world frame, from the first geom to the second, shape (C, 3)."""
    distance: np.ndarray
    """Signed gap [m], negative in penetration, shape (C,)."""
    force: np.ndarray
    """Contact force on the second geom [N], world frame, shape (C, 3)."""


@dataclass(frozen=True)
class Rollout:
    """What an engine returns: R records of N variants.

    Arrays are NumPy from `MujocoEngine` and torch tensors on the simulation device from `WarpEngine`; `numpy()` gives
    a rollout of NumPy arrays.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> rollout = cw.replay(cw.Model.from_recording(recording), recording)["demo_0"]
        >>> rollout.qpos.shape == (1, len(rollout.time), 1)
        True
    """

    step: np.ndarray
    """Recorded simulation steps, shape (R,), int."""
    time: np.ndarray
    """Their times [s], shape (R,)."""
    bodies: tuple[str, ...]
    """Bodies whose poses are recorded, B of them."""
    qpos: Any
    """Generalised positions, shape (N, R, nq)."""
    qvel: Any
    """Generalised velocities, shape (N, R, nv)."""
    sensordata: Any
    """Predicted sensors, shape (N, R, nsensordata)."""
    body_position: Any
    """Body frame origins [m], world frame, shape (N, R, B, 3)."""
    body_quaternion: Any
    """Body orientations, wxyz, shape (N, R, B, 4)."""
    touched: Any
    """Whether geom g was ever in contact with a geom of body b, shape (N, ngeom, nbody) bool; None if not asked."""
    contacts: ContactLog | None
    """Every contact, if asked."""
    diverged: Any
    """Whether a variant stopped being finite or was reset by the simulator, shape (N,) bool."""

    def numpy(self) -> Rollout:
        """Return the same rollout with NumPy arrays on the host."""
        values = {}
        for name, value in vars(self).items():
            values[name] = value.detach().cpu().numpy() if hasattr(value, "detach") else value
        return Rollout(**values)


class Engine(Protocol):
    """Simulates many variants of one model."""

    def __init__(self, model: Model, *, collidable: np.ndarray | None = None) -> None:
        """Prepare to simulate `model`.

        `collidable`, shape (S,) bool, leaves out of the physics the spheres that are False.
        """
        ...

    @property
    def timestep(self) -> float:
        """The model's time step [s]."""
        ...

    @property
    def compiled(self) -> mujoco.MjModel:
        """The compiled model that geom ids refer to. Not to be edited."""
        ...

    def carrying(self, payloads: tuple[Payload, ...]) -> Engine:
        """Return the engine for demonstrations in which bodies carried payloads; this one where there are none.

        Geoms, joints, actuators and sensors are the same; bodies are counted otherwise.
        """
        ...

    def run(
        self,
        variants: Variants,
        ctrl: np.ndarray,
        *,
        record: Sequence[int] | np.ndarray | None = None,
        bodies: Sequence[str] | None = None,
        contacts: Contacts = "none",
    ) -> Rollout:
        """Simulate all variants.

        Args:
            variants: N variants.
            ctrl: Commands, shape (K, nu) for all variants alike, or (n, K, nu) where n divides N: variant i follows
                those of row i % n. K is the number of steps.
            record: Steps to record, each in 0..K, increasing; None records all, 0..K.
            bodies: Bodies whose poses are recorded; None records all.
            contacts: What to keep of the contacts, over the steps 0..K-1.

        Raises:
            EngineError: Contacts or constraints overflow buffers that cannot grow further, or a field cannot be varied
                by this engine (the message names the engine that can).
        """
        ...
