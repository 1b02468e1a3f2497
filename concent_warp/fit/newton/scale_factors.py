"""Factors on friction, contact stiffness and mass that gradients through Newton lead to from a recording.

One candidate for each of them descends by itself, all as parallel worlds of the same rollout: it steps against the sign
of the slope in the logarithm of its factor, keeps its best iterate, and shortens its step where the loss rises, is not
finite, or the slope turns. The loss is that of equation 1, as `fit.newton_loss` differentiates it.

Factors are relative to Newton's own contacts. Their effect in MuJoCo has to be evaluated in MuJoCo.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from concent_warp.checks import Positive, PositiveInterval
from concent_warp.errors import EngineError, ModelError, RecordingError
from concent_warp.estimation.object_tracks import Segment, whole_demonstration
from concent_warp.fit.newton.horizon import HorizonCfg, gradient_segments
from concent_warp.fit.newton.loss import NewtonLoss, mujoco_loss
from concent_warp.fit.newton.physics import NewtonCfg
from concent_warp.fit.newton.scene import newton_scene
from concent_warp.fit.newton.worlds import Parameters
from concent_warp.model import Model
from concent_warp.recording.recording import Recording


@dataclass(frozen=True)
class FactorCfg:
    """Settings of the descent."""

    iterations: int = 8
    """Steps at most; each costs two simulations of each factor on each stretch in Newton."""
    step: Positive = 0.3
    """First step of the logarithm of a factor [-]."""
    smallest_step: Positive = 0.03
    """Step of the logarithm of a factor below which its descent ends [-]."""
    min_gain: float = 0.05
    """Share by which a factor must lower the loss; otherwise it counts as 1 [-]. Empirical."""
    friction_range: PositiveInterval = (0.2, 5.0)
    """Smallest and largest factor on friction [-]."""
    stiffness_range: PositiveInterval = (0.25, 2.0)
    """Smallest and largest factor on stiffness [-]: contacts stay stable within them."""
    mass_range: PositiveInterval = (0.7, 2.0)
    """Smallest and largest factor on masses [-]: contacts stay stable within them."""
    max_engine_ratio: Positive = 5.0
    """Loss of the model in Newton over that in MuJoCo above which gradients are not used [-]: Newton then simulates
    another motion, such as a slipping grasp. Empirical."""
    device: str | None = None
    """Where Newton runs, "cpu" or "cuda:0"; None takes CUDA where there is a device."""
    horizon: HorizonCfg = field(default_factory=HorizonCfg)
    """Windows over which gradients are computed."""
    newton: NewtonCfg = field(default_factory=lambda: NewtonCfg(shortest_step=5e-5))
    """How contacts are simulated."""


@dataclass(frozen=True)
class Factors:
    """Factors by gradients; 1 where a factor does not lower the loss."""

    friction: float
    """On the friction of all contacts [-]."""
    stiffness: float
    """On the stiffness of all contacts, their damping ratio kept [-]."""
    mass: dict[str, float]
    """On mass and inertia of each simulated body [-]."""
    before: float
    """Chamfer distance of the model in Newton [m]."""
    mujoco: float
    """The same in MuJoCo [m]."""
    after: dict[str, float]
    """Lowest distance of each factor [m]: "friction", "stiffness", and bodies by name for their mass."""
    simulations: int
    """Rollouts in Newton; a backward run counts as one too."""
    simulated: float
    """Time that they covered [s]."""


class FactorDescent:
    """Descends on one factor per candidate: friction, stiffness, then the mass of each simulated body."""

    def __init__(self, model: Model, recording: Recording, cfg: FactorCfg | None = None) -> None:
        """Prepare.

        Raises:
            ModelError: The model has no contact geometry on a free body, or a shape that Newton's contacts lack comes
                near.
            RecordingError: The recording observes no object with contact geometry.
            EngineError: The scene cannot be simulated stably.
        """
        self.cfg = cfg = cfg or FactorCfg()
        segments = _stretches(model, recording, cfg.horizon)
        self.scene = newton_scene(model, segments, cfg.newton, lightest=cfg.mass_range[0])
        self.loss = NewtonLoss(self.scene, 2 + len(self.scene.moving), device=cfg.device)
        geometry = model.geometry
        assert geometry is not None
        m = model.compile()
        of_geom = [m.geom(name).id for name in geometry.names()]
        count = self.loss.count
        self._position = np.repeat(geometry.position[None], count, axis=0)
        # Effects that the model has set the friction of geoms, not of the geometry.
        self._friction = np.repeat(m.geom_friction[of_geom, 0][None], count, axis=0)
        limits = np.log([cfg.friction_range, cfg.stiffness_range, *(cfg.mass_range for _ in self.scene.moving)])
        self._low, self._high = limits.T

    def parameters(self, factor: np.ndarray) -> Parameters:
        """Return the candidates of factors, one each, shape (P,)."""
        count, rows = len(factor), np.arange(2, len(factor))
        friction, stiffness, mass = np.ones(count), np.ones(count), np.ones((count, count - 2))
        friction[0], stiffness[1] = factor[0], factor[1]
        mass[rows, rows - 2] = factor[2:]
        return Parameters(
            self._position,
            friction=self._friction,
            friction_scale=friction,
            stiffness_scale=stiffness,
            mass_scale=mass,
        )

    def slopes(self, factor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the losses [m] at factors (P,), and their slopes against the logarithm of each, shape (P,) both."""
        found = self.loss(self.parameters(factor))
        rows = np.arange(2, len(factor))
        slope = np.concatenate(
            [
                found.by["friction_scale"][:1],
                found.by["stiffness_scale"][1:2],
                found.by["mass_scale"][rows, rows - 2],
            ]
        )
        return found.loss, slope * factor

    def run(self) -> Factors:
        """Descend.

        Raises:
            EngineError: Newton simulates another motion than MuJoCo.
        """
        cfg, count = self.cfg, self.loss.count
        now, best, direction = np.zeros(count), np.zeros(count), np.zeros(count)
        lowest, step = np.full(count, np.inf), np.full(count, cfg.step)
        before = mujoco = np.inf
        for iteration in range(cfg.iterations):
            loss, slope = self.slopes(np.exp(now))
            if iteration == 0:
                before, mujoco = float(loss[0]), mujoco_loss(self.loss.objective, self.scene)
                self._agree(before, mujoco)
            better = np.isfinite(loss) & np.isfinite(slope) & (loss < lowest)
            turned = better & (np.sign(slope) * direction > 0)
            step *= np.where(better & ~turned, 1.2 if iteration else 1.0, 0.5)
            best, lowest = np.where(better, now, best), np.where(better, loss, lowest)
            direction = np.where(better, -np.sign(np.nan_to_num(slope)), direction)
            now = np.clip(best + step * direction, self._low, self._high)
            if not ((step > cfg.smallest_step) & (now != best)).any():
                break
        factor = np.where(lowest < (1 - cfg.min_gain) * before, np.exp(best), 1.0)
        names = [body.name for body in self.scene.moving]
        return Factors(
            float(factor[0]),
            float(factor[1]),
            dict(zip(names, factor[2:].tolist(), strict=True)),
            before,
            mujoco,
            dict(zip(["friction", "stiffness", *names], lowest.tolist(), strict=True)),
            self.loss.simulations,
            self.loss.simulations * self.scene.steps * self.scene.physics.timestep,
        )

    def _agree(self, newton: float, mujoco: float) -> None:
        """Check that both simulators simulate the same motion, by the distances of the model from it [m]."""
        if not newton <= self.cfg.max_engine_ratio * mujoco:
            raise EngineError(
                "Newton simulates another motion than MuJoCo, so that its gradients are of no use",
                where=", ".join(s.name for s in self.scene.segments),
                expected=f"objects at most {1e3 * self.cfg.max_engine_ratio * mujoco:.2g} mm from what was observed",
                found=f"{1e3 * newton:.2g} mm",
                fix="take demonstrations in which nothing is grasped",
            )


