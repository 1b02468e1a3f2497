"""Nominal values within their tolerance: those that show in the data are fitted before effects are searched for."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from concent_warp.diagnosis.candidates.baseline import fitted_model
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.cfg import DiagnoseCfg, NominalCfg
from concent_warp.effects.effect import AddedEffect, Effect
from concent_warp.fit.effects.cross_validation import HeldOut, block_sums
from concent_warp.fit.effects.intervals import FittedParameter
from concent_warp.fit.effects.nominal import possible_nominal_effects
from concent_warp.fit.effects.robust import huber_weight
from concent_warp.model import Model


def with_nominal_values(
    base: FittedModel,
    cfg: NominalCfg,
    min_gain: float,
    sensitivities: NominalSensitivities | None = None,
    dependent: bool = False,
) -> FittedModel | None:
    """Return a fitted model with the nominal values that the data show within their tolerance, before other effects.

    It is None where none shows, or where they remove too little of the held-out error.

    Args:
        base: The fitted model.
        cfg: Settings.
        min_gain: Share of the held-out error that they must remove [-].
        sensitivities: Those of the model to its nominal values; by default they are simulated.
        dependent: Whether those that others can stand in for are fitted, too, where one of these runs to its bound and
            more than noise is left. Many values near their bounds at once are less plausible than an effect that is
            missing, and more plausible than another one beside an effect.
    """
    visible, promised = _visible(base, cfg, sensitivities := sensitivities or nominal_sensitivities(base))
    if not visible or promised < cfg.promised_share * min_gain:
        return None
    found = _fitted(base, visible)
    if dependent and not stays_within(found, cfg):
        visible, _ = _visible(base, cfg, sensitivities, independent=False)
        found = min(found, _fitted(base, visible), key=lambda one: one.fit.cost)
    sums, prior = block_sums(found.pieces, found.blocks, base.limit), base.cfg.least_squares.prior
    # Here the values themselves are judged: each fold is predicted from those of the others.
    errors = HeldOut(sums, found.blocks, prior).of_fit()
    kept = _without_worst(errors - base.errors, cfg.left_out_share)
    return found if errors[kept].sum() <= (1 - min_gain) * base.errors[kept].sum() else None


def _without_worst(worse: np.ndarray, share: float) -> np.ndarray:
    """Return the indices of blocks (B,) without a share of them, at least one, that become the worst."""
    return np.argsort(worse, kind="stable")[: len(worse) - max(round(share * len(worse)), 1)]


def _fitted(base: FittedModel, nominal: Sequence[Effect]) -> FittedModel:
    """Return a fitted model with nominal values, all fitted together."""
    compiled = base.model.compile()
    added = [AddedEffect(e, tuple(p.null for p in e.parameters(compiled))) for e in nominal]
    solver = replace(base, model=replace(base.model, effects=(*added, *base.model.effects))).solver()
    count = len(solver.p.start) - len(base.fit.values)
    start = np.concatenate([solver.p.start[:count], base.fit.values])
    # Within the tolerance residuals are in proportion to the values: no polish is needed.
    fit = solver.fit(start, base.fit.offsets, base.fit.starts)
    return fitted_model(solver.p.model(fit.values), base.windows, base.blocks, fit, base.engine, base.cfg)


def stays_within(found: FittedModel, cfg: NominalCfg, enough: Callable[[FittedModel], bool] | None = None) -> bool:
    """Return whether none of a model's nominal values runs to its bound while more than noise is left.

    Something larger is missing where one does.

    Args:
        found: The fitted model with nominal values.
        cfg: Settings.
        enough: Whether a model with up to `NominalCfg.max_bounded_share` of its values at their bounds leaves little
            enough; by default `NominalCfg.bounded_ratio`.
    """
    if found.ratio <= cfg.bounded_ratio or not (share := bounded_share(found.model)):
        return True
    return enough is not None and share <= cfg.max_bounded_share and enough(found)


def nominal_effects(model: Model) -> list[int]:
    """Return which of a model's effects are nominal values, by their indices."""
    return [i for i, added in enumerate(model.effects) if added.effect.nominal]


def has_bounded_nominal_values(model: Model) -> bool:
    """Return whether a nominal value of a model is at its bound."""
    return bounded_share(model) > 0


def bounded_share(model: Model) -> float:
    """Return which share of a model's nominal values are at their bounds, 0..1; 0 where it has none."""
    plain = replace(model, effects=()).compile()
    bounded = [
        FittedParameter.within(p, value, 0.0).at_bound
        for added in model.effects
        if added.effect.nominal
        for p, value in zip(added.effect.parameters(plain), added.values, strict=True)
    ]
    return float(np.mean(bounded)) if bounded else 0.0


