"""Settings that `fit_effects` and a diagnosis have in common."""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco

from concent_warp.checks import Positive
from concent_warp.fit.effects.cross_validation import BlockCfg
from concent_warp.fit.effects.least_squares import LeastSquaresCfg
from concent_warp.fit.effects.observation import ObservationCfg
from concent_warp.fit.effects.observe import has_touchable_free_body
from concent_warp.fit.effects.prediction import PredictionCfg


@dataclass(frozen=True)
class RaisedNoiseCfg:
    """When the error of a model as given takes the place of the noise in the fits of effects.

    Errors of contact models are rough: in units of a noise far below them, windows would be too short to show friction,
    and finite differences would measure jumps.
    """

    far_ratio: Positive = 20.0
    """Noise ratio of the model as given beyond which that is done where a body moves freely that can be touched [-].
    Empirical."""
    contact_ratio: Positive = 3.0
    """What the model as given then leaves, in units of the raised noise [-]. Empirical."""

    def scale(self, ratio: float, m: mujoco.MjModel) -> float:
        """Return the factor by which the noise of all channels is raised [-], 1 for not at all.

        Args:
            ratio: Noise ratio of the model as given.
            m: The compiled model.
        """
        return ratio / self.contact_ratio if ratio > self.far_ratio and has_touchable_free_body(m) else 1.0


@dataclass(frozen=True)
class EffectSolverCfg:
    """Settings of the cutting into windows, of simulations and of least squares."""

    least_squares: LeastSquaresCfg = field(default_factory=LeastSquaresCfg)
    """Settings of the least squares."""
    observation: ObservationCfg = field(default_factory=ObservationCfg)
    """How recordings are cut into windows."""
    raised_noise: RaisedNoiseCfg = field(default_factory=RaisedNoiseCfg)
    """When the model's own error takes the place of the noise."""
    prediction: PredictionCfg = field(default_factory=PredictionCfg)
    """Settings of predicted readings."""
    blocks: BlockCfg = field(default_factory=BlockCfg)
    """How windows are cut into blocks and folds."""
    discretisation_error: float = 0.005
    """Relative standard deviation of an effect's size between time-stepping schemes of one force model [-]; part of the
    intervals of parameters. Empirical: from simulations with another integrator and step."""
