"""Effects compared beside nominal values: what these take up within their tolerance is no evidence of an effect.

Which effect is missing may show only where masses, lengths, gains and the like may differ from their nominal values as
well: one that stands in for their errors explains more without them, the missing one beside them. All of them count
here, each up to its bounds, by a linear step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from concent_warp.diagnosis.candidates.candidate import FittedCandidate, FittedModel, ScreenedCandidate
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.search.nominal_values import NominalSensitivities
from concent_warp.effects.effect import AddedEffect
from concent_warp.effects.library.nominal import BOUND
from concent_warp.fit.effects.bounded_step import step_within
from concent_warp.fit.effects.cross_validation import Sums, block_sums
from concent_warp.fit.effects.least_squares import Linear
from concent_warp.fit.effects.nominal import possible_nominal_effects
from concent_warp.model import Model

MIN_ROOM = 1e-6
"""Least distance of a fitted nominal value from its bounds, in units of its scale [-]: the solver wants some."""


class BesideNominalValues:
    """Held-out errors of a fitted model and of candidates for it, each beside all nominal values."""

    def __init__(self, base: FittedModel, sensitivities: NominalSensitivities) -> None:
        """Prepare to compare candidates for a fitted model.

        Args:
            base: The fitted model.
            sensitivities: Those of the model to its nominal values.
        """
        self.base, self.sensitivities = base, sensitivities
        self._known: list[tuple[FittedModel | FittedCandidate, np.ndarray]] = []

    def errors(self, one: FittedModel | FittedCandidate) -> np.ndarray:
        """Return the held-out error of each block, shape (B,), of the model itself or of a candidate for it.

        Own parameters and nominal values are fitted together without each fold of blocks, nominal values within their
        bounds: a least-squares problem with bounds (Stark and Parker, Computational Statistics 10, 1995). Left out are
        nominal values that the model or the candidate stands for.
        """
        for known, errors in self._known:
            if known is one:
                return errors
        errors = self._errors(one.model, one.pieces)
        self._known.append((one, errors))
        return errors

    def tells(self, candidates: Sequence[FittedCandidate], cfg: DiagnoseCfg) -> bool:
        """Return whether candidates are to be compared beside nominal values.

        These must leave more than noise, and a candidate beside them so little that a linear step says enough.

        Args:
            candidates: The candidates, at least one.
            cfg: Settings.
        """
        least = min(self.ratio(c) for c in candidates)
        return self.ratio(self.base) > cfg.search.explained_ratio and least <= cfg.form_error_ratio

    def promoted(self, screened: Sequence[ScreenedCandidate], cfg: DiagnoseCfg) -> list[ScreenedCandidate]:
        """Return screened candidates, the best ones beside nominal values with the gain that they promise there.

        Errors of nominal values hide what such a candidate explains, and it would not be fitted. Where all leave far
        more than noise a linear step says too little, and they are returned as they are.

        Args:
            screened: The candidates.
            cfg: Settings.
        """
        model, owned = self.base.model, len(self.base.fit.values)
        added = [AddedEffect(s.effect, tuple(s.start[owned:])) for s in screened]
        models = [replace(model, effects=(*model.effects, one)) for one in added]
        pieces = [
            [replace(piece, residual=own.residual) for piece, own in zip(s.pieces, self.base.pieces, strict=True)]
            for s in screened
        ]
        before = self.errors(self.base).sum()
        left = np.array([self._errors(m, p).sum() for m, p in zip(models, pieces, strict=True)])
        gains = 1 - left / max(before, 1e-12)
        if not len(gains) or self._over_noise(left.min()) > cfg.form_error_ratio:
            return list(screened)
        least = max(cfg.search.promoted_share * gains.max(), cfg.min_gain)
        return [
            replace(s, linear_gain=max(s.linear_gain, float(gain))) if gain >= least else s
            for s, gain in zip(screened, gains, strict=True)
        ]

    def ratio(self, one: FittedModel | FittedCandidate) -> float:
        """Return the held-out errors as a root mean square over the noise [-]."""
        return self._over_noise(self.errors(one).sum())

    def _over_noise(self, total: float) -> float:
        """Return a sum of squares as a root mean square over the noise [-]."""
        count = sum(len(piece.residual) for piece in self.base.pieces)
        return self.base.noise_scale * float(np.sqrt(max(total, 0.0) / max(count, 1)))

    def _errors(self, model: Model, pieces: Sequence[Linear]) -> np.ndarray:
        """Return the held-out errors of a model with residuals and sensitivities to all its parameters, shape (B,)."""
        base, prior = self.base, self.base.cfg.least_squares.prior
        fitted = {(a.effect.name, target) for a in base.model.effects for target in a.effect.target}
        kinds = possible_nominal_effects(model)
        wanted = [(k.name, target) for k in kinds for target in k.target if (k.name, target) not in fitted]
        columns = np.nan_to_num(self.sensitivities.named(wanted), posinf=0.0, neginf=0.0) / prior
        more = np.split(columns, np.cumsum([len(piece.residual) for piece in pieces])[:-1])
        joined = [
            replace(piece, jacobian=np.hstack([piece.jacobian, of])) for piece, of in zip(pieces, more, strict=True)
        ]
        low, high = _own_bounds(model)
        bound = np.full(columns.shape[1], prior * BOUND)
        low, high = np.concatenate([low, -bound]), np.concatenate([high, bound])
        return _held_out(block_sums(joined, base.blocks, base.limit), base.blocks.fold, prior, low, high)


def _own_bounds(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much the parameters of a model's effects may change, in units of their scales, (P,) each.

    Nominal values stay within their bounds; others are free.
    """
    plain = replace(model, effects=()).compile()
    rooms = [
        (min(p.low - v, -MIN_ROOM * p.scale) / p.scale, max(p.high - v, MIN_ROOM * p.scale) / p.scale)
        if added.effect.nominal
        else (-np.inf, np.inf)
        for added in model.effects
        for p, v in zip(added.effect.parameters(plain), added.values, strict=True)
    ]
    low, high = np.array(rooms).reshape(-1, 2).T
    return low, high


def _held_out(sums: Sums, fold: np.ndarray, prior: float, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the held-out error of each block, shape (B,), of a linear step within bounds.

    Args:
        sums: Sums over the blocks.
        fold: Fold of each block, shape (B,).
        prior: Standard deviation of the weak prior of all parameters.
        low: Lower bounds of the step, shape (P,).
        high: Upper bounds of the step, shape (P,).
    """
    errors = np.array(sums.square)
    if not len(low):
        return errors
    for f in np.unique(fold):
        out = fold == f
        normal = sums.normal[~out].sum(axis=0) + np.eye(len(low)) / prior**2
        step = step_within(normal, sums.slope[~out].sum(axis=0), low, high)
        curved = np.einsum("bij,i,j->b", sums.normal[out], step, step)
        errors[out] += 2 * sums.slope[out] @ step + curved
    return errors