def _stretches(model: Model, recording: Recording, cfg: HorizonCfg) -> list[Segment]:
    """Return what is to be simulated of the demonstrations that show an object with contact geometry.

    Raises:
        ModelError: The model has no contact geometry.
        RecordingError: No demonstration shows such an object.
    """
    if model.geometry is None:
        raise ModelError(
            "gradients through Newton need contact geometry of spheres",
            where=model.scene.source,
            fix="build it with `concent geometry`",
        )
    shown, segments, why = [], [], None
    for demonstration in recording.demonstrations:
        try:
            segments.append(whole_demonstration(model.scene, demonstration, model.geometry.bodies))
        except RecordingError as error:
            why = error
            continue
        shown.append(demonstration)
    if not segments:
        assert why is not None
        raise why
    return gradient_segments(model, segments, shown, cfg)


def factors(model: Model, recording: Recording, cfg: FactorCfg | None = None) -> Factors:
    """Return the factors on friction, stiffness and mass that gradients through Newton lead to.

    Args:
        model: Model with contact geometry on objects that move freely.
        recording: What was commanded, and points or poses of the objects.
        cfg: Settings.

    Raises:
        ModelError: See `FactorDescent`.
        RecordingError: See there.
        EngineError: The scene cannot be simulated stably, or Newton simulates another motion than MuJoCo.
    """
    return FactorDescent(model, recording, cfg).run()