def without_nominal_values(last: FittedModel) -> FittedModel:
    """Return the fitted model with its nominal values as given, all that is left fitted again."""
    dropped = nominal_effects(last.model)
    effects = tuple(a for i, a in enumerate(last.model.effects) if i not in dropped)
    solver = replace(last, model=replace(last.model, effects=effects)).solver()
    fit = solver.fit(offsets=last.fit.offsets, starts=last.fit.starts)
    return fitted_model(solver.p.model(fit.values), last.windows, last.blocks, fit, last.engine, last.cfg)


@dataclass(frozen=True)
class NominalSensitivities:
    """Sensitivities of a fitted model's residuals to nominal values, initial states eliminated."""

    names: tuple[tuple[str, str], ...]
    """Name of the effect and its target."""
    columns: np.ndarray
    """Sensitivities in units of the tolerances, shape (n, K)."""

    def of(self, kinds: Sequence[Effect]) -> np.ndarray:
        """Return the sensitivities to some nominal values alone, shape (n, k)."""
        return self.named(self.names_of(kinds))

    def names_of(self, kinds: Sequence[Effect]) -> list[tuple[str, str]]:
        """Return the names and targets of some nominal values, in the order of their columns."""
        wanted = {(effect.name, target) for effect in kinds for target in effect.target}
        return [name for name in self.names if name in wanted]

    def named(self, names: Iterable[tuple[str, str]]) -> np.ndarray:
        """Return the sensitivities to nominal values of these names and targets alone, shape (n, k)."""
        wanted = set(names)
        return self.columns[:, [name in wanted for name in self.names]]


def nominal_sensitivities(base: FittedModel) -> NominalSensitivities:
    """Return the sensitivities of a fitted model's residuals to all its nominal values."""
    kinds = possible_nominal_effects(base.model)
    names = tuple((effect.name, target) for effect in kinds for target in effect.target)
    rows = sum(len(piece.residual) for piece in base.pieces)
    columns = np.concatenate(_sensitivities(base, kinds)) if kinds else np.zeros((rows, 0))
    return NominalSensitivities(names, columns)


def nominal_errors(
    last: FittedModel, cfg: DiagnoseCfg, sensitivities: NominalSensitivities | None = None
) -> np.ndarray:
    """Return standard deviations of a model's parameters due to errors of nominal values, in units of their scale (P,).

    A nominal value that is off by d moves the other parameters by -(J' J)^-1 J' K d, with the sensitivities J of the
    residuals to these and K to that one (consider covariance: Tapley, Schutz and Born, "Statistical Orbit
    Determination", 2004, chapter 6). Errors d have their tolerance as a prior, and change the residuals, the parameters
    adapted, by no more than what the model leaves beyond the noise, or than what counts as noise still
    (`DiagnoseCfg.min_gain`): larger ones would show. For effects those that were fitted are known no better than that,
    as what is left may be the error of a formula; they themselves are as uncertain as those that stayed as given, for
    which they may stand, make them. Left out are those that an effect of the model stands for (`Effect.is_within`).

    Args:
        last: The fitted model.
        cfg: Settings.
        sensitivities: Those to its nominal values, or of the model without its last effect, which differ little where
            that explains the data; by default they are simulated.
    """
    spread = np.zeros(len(last.fit.values))
    kinds = possible_nominal_effects(last.model)
    if not len(spread) or not kinds or not cfg.nominal.enabled:
        return spread
    parts = list(zip(last.model.effects, last.prediction().split, strict=True))
    nominal = np.concatenate([np.full(part.stop - part.start, added.effect.nominal) for added, part in parts])
    weights = [np.sqrt(huber_weight(piece.residual, last.limit))[:, None] for piece in last.pieces]
    j = np.concatenate([piece.jacobian * w for piece, w in zip(last.pieces, weights, strict=True)])
    known = sensitivities or nominal_sensitivities(last)
    k = np.nan_to_num(known.of(kinds) * np.concatenate(weights), posinf=0.0, neginf=0.0)
    excess = max(last.ratio**2 - 1, cfg.min_gain) / last.noise_scale**2
    prior = last.cfg.least_squares.prior
    if not nominal.all():
        spread[~nominal] = considered_std(j[:, ~nominal], k, excess, prior)
    fitted = {
        (added.effect.name, target) for added, _ in parts if added.effect.nominal for target in added.effect.target
    }
    others = [name not in fitted for name in known.names_of(kinds)]
    if nominal.any() and any(others):
        spread[nominal] = considered_std(j, k[:, others], excess, prior)[nominal]
    return spread


