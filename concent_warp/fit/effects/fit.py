"""The fit of all parameters of a model's effects, with intervals and with what is doubtful about it in words."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from concent_warp.checks import Share, WindowLength, check_settings
from concent_warp.effects.effect import with_unit
from concent_warp.effects.posterior import JointPosterior
from concent_warp.errors import ModelError
from concent_warp.estimation.noise_ratio import noise_ratio
from concent_warp.fit.effects.cfg import EffectSolverCfg
from concent_warp.fit.effects.cross_validation import block_sums, cut_blocks
from concent_warp.fit.effects.initial_states import start_cost, start_step
from concent_warp.fit.effects.intervals import (
    NORMAL_QUANTILE,
    FittedParameter,
    clustered_std,
    covariance,
    excludes_null,
    formula_errors,
    joint_posterior,
)
from concent_warp.fit.effects.least_squares import Fit, Linear, Solver, projected
from concent_warp.fit.effects.observation import Window
from concent_warp.fit.effects.observe import observe
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.fit.effects.robust import huber_limit, robust_noise_ratio
from concent_warp.model import Model, check_inputs
from concent_warp.recording.recording import Recording
from concent_warp.simulate.select import EngineName


@dataclass(frozen=True)
class ChannelError:
    """Root mean square residual over noise of one channel, "x noise"."""

    channel: str
    before: float
    """With the values that the model came with."""
    after: float
    """With the fitted ones."""


@dataclass(frozen=True)
class FittedEffects:
    """A model whose effects were fitted.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> fitted = cw.fit_effects(cw.Model.from_recording(recording).add_effect("joint_damping"), recording)
        >>> fitted.after < fitted.before
        True
    """

    model: Model
    """The model with the values and their 95 % intervals."""
    parameters: tuple[tuple[FittedParameter, ...], ...]
    """The same by effect, in the order of the model's effects."""
    before: float
    """Root mean square residual over noise with the values that the model came with [-], initial states fitted."""
    after: float
    """With the fitted ones."""
    channels: tuple[ChannelError, ...]
    converged: bool
    remarks: tuple[str, ...]
    """Remarks on doubtful results, a sentence each."""

    @property
    def fall(self) -> float:
        """Share of the squared residual that the fit explains [-]."""
        return 1.0 - (self.after / max(self.before, 1e-12)) ** 2


@dataclass(frozen=True)
class FitEffectsCfg(EffectSolverCfg):
    """Settings of a fit of effect parameters.

    Example:
        >>> import concent_warp as cw
        >>> cw.FitEffectsCfg(window=0.5).window
        0.5
    """

    window: WindowLength | None = None
    """Length of the windows that are simulated in one go [s]; by default as long as the motion allows."""
    seed: int = 0
    """Seed of the disturbances that determine how long windows may be."""
    undetermined_share: float = 0.5
    """Standard deviation of a parameter over that of its weak prior from which the parameter counts as not determined
    by the recording [-]."""
    max_correlation: Share = 0.98
    """Correlation of two parameters beyond which a remark says that they cannot be distinguished [-]."""
    noise_ratio: float = 1.05
    """Residual over noise below which a fit counts as complete [-]: smaller differences are within the noise."""
    min_scan_gain: float = 1.0
    """Fall of the cost, half a sum of squares in units of noise, for which a fit starts from one of the values to try
    that a parameter names [-]."""


