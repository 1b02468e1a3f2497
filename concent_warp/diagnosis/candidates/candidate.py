"""What the search passes on: the fitted baseline model, and candidates as screened and as fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from concent_warp.effects.effect import Effect
from concent_warp.estimation.noise_ratio import noise_ratio
from concent_warp.fit.effects.cfg import EffectSolverCfg
from concent_warp.fit.effects.cross_validation import Blocks, HeldOut, Sums, block_sums
from concent_warp.fit.effects.least_squares import Fit, Linear, Solver, projected
from concent_warp.fit.effects.observation import Window
from concent_warp.fit.effects.prediction import Prediction
from concent_warp.fit.effects.robust import robust_noise_ratio
from concent_warp.model import Model
from concent_warp.simulate.select import EngineName


def nominal_parameters(model: Model) -> np.ndarray:
    """Return which parameters of a model's effects are nominal values, shape (P,) bool."""
    found = [np.full(len(added.values), added.effect.nominal) for added in model.effects]
    return np.concatenate([np.zeros(0, dtype=bool), *found])


@dataclass(frozen=True)
class FittedModel:
    """A model with its own parameters and the initial states fitted: the baseline that a candidate must beat."""

    model: Model
    windows: tuple[Window, ...]
    blocks: Blocks
    fit: Fit
    pieces: tuple[Linear, ...]
    """Residuals and sensitivities to the model's own parameters by window, initial states eliminated."""
    limit: float
    """Residual over noise above which the robust loss is linear [-]."""
    errors: np.ndarray
    """Held-out error of each block, shape (B,)."""
    engine: EngineName = "mujoco"
    cfg: EffectSolverCfg = field(default_factory=EffectSolverCfg)
    """Settings of this fit and of those of candidates."""

    @property
    def ratio(self) -> float:
        """Robust RMS residual over the noise [-]: 1 where the model explains all but noise."""
        robust = self.cfg.least_squares.robust
        return self.noise_scale * robust_noise_ratio([piece.residual for piece in self.pieces], robust)

    @property
    def noise_ratio(self) -> float:
        """Root mean square residual over the noise [-], "x noise"."""
        return self.noise_scale * noise_ratio(np.concatenate([piece.residual for piece in self.pieces]))

    @property
    def noise_scale(self) -> float:
        """Standard deviation that residuals are in units of, over that of the noise [-]; see `Window.noise_scale`."""
        return self.windows[0].noise_scale

    @property
    def timestep(self) -> float:
        """Time step of the predictions, or that for which their defects correct them [s]."""
        defect = self.windows[0].defect
        return float(self.model.scene.model.opt.timestep) if defect is None else defect.timestep

    @property
    def delivered(self) -> Model:
        """The model as it is handed out: with the time step for which defects correct its predictions."""
        if self.windows[0].defect is None:
            return self.model
        return replace(self.model, scene=self.model.scene.with_timestep(self.timestep))

    def prediction(self, *effects: Effect, windows: Sequence[Window] = ()) -> Prediction:
        """Return the prediction of the model with some more effects, for its own windows or others."""
        return Prediction(self.model, effects, windows or self.windows, engine=self.engine, cfg=self.cfg.prediction)

    def solver(self, *effects: Effect, windows: Sequence[Window] = ()) -> Solver:
        """Return the solver for the model with some more effects, for its own windows or others."""
        return Solver(self.prediction(*effects, windows=windows), self.cfg.least_squares)

    def held_out(self, pieces: Sequence[Linear]) -> HeldOut:
        """Return the held-out errors of residuals and sensitivities by window, over the model's blocks.

        Nominal values are those of all data in every fold: the gain is that of the effects.
        """
        sums, shared = block_sums(pieces, self.blocks, self.limit), nominal_parameters(self.model)
        shared = np.pad(shared, (0, sums.slope.shape[1] - len(shared)))
        return HeldOut(sums, self.blocks, self.cfg.least_squares.prior, shared)

    def projected(self, fit: Fit) -> list[Linear]:
        """Return residuals and sensitivities of a fit with the initial states eliminated, window by window."""
        return projected(fit, self.cfg.least_squares.robust)


@dataclass(frozen=True)
class ScreenedCandidate:
    """A candidate effect with its expected gain, before any fit."""

    effect: Effect
    linear_gain: float
    """Share of the held-out error that a linear step along its sensitivities removes [-]."""
    scanned_gain: float
    """Share that the best of a few scanned values removes [-]; 0 where none does."""
    start: np.ndarray
    """Values of all parameters from which a fit starts, shape (P,)."""
    pieces: tuple[Linear, ...]
    """Sensitivities at the null value by window, initial states eliminated."""
    measured: bool = False
    """Whether the fit starts from the measured initial states and not from the baseline's."""

    @property
    def expected_gain(self) -> float:
        """The larger of the two gains."""
        return max(self.linear_gain, self.scanned_gain)


@dataclass(frozen=True)
class FittedCandidate:
    """A candidate effect that was fitted together with the model's own parameters and the initial states."""

    effect: Effect
    model: Model
    """The model with the effect."""
    fit: Fit
    sums: Sums
    pieces: tuple[Linear, ...]
    errors: np.ndarray
    """Held-out error of each block, shape (B,)."""
    ratio: float
    """Robust RMS residual over the noise that is left [-]."""
    std: np.ndarray | None = None
    """Standard deviations of the parameters in units of their scale, shape (P,), where a profile likelihood gives them,
    see `concent_warp.diagnosis.candidates.profile_likelihood`."""
    cost_roughness: float = 0.0
    """Rise of the cost beyond its quadratic form, which local minima of the initial states cause; see there."""
    polished: bool = False
    """Whether refitting the initial states no longer lowers the cost."""

    def gain(self, base: FittedModel) -> np.ndarray:
        """Return the fall of each block's held-out error against the baseline, shape (B,)."""
        return base.errors - self.errors

    def share(self, base: FittedModel) -> float:
        """Return the gain as a share of the baseline's held-out error [-]."""
        return float(self.gain(base).sum() / max(base.errors.sum(), 1e-12))

    def removed(self, base: FittedModel) -> np.ndarray:
        """Return what it takes from the baseline's residuals, in units of the noise, shape (n,)."""
        before, after = (np.concatenate([piece.residual for piece in one.pieces]) for one in (base, self))
        return before - after
