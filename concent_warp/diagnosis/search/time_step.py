"""Error of the model's own time step, which must not be taken for a missing effect.

To first order, a prediction is off by a term in proportion to the time step (Hairer, Noersett and Wanner, "Solving
Ordinary Differential Equations I", 1993, section II.3), so that the difference to the prediction with half the step is
half that term. Where it is not small beside the noise, the model with a step short enough is a rival of every effect;
it has no parameters and therefore wins where both explain the data.

Where even a longer step changes little, simulations take that while effects are looked for, which is most of the time
of a diagnosis; what the model's own step changes is added in the same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from concent_warp.diagnosis.candidates.baseline import errors_like, fitted_model
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.candidates.screening import robust_sum
from concent_warp.diagnosis.cfg import DiagnoseCfg, TimeStepCfg
from concent_warp.diagnosis.constants import FinerTimeStep
from concent_warp.estimation.noise_ratio import noise_ratio
from concent_warp.fit.effects.cross_validation import bootstrap_interval, sign_flip_p
from concent_warp.fit.effects.impacts import impacts
from concent_warp.fit.effects.observation import TimeStepDefect, Window
from concent_warp.fit.effects.robust import cauchy_weight
from concent_warp.simulate.time_limit import unlimited


def longer_time_step(base: FittedModel, cfg: TimeStepCfg) -> FittedModel:
    """Return a fitted model whose simulations take longer steps where that changes little, corrected for the change.

    Where bodies in flight hit something they do not: when an impact begins between two steps is decided anew by each
    candidate, and no correction holds for all.

    Args:
        base: The fitted model, whose predictions are those of its own time step.
        cfg: Settings.
    """
    given, longest = base.timestep, _longest_step(base, cfg)
    smooth = all(w.smooth for w in base.windows)
    if not smooth and _has_impacts(base):
        return base
    most = cfg.max_error_of_longer if smooth else cfg.max_error_of_longer_in_contact
    for factor in range(cfg.max_lengthening, 1, -1):
        if factor * given > (1 + 1e-9) * longest:
            continue
        longer = with_time_step(base, factor * given)
        if _change(base, longer) <= most:
            return _with_defects(longer, given)
    return base


def corrected(one: FittedModel, timestep: float, cfg: TimeStepCfg) -> FittedModel:
    """Return a fitted model with the predictions of a shorter time step [s], fitted again."""
    return renew_defects(refitted(_with_defects(one, timestep)), cfg)


def finer_time_step(base: FittedModel, cfg: DiagnoseCfg) -> FittedModel | None:
    """Return a fitted model with a shorter time step where that explains significantly more, else None.

    Its simulations keep the step as given; what the shorter one changes is added, see `TimeStepDefect`.

    Args:
        base: The fitted model.
        cfg: Settings.
    """
    division = _division(base, cfg.time_step)
    if division < 2:
        return None
    finer = _with_defects(base, base.timestep / division)
    before = robust_sum(base, [piece.residual for piece in base.pieces])
    promised = 1 - robust_sum(base, projected_residuals(base, finer)) / max(before, 1e-12)
    if promised < cfg.search.min_expected_gain * cfg.min_gain:
        return None
    found = renew_defects(refitted(finer), cfg.time_step)
    if (begun := _at_states_of_shorter_step(found, cfg.time_step)) is not None:
        again = renew_defects(refitted(begun), cfg.time_step)
        found = min(found, again, key=lambda one: one.errors.sum())
    return found if explains_more(base, found, cfg) else None


def at_finer_step(base: FittedModel, cfg: TimeStepCfg) -> FittedModel | None:
    """Return a fitted model with a shorter time step, fitted again; None where its error is small or bodies touch.

    Args:
        base: The fitted model.
        cfg: Settings.
    """
    if not all(w.smooth for w in base.windows) or (division := _division(base, cfg)) < 2:
        return None
    return renew_defects(refitted(_with_defects(base, base.timestep / division)), cfg)


def renew_defects(one: FittedModel, cfg: TimeStepCfg) -> FittedModel:
    """Return a fitted model with a shorter time step with the defects of its own motion, fitted again until they stay.

    Where they do not come to stay, as those of contacts that begin and end anew with each motion, no more is tried.
    Without a shorter time step the model is returned as it is.

    Args:
        one: The fitted model.
        cfg: Settings.
    """
    least = np.inf
    for _ in range(cfg.max_renewals):
        if one.windows[0].defect is None:
            break
        renewed = _with_defects(one, one.timestep)
        change = noise_ratio(
            np.concatenate([_defect(a) - _defect(b) for a, b in zip(renewed.windows, one.windows, strict=True)])
        )
        one = refitted(renewed)
        if change < cfg.max_error or change > cfg.max_change_left * least:
            break
        least = change
    return one


def _at_states_of_shorter_step(one: FittedModel, cfg: TimeStepCfg) -> FittedModel | None:
    """Return a model at initial states fitted by simulations with the shorter step; None where no window needs that.

    Where states were fitted to the error of a long step, they are far from the measured ones, and defects about them
    mean little. At the measured ones the shorter step then leaves much less than the long one does; where it does not,
    something else led the states away.
    """
    limit = one.cfg.least_squares.together_ratio
    lost = [
        w
        for w, (piece, o) in enumerate(zip(one.pieces, one.fit.offsets, strict=True))
        if np.mean(piece.residual**2) > limit**2 and np.abs(o).max() > cfg.max_state_offset
    ]
    if not lost:
        return None
    plain = without_defects(one)
    finer = with_time_step(plain, one.timestep)
    solver, measured = finer.solver(), [np.zeros_like(o) for o in one.fit.offsets]
    there = replace(one.fit, offsets=tuple(measured))
    left, before = ([np.sum(r**2) for r in _projected(one, _residuals(replace(m, fit=there)))] for m in (finer, plain))
    lost = [w for w in lost if left[w] < cfg.max_misfit_left * before[w]]
    if not lost:
        return None
    # Whether the shorter step is the reason shows soon; random restarts with so many steps take the longest of all.
    iterations = max(one.cfg.least_squares.initial_states.iterations // 3, 1)
    found, starts, _ = solver.search.refined(one.fit.values, measured, lost, iterations)
    offsets = tuple(found[w] if w in starts else o for w, o in enumerate(one.fit.offsets))
    fit = replace(one.fit, offsets=offsets, starts=tuple(starts.get(w, a) for w, a in enumerate(one.fit.starts)))
    return _with_defects(replace(one, fit=fit), one.timestep)


def _defect(window: Window) -> np.ndarray:
    """Return the correction of a window's residuals, shape (count,)."""
    return np.zeros(window.count) if window.defect is None else window.defect.residual


