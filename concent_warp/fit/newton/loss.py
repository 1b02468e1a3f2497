"""d loss / d geometry for a recording: the Chamfer objective of the fit, differentiated through Newton.

    gradient = recording_gradient(model, recording)
    gradient.position   # d loss / d sphere centre, shape (S, 3)

The loss is that of equation 1 as `fit.objective` computes it, on poses that Newton simulates in place of MuJoCo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from concent_warp.errors import EngineError
from concent_warp.estimation.object_tracks import Segment, whole_demonstration
from concent_warp.fit.geometry.objective import Objective
from concent_warp.fit.newton.physics import NewtonCfg
from concent_warp.fit.newton.scene import NewtonScene, newton_scene
from concent_warp.fit.newton.worlds import NewtonWorlds, Parameters
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from concent_warp.simulate.mujoco_engine import MujocoEngine

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class Gradients:
    """Losses of P candidates and their gradients."""

    loss: np.ndarray
    """Mean Chamfer distance over the frames of the fit [m]; infinite where Newton diverged, shape (P,)."""
    held_out: np.ndarray
    """Over the frames kept from the fit [m], shape (P,)."""
    by: dict[str, np.ndarray]
    """d loss / d parameter by name, see `Parameters`, each of its parameter's shape; NaN where it is not finite."""


