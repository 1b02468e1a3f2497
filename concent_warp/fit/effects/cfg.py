"""Settings that `fit_effects` and a diagnosis have in common."""

from __future__ import annotations

from dataclasses import dataclass, field

from concent_warp.fit.effects.cross_validation import BlockCfg
from concent_warp.fit.effects.least_squares import LeastSquaresCfg
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.fit.effects.prediction import PredictionCfg


@dataclass(frozen=True)
class EffectSolverCfg:
    """Settings of the cutting into windows, of simulations and of least squares."""

    least_squares: LeastSquaresCfg = field(default_factory=LeastSquaresCfg)
    """Settings of the least squares."""
    observation: ObservationCfg = field(default_factory=ObservationCfg)
    """How recordings are cut into windows."""
    prediction: PredictionCfg = field(default_factory=PredictionCfg)
    """Settings of predicted readings."""
    blocks: BlockCfg = field(default_factory=BlockCfg)
    """How windows are cut into blocks and folds."""
    discretisation_error: float = 0.005
    """Relative standard deviation of an effect's size between time-stepping schemes of one force model [-]; part of the
    intervals of parameters. Empirical: from simulations with another integrator and step."""