def at_given_step(last: FittedModel, timestep: float, cfg: TimeStepCfg) -> FittedModel:
    """Return a fitted model with the time step as given [s], all parameters fitted again."""
    plain = without_defects(last)
    if plain.timestep > timestep:
        plain = _with_defects(plain, timestep)
    solver = plain.solver()
    fit = solver.fit(offsets=last.fit.offsets, starts=last.fit.starts)
    found = fitted_model(solver.p.model(fit.values), plain.windows, last.blocks, fit, last.engine, last.cfg)
    return renew_defects(found, cfg)


def finding(base: FittedModel, finer: FittedModel, seed: int) -> FinerTimeStep:
    """Return what a shorter time step changes; simulations for it are made although the time may be over.

    Args:
        base: The fitted model with its own time step.
        finer: The same with the shorter one.
        seed: Seed of the bootstrap.
    """
    gain = base.errors - errors_like(finer, base)
    low, high = bootstrap_interval(gain, base.errors, base.blocks.demonstration, np.random.default_rng(seed))
    with unlimited():
        change = [a - b for a, b in zip(_residuals(finer), _residuals(base), strict=True)]
    return FinerTimeStep(
        given=base.timestep,
        used=finer.timestep,
        change=base.noise_scale * noise_ratio(np.concatenate(_projected(base, change))),
        gain=float(gain.sum() / max(base.errors.sum(), 1e-12)),
        low=low,
        high=high,
    )


def may_be_step(last: FittedModel, step: FinerTimeStep, cfg: TimeStepCfg, *, of_any_size: bool = False) -> bool:
    """Return whether what a model leaves may be the error that the shorter time step still has.

    It may be where it is no more than that error, and where that error is so large that it may be of any size: it falls
    in proportion to the step only where it is small, not for a body that spins fast.

    Args:
        last: The fitted model.
        step: The time step that it uses.
        cfg: Settings.
        of_any_size: Whether only an error counts that may be of any size.
    """
    if step.impacts or step.error <= cfg.max_error_left:  # scatter of impacts counts as noise already
        return False
    if step.error > cfg.max_error_known:
        return True
    return not of_any_size and bool(last.noise_ratio <= np.hypot(1.0, cfg.error_factor * step.error))


def without_defects(one: FittedModel) -> FittedModel:
    """Return a model whose predictions are those of its own time step."""
    return replace(one, windows=tuple(replace(w, defect=None) for w in one.windows))