class NewtonLoss:
    """The objective of a fit on candidates simulated in Newton, with gradients."""

    def __init__(
        self,
        scene: NewtonScene,
        count: int,
        *,
        held_out: float = 0.0,
        block: float = 0.2,
        squared: bool = False,
        device: str | None = None,
    ) -> None:
        """Prepare P candidates.

        Args:
            scene: What to simulate.
            count: P.
            held_out: Share of the frames kept from the fit, in blocks.
            block: Length of these blocks [s].
            squared: Squared form of the Chamfer distance.
            device: Where to simulate; by default CUDA where there is a device.
        """
        self.scene, self.count = scene, count
        self.objective = Objective(
            MujocoEngine(scene.model), list(scene.segments), held_out=held_out, block=block, squared=squared
        )
        self.worlds = NewtonWorlds(scene, count, device)
        self.rows = self.objective.record * scene.physics.substeps
        self.bodies = [scene.bodies.index(name) for name in self.objective.bodies]
        self.simulations = 0
        """Rollouts so far; a backward run counts as one too."""

    def __call__(self, parameters: Parameters) -> Gradients:
        """Return losses and gradients of P candidates."""
        import torch

        poses = self.worlds.forward(parameters)[torch.as_tensor(self.rows, device=self.worlds.torch_device)]
        poses = poses.detach().clone().requires_grad_()
        fit, held_out = self._means(poses)
        fit.sum().backward()
        assert poses.grad is not None
        by = self.worlds.backward(poses.grad, self.rows)
        self.simulations += 2 * self.worlds.worlds
        gone = ~torch.isfinite(poses.detach()).all(dim=3).all(dim=2).all(dim=0).view(self.count, -1).all(dim=1)
        lost = gone.cpu().numpy()
        losses = [np.where(lost, np.inf, x.detach().cpu().numpy().astype(float)) for x in (fit, held_out)]
        for value in by.values():
            value[lost] = np.nan
        return Gradients(losses[0], losses[1], by)

    def losses(self, parameters: Parameters) -> np.ndarray:
        """Return the losses of P candidates over the frames of the fit [m], without gradients, shape (P,)."""
        import torch

        poses = self.worlds.forward(parameters)[torch.as_tensor(self.rows, device=self.worlds.torch_device)]
        self.simulations += self.worlds.worlds
        return self._means(poses)[0].cpu().numpy().astype(float)

    def _means(self, poses: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return losses of the fit and held out, of poses of the simulated bodies (R, W, D, 7)."""
        poses = poses[:, :, self.bodies].transpose(0, 1)
        return self.objective.means(poses[..., :3], poses[..., [6, 3, 4, 5]])


@dataclass(frozen=True)
class RecordingGradient:
    """The loss of a model on a recording and its gradient."""

    loss: float
    """Mean Chamfer distance as simulated in Newton [m]."""
    mujoco_loss: float
    """The same in MuJoCo [m]: the gradient is reliable as far as the two agree."""
    position: np.ndarray
    """d loss / d sphere centre [m/m], shape (S, 3)."""
    radius: np.ndarray
    """d loss / d radius [m/m], shape (S,)."""
    friction: np.ndarray
    """d loss / d friction of a sphere [m], shape (S,); zero where the other shape's counts."""
    friction_scale: float
    """d loss / d a factor on all friction, at 1 [m]."""
    stiffness_scale: float
    """d loss / d a factor on the stiffness of Newton's contacts, at 1 [m]."""
    mass_scale: dict[str, float]
    """d loss / d a factor on mass and inertia of each simulated body, at 1 [m]."""
    scene: NewtonScene
    """What was simulated: time step, stiffness, pairs."""


def recording_gradient(
    model: Model,
    recording: Recording,
    *,
    demonstrations: Sequence[str] | None = None,
    segments: Sequence[Segment] | None = None,
    squared: bool = False,
    cfg: NewtonCfg | None = None,
    device: str | None = None,
) -> RecordingGradient:
    """Return d loss / d geometry, and with respect to friction, stiffness and mass, of a model on a recording.

    Args:
        model: Model with contact geometry.
        recording: What was commanded and observed.
        demonstrations: Names of the demonstrations; all by default.
        segments: Stretches to simulate instead of whole demonstrations, such as `fit.windows.windows` makes: gradients
            through a second of tumbling are useless.
        squared: Squared form of the Chamfer distance, in m^2 then.
        cfg: How Newton simulates contacts.
        device: Where to simulate; by default CUDA where there is a device.

    Raises:
        ModelError: The model has no contact geometry on a free body, or a shape that Newton's contacts lack comes near.
        RecordingError: The recording does not observe any movable object.
        EngineError: The scene cannot be simulated stably, or its gradient is not finite.
    """
    if segments is None:
        names = [d.name for d in recording.demonstrations] if demonstrations is None else list(demonstrations)
        bodies = () if model.geometry is None else model.geometry.bodies
        segments = [whole_demonstration(model.scene, recording[name], bodies) for name in names]
    scene = newton_scene(model, segments, cfg)
    loss = NewtonLoss(scene, 1, squared=squared, device=device)
    geometry = model.geometry
    assert geometry is not None
    found = loss(Parameters(geometry.position[None]))
    if not (np.isfinite(found.loss[0]) and all(np.isfinite(value).all() for value in found.by.values())):
        raise EngineError(
            "the gradient is not finite",
            where=", ".join(s.name for s in segments),
            expected="motion that Newton simulates stably",
            fix="take shorter windows, or the evolution strategy (--method es)",
        )
    by = found.by
    return RecordingGradient(
        loss=float(found.loss[0]),
        mujoco_loss=mujoco_loss(loss.objective, scene),
        position=by["position"][0],
        radius=by["radius"][0],
        friction=by["friction"][0],
        friction_scale=float(by["friction_scale"][0]),
        stiffness_scale=float(by["stiffness_scale"][0]),
        mass_scale={body.name: float(v) for body, v in zip(scene.moving, by["mass_scale"][0], strict=True)},
        scene=scene,
    )


def mujoco_loss(objective: Objective, scene: NewtonScene) -> float:
    """Return the loss of the MuJoCo rollout that a scene replays [m]."""
    import torch

    rollout = scene.rollout
    bodies = [rollout.bodies.index(name) for name in objective.bodies]
    position, quaternion = (
        torch.as_tensor(value[:, objective.record][:, :, bodies])
        for value in (rollout.body_position, rollout.body_quaternion)
    )
    return float(objective.means(position, quaternion)[0][0])