def considered_std(j: np.ndarray, k: np.ndarray, excess: float, prior: float) -> np.ndarray:
    """Return standard deviations of P fitted parameters due to errors of K others, of which each has the prior N(0, 1).

    Args:
        j: Sensitivities of the residuals to the fitted parameters, shape (n, P).
        k: The same to the others, shape (n, K).
        excess: Mean squared change of the residuals by these, fitted parameters adapted, that may go unseen [-].
        prior: Standard deviation of the weak prior of the fitted parameters.
    """
    move = -np.linalg.pinv(j.T @ j + np.eye(j.shape[1]) / prior**2, hermitian=True) @ (j.T @ k)
    left = k + j @ move
    within = np.linalg.inv(np.eye(k.shape[1]) + left.T @ left / (len(left) * excess))
    return np.sqrt(np.maximum(np.diag(move @ within @ move.T), 0.0))


def _sensitivities(base: FittedModel, kinds: Sequence[Effect]) -> list[np.ndarray]:
    """Return the sensitivities of the residuals to nominal values, initial states eliminated, one (n, K) a window.

    They are in units of the tolerances, in the order of the effects and their targets.
    """
    columns: list[list[np.ndarray]] = []
    for effect in kinds:
        solver = base.solver(effect)
        linear = solver.linearise(solver.p.start, base.fit.offsets, base.fit.linear, residual_known=not effect.prepares)
        pieces = base.projected(replace(base.fit, linear=linear))
        columns.append([base.cfg.least_squares.prior * piece.jacobian[:, solver.p.owned :] for piece in pieces])
    return [np.hstack(of_window) for of_window in zip(*columns, strict=True)]


def _visible(
    base: FittedModel, cfg: NominalCfg, sensitivities: NominalSensitivities, *, independent: bool = True
) -> tuple[list[Effect], float]:
    """Return the nominal values that change the predictions measurably within their tolerance, as effects.

    Independent ones are those whose changes others cannot produce, the most visible first. With them comes the share of
    the held-out error that a linear step within their prior promises to remove.
    """
    present = {a.effect.name for a in base.model.effects}
    kinds = [e for e in possible_nominal_effects(base.model) if e.name not in present]
    if not kinds:
        return [], 0.0
    owners = [(effect, target) for effect in kinds for target in effect.target]
    columns, prior = sensitivities.of(kinds), base.cfg.least_squares.prior
    by_window = np.split(columns, np.cumsum([len(piece.residual) for piece in base.pieces])[:-1])
    chosen = _independent(columns, cfg) if independent else _most_visible(columns, cfg)
    seen = [
        replace(piece, jacobian=np.hstack([piece.jacobian, np.nan_to_num(of[:, chosen]) / prior]))
        for piece, of in zip(base.pieces, by_window, strict=True)
    ]
    promised = float(
        1
        - HeldOut(block_sums(seen, base.blocks, base.limit), base.blocks, prior).own().sum()
        / max(base.errors.sum(), 1e-12)
    )
    found = []
    for effect in kinds:
        names = [owners[k][1] for k in sorted(chosen) if owners[k][0] is effect]
        if names:
            found.append(type(effect)(*names))
    return found, promised


def _most_visible(columns: np.ndarray, cfg: NominalCfg) -> list[int]:
    """Return which columns (n, K) change the residuals by more than `min_change`, the most visible first."""
    sizes = np.linalg.norm(np.nan_to_num(columns, posinf=0.0, neginf=0.0), axis=0)
    order = np.argsort(-sizes, kind="stable")
    return [int(k) for k in order if sizes[k] >= cfg.min_change * np.sqrt(len(columns))][: cfg.max_values]


def _independent(columns: np.ndarray, cfg: NominalCfg) -> list[int]:
    """Return which columns (n, K) change the residuals by more than `min_change` beyond those chosen before them.

    What is left of a column must also be more than its own errors. Gram-Schmidt with pivoting (Golub and Van Loan,
    "Matrix Computations", 2013, section 5.4).
    """
    left, chosen = np.nan_to_num(columns, posinf=0.0, neginf=0.0), []
    least = np.maximum(cfg.min_change * np.sqrt(len(columns)), cfg.min_independent * np.linalg.norm(left, axis=0))
    while len(chosen) < cfg.max_values:
        sizes = np.linalg.norm(left, axis=0)
        k = int(np.argmax(np.where(sizes >= least, sizes, 0.0)))
        if sizes[k] < least[k]:
            break
        chosen.append(k)
        direction = left[:, k] / sizes[k]
        left = left - np.outer(direction, direction @ left)
        left[:, k] = 0.0
    return chosen