def _with_defects(one: FittedModel, timestep: float) -> FittedModel:
    """Return a model with the defects of its motion against a shorter time step [s]; not fitted again."""
    plain = without_defects(one)
    pairs = zip(plain.windows, _residuals(with_time_step(plain, timestep)), _residuals(plain), strict=True)
    return replace(one, windows=tuple(replace(w, defect=TimeStepDefect(timestep, a - b)) for w, a, b in pairs))


def refitted(one: FittedModel) -> FittedModel:
    """Return a model fitted again from where it is."""
    solver = one.solver()
    fit = solver.fit(one.fit.values, one.fit.offsets, one.fit.starts)
    fit = solver.improve_initial_states(fit, [])
    return fitted_model(solver.p.model(fit.values), one.windows, one.blocks, fit, one.engine, one.cfg)


def explains_more(base: FittedModel, finer: FittedModel, cfg: DiagnoseCfg) -> bool:
    """Return whether the held-out error falls by a relevant and significant share."""
    gain, rng = base.errors - errors_like(finer, base), np.random.default_rng(cfg.seed)
    relevant = gain.sum() >= cfg.min_gain * base.errors.sum()
    return bool(relevant and sign_flip_p(gain, rng) <= cfg.significance_level)


def projected_residuals(base: FittedModel, other: FittedModel) -> list[np.ndarray]:
    """Return the residuals of a model at a similar one's values, without what the latter's freedom takes up, each (n,).

    Args:
        base: The fitted model whose initial states and own parameters take up changes to first order.
        other: The same with other constants, not fitted.
    """
    return _without_own(base, _projected(base, _residuals(other)))


def _division(base: FittedModel, cfg: TimeStepCfg) -> int:
    """Return into how many parts to divide the time step, so that its error is small beside the noise."""
    error = 2 * _change(base, with_time_step(without_defects(base), base.timestep / 2))
    if not np.isfinite(error):
        return 1
    return int(np.clip(np.ceil(error / cfg.max_error), 1, cfg.max_division))


def _change(base: FittedModel, other: FittedModel) -> float:
    """Return the RMS change of the residuals of a fitted model by another time step, over the noise [-].

    What changes of initial states and the model's own parameters take up to first order is left out.
    """
    change = [a - piece.residual for a, piece in zip(_residuals(other), base.fit.linear, strict=True)]
    return noise_ratio(np.concatenate(_without_own(base, _projected(base, change))))


def _has_impacts(base: FittedModel) -> bool:
    """Return whether a body that flew hits something in the motion of a fitted model."""
    solver = base.solver()
    courses = solver.p.courses(solver.trials(base.fit.values, base.fit.offsets))
    return any(True for course in courses for _ in impacts(solver.p.compiled, course, base.cfg.observation))


def _longest_step(base: FittedModel, cfg: TimeStepCfg) -> float:
    """Return the longest time step that simulations of candidates may take [s], infinite without contacts."""
    m = base.model.scene.model
    touchable = (m.geom_contype != 0) | (m.geom_conaffinity != 0)
    constants = np.concatenate([m.geom_solref[touchable, 0], m.pair_solref[:, 0], m.eq_solref[:, 0]])
    return cfg.max_share_of_contact * float(constants[constants > 0].min(initial=np.inf))


def with_time_step(base: FittedModel, timestep: float) -> FittedModel:
    """Return the model with another time step, its residuals as they were."""
    scene = base.model.scene.with_timestep(timestep)
    return replace(base, model=replace(base.model, scene=scene))


def _residuals(base: FittedModel) -> list[np.ndarray]:
    """Return the residuals of each window at the fitted values and initial states, each (n,)."""
    solver = base.solver()
    return solver.p.residuals(solver.trials(base.fit.values, base.fit.offsets))


def _projected(base: FittedModel, residuals: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return residuals without what changes of the initial states take up to first order, each (n,)."""
    found = []
    for r, a, o in zip(residuals, base.fit.starts, base.fit.offsets, strict=True):
        near = cauchy_weight(o, base.cfg.least_squares.robust)
        found.append(r - a @ np.linalg.solve(a.T @ a + np.diag(near), a.T @ r))
    return found


def _without_own(base: FittedModel, residuals: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return projected residuals without what changes of the model's own parameters take up to first order."""
    jacobians, prior = [piece.jacobian for piece in base.pieces], base.cfg.least_squares.prior
    normal = sum((j.T @ j for j in jacobians), np.eye(jacobians[0].shape[1]) / prior**2)
    slope = sum((j.T @ r for j, r in zip(jacobians, residuals, strict=True)), np.zeros(len(normal)))
    move = np.linalg.solve(normal, slope) if len(normal) else slope
    return [r - j @ move for j, r in zip(jacobians, residuals, strict=True)]