def fit_effects(
    model: Model,
    recording: Recording,
    cfg: FitEffectsCfg | None = None,
    *,
    engine: EngineName = "mujoco",
    out: str | Path | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> FittedEffects:
    """Fit all parameters of a model's effects together with the initial states.

    Parameters at their null value that have values to scan (`Parameter.scan`) start from the best of these; where
    values of several at once (`scan_together`) are better still, the better of two fits counts, from either.

    Args:
        model: The model with effects, at the values to start from.
        recording: What was commanded and measured.
        cfg: Settings.
        engine: "mujoco", "warp", or "auto" for MuJoCo-Warp where there is a CUDA device; C MuJoCo is the faster one for
            many short simulations.
        out: File (``.toml``) for the fitted model.
        progress: Called with the share done, 0..1, and what is being done.

    Raises:
        ModelError: The model has no effects, or does not stay finite on the recording.
        RecordingError: There is too little to fit to, or it does not fit the model.
        EngineError: The model cannot be simulated.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> model = cw.Model.from_recording(recording).add_effect("joint_friction")
        >>> fitted = cw.fit_effects(model, recording)
        >>> [f"{p.name} = {p.value:.3f} {p.unit}" for p in fitted.parameters[0]]
        ['torque[hinge] = 0.030 N m']
    """
    cfg = cfg or FitEffectsCfg()
    check_settings(cfg)
    check_inputs(model, recording)
    if not model.effects:
        raise ModelError("the model has no effects to fit", where=model.scene.source, fix="add one")
    report = progress or _silent
    report(0.0, "cutting windows")
    windows = observe(model, recording, length=cfg.window, engine=engine, seed=cfg.seed, cfg=cfg.observation)
    robust = cfg.least_squares.robust
    solver = Solver(Prediction(model, (), windows, engine=engine, cfg=cfg.prediction), cfg.least_squares)
    check_finite(solver.p, model.scene.source)
    report(0.1, "initial states")
    start = solver.p.start
    offsets, starts = solver.fit_initial_states(start, [np.zeros(len(w.spread)) for w in windows])
    given = _residuals_at(solver, start, offsets, starts)
    report(0.3, "trial values")
    chosen = _best_start(solver, start, offsets, starts, cfg)
    fit = solver.fit(chosen, offsets, starts, lambda share: report(0.3 + 0.5 * share, "fitting"))
    if (other := _start_together(solver, start, chosen, offsets, starts)) is not None:
        report(0.8, "fitting from other values")
        fit = min(fit, solver.fit(other, offsets, starts), key=lambda found: found.cost)
    report(0.8, "fitting again")
    fit = solver.better_from_measured_states(fit)
    fit = solver.polish(fit)
    linear = projected(fit, robust)
    found = [window_linear.residual for window_linear in linear]
    report(1.0, "done")
    parameters, correlation, posterior = _fitted_parameters(solver, fit, linear, windows, cfg)
    remarks = _remarks(solver, fit, parameters, correlation, cfg)
    before, after = noise_ratio(np.concatenate(given)), noise_ratio(np.concatenate(found))
    if robust_noise_ratio(found, robust) > max(robust_noise_ratio(given, robust), cfg.noise_ratio):
        remarks.insert(0, f"The fit ended no better than it began ({after:.3g} x noise, {before:.3g} before).")
    fitted = FittedEffects(
        solver.p.model(fit.values, [(q.low, q.high) for q in parameters], posterior),
        tuple(tuple(parameters[part]) for part in solver.p.split),
        before,
        after,
        _by_channel(windows, given, found),
        fit.converged,
        tuple(remarks),
    )
    if out is not None:
        fitted.model.save(out)
    return fitted


def _silent(share: float, text: str) -> None:
    """Ignore progress."""
    del share, text


def check_finite(prediction: Prediction, source: str) -> None:
    """Check that a model stays finite over the measured times of most windows.

    Raises:
        ModelError: It does not in more than half of them.
    """
    readers = prediction.readers([SimulationRequest(w, prediction.start) for w in range(len(prediction.windows))])
    lost = [
        not all(np.isfinite(reader(r.channel, r.time)).all() for r in window.readings)
        for window, reader in zip(prediction.windows, readers, strict=True)
    ]
    if np.mean(lost) > 0.5:
        raise ModelError(
            "the model does not stay finite on this recording",
            where=source,
            fix="check time step, units and initial state, for instance with `concent compare`",
        )


def _residuals_at(
    solver: Solver, values: np.ndarray, offsets: Sequence[np.ndarray], starts: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return the residuals at some values with the initial states eliminated, one (n,) a window."""
    residuals = solver.p.residuals(solver.trials(values, offsets))
    robust = solver.cfg.robust
    limit = huber_limit(residuals, robust)
    return [r + a @ start_step(r, a, o, limit, 0.0, robust) for r, a, o in zip(residuals, starts, offsets, strict=True)]


def _best_start(
    solver: Solver, given: np.ndarray, offsets: Sequence[np.ndarray], starts: Sequence[np.ndarray], cfg: FitEffectsCfg
) -> np.ndarray:
    """Return the values from which a fit starts, shape (P,): those given, or values to try that parameters name."""
    parameters = solver.p.parameters
    trials = [np.where(np.isfinite(given), given, solver.high)]
    for k, parameter in enumerate(parameters):
        if given[k] == parameter.null:
            for value in parameter.scan:
                moved = trials[0].copy()
                moved[k] = value
                trials.append(moved)
    if len(trials) == 1:
        return trials[0]
    costs = _costs(solver, trials, offsets, starts)
    best = int(np.argmin(costs))
    return trials[best] if costs[best] < costs[0] - cfg.min_scan_gain else trials[0]


def _start_together(
    solver: Solver,
    given: np.ndarray,
    chosen: np.ndarray,
    offsets: Sequence[np.ndarray],
    starts: Sequence[np.ndarray],
) -> np.ndarray | None:
    """Return values (P,) of several parameters at once from which a fit may start, None if `chosen` are as good."""
    trials = [chosen]
    for k, parameter in enumerate(solver.p.parameters):
        if given[k] == parameter.null:
            for row in itertools.chain.from_iterable(parameter.scan_together):
                moved = np.where(np.isfinite(given), given, solver.high)
                moved[k : k + len(row)] = row
                trials.append(moved)
    if len(trials) == 1:
        return None
    best = int(np.argmin(_costs(solver, trials, offsets, starts)))
    return trials[best] if best else None


def _costs(
    solver: Solver, trials: Sequence[np.ndarray], offsets: Sequence[np.ndarray], starts: Sequence[np.ndarray]
) -> list[float]:
    """Return the robust costs of trial values (P,), outliers as of the first."""
    residuals = [_residuals_at(solver, values, offsets, starts) for values in trials]
    limit = huber_limit(residuals[0], solver.cfg.robust)
    return [sum(start_cost(r, np.zeros(1), limit, solver.cfg.robust) for r in of_trial) for of_trial in residuals]


def _fitted_parameters(
    solver: Solver, fit: Fit, linear: Sequence[Linear], windows: Sequence[Window], cfg: FitEffectsCfg
) -> tuple[list[FittedParameter], np.ndarray, JointPosterior]:
    """Return the parameters with their 95 % intervals, P of them, the correlations of these (P, P), their posterior.

    The intervals combine the spread of the linear fit, see `clustered_std`, with `formula_errors`.
    """
    settings, blocks = cfg.least_squares, cut_blocks(windows, cfg.blocks)
    limit = huber_limit([window_linear.residual for window_linear in linear], settings.robust)
    sums = block_sums(linear, blocks, limit)
    covered = covariance(sums, blocks, settings.prior)
    std = np.sqrt(np.maximum(np.diag(covered), 1e-300))
    formula = np.zeros(len(std))
    for effect, part in zip(solver.p.effects, solver.p.split, strict=True):
        if part.stop > part.start:
            formula[part] = formula_errors(
                effect, solver.p.parameters[part], fit.values[part], cfg.discretisation_error, solver.p.timestep
            )
    clustered = clustered_std(sums, blocks, settings.prior)
    reaches = NORMAL_QUANTILE * np.hypot(clustered * solver.scale, formula)
    found = []
    for q, fitted, reach in zip(solver.p.parameters, fit.values, reaches, strict=True):
        value = float(fitted)
        low, high = max(value - float(reach), q.low), min(value + float(reach), q.high)
        undetermined = high - low > 2 * NORMAL_QUANTILE * cfg.undetermined_share * cfg.least_squares.prior * q.scale
        if np.isinf(q.null) and (high >= q.high or undetermined):  # a limit that is never reached counts as absent
            high = q.null
        at_bound = value in (q.low, q.high) and q.null not in (value, high)
        found.append(FittedParameter(q.name, value, low, high, q.unit, q.null, at_bound))
    posterior = joint_posterior(solver.p.parameters, found, covered, clustered, formula / solver.scale)
    return found, covered / np.outer(std, std), posterior


def _remarks(
    solver: Solver, fit: Fit, parameters: Sequence[FittedParameter], correlation: np.ndarray, cfg: FitEffectsCfg
) -> list[str]:
    """Return remarks on what is doubtful about a fit, a sentence each."""
    found = []
    if not fit.converged:
        found.append("The fit has not converged: take its values with care, or start from better ones.")
    unknown = set()
    for k, (q, prior) in enumerate(zip(parameters, solver.p.parameters, strict=True)):
        if q.at_bound:
            value = with_unit(f"{q.value:g}", q.unit)
            found.append(f"{q.name} ended on its bound, {value}: what is missing may be something else.")
        width = q.high - q.low
        if (
            width > 2 * NORMAL_QUANTILE * cfg.undetermined_share * cfg.least_squares.prior * prior.scale
            or width >= 0.99 * (prior.high - prior.low)
        ):
            unknown.add(k)
            found.append(f"The recording hardly determines {q.name}.")
    std = np.array([max(q.high - q.value, q.value - q.low) / NORMAL_QUANTILE for q in parameters])
    std = np.where(np.isfinite(std), std, 0.0)
    covered, share = correlation * np.outer(std, std), 1 - cfg.max_correlation
    for effect, part in zip(solver.p.effects, solver.p.split, strict=True):
        absent = not excludes_null(parameters[part], covered[part, part], share)
        if absent and not set(range(len(parameters))[part]) <= unknown:
            found.append(f"{effect.name} may be absent: within its interval it does nothing.")
    for k in range(len(parameters)):
        for j in range(k):
            if abs(correlation[k, j]) > cfg.max_correlation and not {k, j} & unknown:
                found.append(
                    f"{parameters[j].name} and {parameters[k].name} act so alike in this recording that it determines "
                    f"neither well by itself (correlation {correlation[k, j]:.3f})."
                )
    return found


def _by_channel(
    windows: Sequence[Window], before: Sequence[np.ndarray], after: Sequence[np.ndarray]
) -> tuple[ChannelError, ...]:
    """Return the residual over noise of each channel, largest first."""
    names = dict.fromkeys(r.channel for w in windows for r in w.readings)
    found = []
    for name in names:
        rows = [(k, r.rows) for k, w in enumerate(windows) for r in w.readings if r.channel == name]
        first, last = (noise_ratio(np.concatenate([residuals[k][s] for k, s in rows])) for residuals in (before, after))
        found.append(ChannelError(name, first, last))
    return tuple(sorted(found, key=lambda c: -c.before))
