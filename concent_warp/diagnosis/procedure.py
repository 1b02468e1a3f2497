"""The procedure of a diagnosis, from a recording and a model to a verdict.

Cut the recording into windows and fit the model's own parameters and the initial states. Then, up to a few times:
screen all candidate effects, fit the most promising ones, test their held-out gains against the null distribution of
the best candidate's gain, and add the best accepted one to the model. In the end remove effects that later ones have
made superfluous.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from concent_warp.comparison.residuals import instrument_noise
from concent_warp.diagnosis.alternatives import try_alternatives
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.check_data import check_data, noise_remarks
from concent_warp.diagnosis.experiment.suggest import SuggestedExperiment, suggest_experiment
from concent_warp.diagnosis.failures import locate_failures
from concent_warp.diagnosis.result import Detectable, Diagnosis, Finding, FinerTimeStep, Verdict
from concent_warp.diagnosis.search.adequacy import discrepancies, is_adequate, is_lacking, least_ratio
from concent_warp.diagnosis.search.baseline import (
    add_candidate,
    fit_baseline,
    refit_from_rivals,
    refit_without_effect,
    without_effect,
)
from concent_warp.diagnosis.search.candidate import FittedCandidate, FittedModel, ScreenedCandidate
from concent_warp.diagnosis.search.candidates import candidates, label
from concent_warp.diagnosis.search.evidence import assess, detectable_size, leaves_more, profile_widening
from concent_warp.diagnosis.search.fit_promising import CandidateFits
from concent_warp.diagnosis.search.form_error import flexible_correction
from concent_warp.diagnosis.search.gradient_start import GradientStarts
from concent_warp.diagnosis.search.grouping import group_indistinguishable
from concent_warp.diagnosis.search.joint_fit import (
    joint_finding,
    joint_parameters,
    refit_jointly,
    with_intervals,
)
from concent_warp.diagnosis.search.nominal_values import (
    nominal_effects,
    nominal_errors,
    nominal_sensitivities,
    with_nominal_values,
    without_nominal_values,
)
from concent_warp.diagnosis.search.null_distribution import max_gain_under_null
from concent_warp.diagnosis.search.reconsider import Rival, near_best, reconsider
from concent_warp.diagnosis.search.screening import linear_at_measured_states, ranking, screen
from concent_warp.diagnosis.search.time_step import at_given_step, finer_time_step, renew_defects
from concent_warp.diagnosis.search.time_step import finding as time_step_finding
from concent_warp.diagnosis.search.unknown_force import unknown_force, with_interleaved_folds
from concent_warp.diagnosis.tasks import TaskRunner, run_tasks
from concent_warp.diagnosis.time_budget import SEARCH_SHARE, TOGETHER_SHARE, TimeBudget, in_words
from concent_warp.effects.effect import Effect
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.fit import check_finite
from concent_warp.fit.effects.intervals import FittedParameter
from concent_warp.fit.effects.observation import Window
from concent_warp.fit.effects.observe import channel_noises, has_touchable_free_body, observe
from concent_warp.fit.effects.prediction import Prediction
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from concent_warp.simulate.parallel import limit_simulations
from concent_warp.simulate.select import EngineName
from concent_warp.simulate.time_limit import TimeUpError

BASELINE_SPAN, ADDITIONS_SPAN = 0.1, 0.85
"""Shares of a diagnosis that the baseline and the additions take, for the progress."""


class Procedure:
    """One diagnosis."""

    def __init__(
        self,
        model: Model,
        recording: Recording,
        cfg: DiagnoseCfg,
        runner: TaskRunner | None = None,
        engine: EngineName = "mujoco",
    ) -> None:
        """Prepare to diagnose a model with a recording."""
        self.model, self.recording, self.cfg = model, recording, cfg
        self.runner = runner or TaskRunner(cfg.jobs)
        self.engine: EngineName = engine
        self.channels = {c for d in recording.demonstrations for c in d.measured}
        self.findings: list[Finding] = []
        self.groups: list[tuple[str, ...]] = []
        self.hypotheses: list[dict[str, Model]] = []
        self.gradient = GradientStarts(model, recording) if cfg.gradient else None
        self.widening: dict[int, np.ndarray] = {}
        self.noise: dict[str, float] = {}
        self.noise_scale = 1.0
        """See `Window.noise_scale`."""
        self.noise_factors: dict[str, float] = {}
        self.time_step: FinerTimeStep | None = None
        self.nominal_values: tuple[FittedParameter, ...] = ()
        self.provisional: int | None = None
        """Index of an addition that stays only if it makes an earlier one superfluous, or explains nearly all that was
        left: what takes up an error in a formula explains a part of it."""
        self.form_corrected = False
        """Whether a flexible correction of the last addition, and no other effect, takes away what it left."""
        self.rivals: dict[int, tuple[Rival, ...]] = {}
        """Candidates that explained nearly as much as each addition, and that one itself."""
        self.with_unestablished: list[FittedModel] = []
        """The fitted models with all effects, where some are removed that are not established."""
        self.reduced: list[FittedModel] = []
        """The last fitted model without one of its effects each, as refitted when that was tried."""
        self.budget = TimeBudget(cfg.seconds)

    def run(self) -> Diagnosis:
        """Return the diagnosis."""
        with limit_simulations(self.cfg.jobs if self.cfg.jobs > 0 else None):
            return self._run()

    def _run(self) -> Diagnosis:
        cfg, runner = self.cfg, self.runner
        noises = instrument_noise(self.model.compile(), self.recording.demonstrations)
        self.noise_factors = {channel: noise.factor for channel, noise in noises.items()}
        issues = [*check_data(self.recording, cfg.data), *noise_remarks(self.model.compile(), noises)]
        runner.progress(0.0, "cutting windows")
        given = self.baseline()
        with self.budget.until(SEARCH_SHARE):
            fitted, detectable = self.search(given)
        fitted = self.final_values(self.restore_given(self.simplified(fitted), given))
        runner.progress(1.0, "done")
        return self.conclude(given, fitted, detectable, issues)

    def search(self, given: FittedModel) -> tuple[list[FittedModel], tuple[Detectable, ...]]:
        """Return the model as given and after each addition, and the detectable sizes of all effects."""
        attempt, detectable, fitted = self.budget.attempt, (), [given]
        far = "Open: how far the model as given is off over short windows."
        if (coarse := attempt(lambda: self.coarse_baseline(given), None, far)) is not None:
            found, detectable = self.add_effects([coarse], detectable, effects_alone=True)
            fitted = attempt(
                lambda: self.carry_over(given, found),
                [],
                "Not refitted: values over windows as long as the motion allows.",
            )
            if not fitted:
                self.budget.cut |= set(range(len(found)))
                return found, detectable
        fitted, smallest = self.add_effects(fitted, detectable)
        if len(self._accepted()) > 1:
            fitted = try_alternatives(self, fitted)
        return fitted, detectable or smallest

    def add_effects(
        self, fitted: list[FittedModel], detectable: tuple[Detectable, ...], *, effects_alone: bool = False
    ) -> tuple[list[FittedModel], tuple[Detectable, ...]]:
        """Return the fitted models with one more for each effect that is added, and the detectable sizes of all.

        Args:
            fitted: The model as given and after earlier additions.
            detectable: Smallest detectable sizes as far as they are known.
            effects_alone: Whether time step and nominal values stay as they are: over short windows the initial states
                hide what they change.
        """
        cfg, runner, fitted, first = self.cfg, self.runner, list(fitted), fitted[0]
        runner.share = max(runner.share, BASELINE_SPAN)
        while True:
            step = len(fitted) - 1
            # What a shorter time step leaves has a structure, too: that of the errors of both steps.
            explained = step or self.time_step is not None
            if explained and not is_lacking(fitted[-1], self.noise_factors, cfg):
                break
            if step and self._is_form_error(fitted[-1], first):
                if self.provisional is None:
                    if effects_alone:
                        break
                    self.provisional = step
                elif step > self.provisional:
                    break
            finer = None if effects_alone else self._finer(fitted[-1])
            if finer is not None and not is_lacking(finer, self.noise_factors, cfg):
                fitted = self._adopt(fitted, finer)
                break
            if not effects_alone and (found := self._with_nominal(fitted, finer, first)) is not None:
                fitted = found
                continue
            if step >= cfg.max_additions:
                return (fitted if finer is None else self._adopt(fitted, finer)), detectable
            runner.share = max(runner.share, BASELINE_SPAN + ADDITIONS_SPAN * step / cfg.max_additions)
            recorded = len(self.findings), len(self.groups)
            correction = None if effects_alone else self._correction(fitted[-1], first)
            try:
                adequate = not effects_alone and self._explains(fitted[-1], first, added=step > 0)
                best, smallest = self.find_addition(fitted[-1], step, explained=adequate)
            except TimeUpError:
                self.budget.note(f"Open: whether {'another effect' if step else 'any effect'} is missing.", step)
                break
            detectable = detectable or smallest
            equal = (1 + cfg.search.equal_error) * (np.inf if best is None else best.errors.sum())
            if finer is not None and finer.errors.sum() <= equal:
                self._forget(*recorded)
                fitted = self._adopt(fitted, finer)
                continue
            if best is not None and correction is not None and not self._explains_more(fitted[-1], best, correction):
                self._take_back(*recorded)
                best = None
            if best is None:
                self.form_corrected = self._is_corrected(fitted[-1], correction)
                break
            fitted.append(renew_defects(add_candidate(fitted[-1], best), cfg.time_step))
        return fitted, detectable

    def _is_lacking(self, one: FittedModel) -> bool:
        """Return whether the residual beyond the noise is as much as an effect must remove."""
        return one.ratio**2 >= 1 + self.cfg.min_gain

    def _least_gain(self, one: FittedModel) -> float:
        """Return the share of a model's held-out error that a shorter time step or nominal values must remove."""
        near = one.ratio <= self.cfg.form_error_ratio
        return self.cfg.min_gain if near else max(self.cfg.min_gain, self.cfg.search.far_min_gain)

    def _is_form_error(self, one: FittedModel, first: FittedModel) -> bool:
        """Return whether a model with added effects leaves no more than errors in their formulas.

        Little is then left beside the discrepancy of the first model, and little beside the noise.
        """
        left, lacked = discrepancies(one, first)
        share = self.cfg.max_form_error if self.form_corrected else self.cfg.unknown_force.min_share
        return left < share * lacked and one.ratio <= self.cfg.form_error_ratio

    def _correction(self, one: FittedModel, first: FittedModel) -> np.ndarray | None:
        """Return the held-out errors of a model with a flexible correction of the effects that were added.

        It is None where there are none, and where they leave more than errors in their formulas may be.
        """
        left, lacked = discrepancies(one, first)
        added = [a.effect for a in one.model.effects[len(first.model.effects) :] if not a.effect.nominal]
        if not added or left >= self.cfg.max_form_error * lacked or one.ratio > self.cfg.form_error_ratio:
            return None
        self.runner.progress(self.runner.share, "correcting the formulas of the effects")
        unsettled = "Open: whether what is left is an error in the formulas of the effects."
        correct = partial(flexible_correction, one, added, self.cfg, self._results)
        return self.budget.attempt(correct, None, unsettled)

    def _explains_more(self, one: FittedModel, best: FittedCandidate, correction: np.ndarray) -> bool:
        """Return whether a candidate explains what a flexible correction of the effects of a model does not."""
        errors = with_interleaved_folds(add_candidate(one, best)).errors
        return leaves_more(correction, errors, self.cfg.search)

    def _is_corrected(self, one: FittedModel, correction: np.ndarray | None) -> bool:
        """Return whether a flexible correction of the effects of a model leaves little more than noise."""
        if correction is None:
            return False
        left = correction.sum() / max(float(with_interleaved_folds(one).errors.sum()), 1e-12)
        return one.ratio * float(np.sqrt(left)) <= self.cfg.search.explained_ratio

    def _take_back(self, findings: int, groups: int) -> None:
        """Refuse the effect that was accepted after so many findings and groups."""
        reason = "explains no more than a flexible correction of the effects before it"
        self.groups, self.hypotheses = self.groups[:groups], self.hypotheses[:groups]
        self.findings[findings:] = [
            replace(f, accepted=False, reason=reason) if f.accepted else f for f in self.findings[findings:]
        ]

    def _results(self, task: Callable[..., ScreenedCandidate], tasks: Sequence[tuple[Any, ...]]) -> Any:
        """Return the results of a task for each tuple of arguments."""
        return run_tasks(task, tasks, self.cfg.jobs)

    def _explains(self, one: FittedModel, first: FittedModel, *, added: bool) -> bool:
        """Return whether a fitted model explains the data: down to noise or, with added effects, errors in formulas.

        An effect that leaves more than either is rather an imitation of what is missing, also where what it leaves is
        little beside the noise.

        Args:
            one: The fitted model.
            first: The model as given.
            added: Whether it has effects that the first one lacks.
        """
        adequate = is_adequate(one, self.noise_factors, self.cfg)
        if not added:
            return adequate
        little = least_ratio(one, self.noise_factors) <= self.cfg.search.explained_ratio
        return (adequate and little) or self._is_form_error(one, first)

    def _accepted(self) -> list[Finding]:
        """Return the accepted effects in the order of their addition."""
        return sorted((f for f in self.findings if f.accepted), key=lambda f: f.step)

    def _finer(self, one: FittedModel) -> FittedModel | None:
        """Return a fitted model with a shorter time step where that explains more and none has been adopted yet."""
        if self.time_step is not None:
            return None
        self.runner.progress(self.runner.share, "halving the time step")
        unsettled = "Open: whether the model's time step is too long."
        cfg = replace(self.cfg, min_gain=self._least_gain(one))
        return self.budget.attempt(lambda: finer_time_step(one, cfg), None, unsettled)

    def _nominal(self, one: FittedModel, enough: Callable[[FittedModel], bool] | None = None) -> FittedModel | None:
        """Return a fitted model with nominal values within their tolerance, None where that explains nothing more.

        Args:
            one: The fitted model.
            enough: Whether a model with values at their bounds leaves little enough.
        """
        if not self.cfg.nominal.enabled or nominal_effects(one.model):
            return None
        self.runner.progress(self.runner.share, "fitting nominal values within their tolerance")
        unsettled = "Open: whether nominal values are off within their tolerance."
        return self.budget.attempt(
            lambda: with_nominal_values(one, self.cfg.nominal, self._least_gain(one), enough), None, unsettled
        )

    def _with_nominal(
        self, fitted: list[FittedModel], finer: FittedModel | None, first: FittedModel
    ) -> list[FittedModel] | None:
        """Return the fitted models, the last with nominal values and, where that explains as much, a shorter time step.

        It is None where nominal values explain nothing more. Beside an effect they may be at their bounds where they
        leave no more than an error in its formula, which they take up before another effect does.
        """
        enough = partial(self._is_form_error, first=first) if len(fitted) > 1 else None
        if finer is not None and (both := self._nominal(finer, enough)) is not None:
            return [*self._adopt(fitted, finer)[:-1], both]
        plain = self._nominal(fitted[-1], enough)
        return None if plain is None else [*fitted[:-1], plain]

    def _adopt(self, fitted: list[FittedModel], finer: FittedModel) -> list[FittedModel]:
        """Return the fitted models with the last one replaced by that with a shorter time step."""
        self.time_step = time_step_finding(fitted[-1], finer, self.cfg.seed)
        return [*fitted[:-1], finer]

    def _forget(self, findings: int, groups: int) -> None:
        """Drop what was recorded after so many findings and groups."""
        self.findings, self.groups = self.findings[:findings], self.groups[:groups]
        self.hypotheses = self.hypotheses[:groups]

    def carry_over(self, base: FittedModel, coarse: Sequence[FittedModel]) -> list[FittedModel]:
        """Return the model as given and after each addition over short windows, fitted again to its own windows.

        The first addition that explains too little there is taken back, with those after it.

        Args:
            base: The model as given.
            coarse: The model as given and after each addition, over short windows.
        """
        fitted = [base]
        for step, one in enumerate(coarse[1:]):
            after = self._refitted(one.model, base.windows)
            if 1 - after.errors.sum() / max(fitted[-1].errors.sum(), 1e-12) < self.cfg.min_gain:
                self.groups, self.hypotheses = self.groups[:step], self.hypotheses[:step]
                self.findings = [
                    replace(f, accepted=False, reason="explains nothing more over longer windows")
                    if f.accepted and f.step >= step
                    else f
                    for f in self.findings
                ]
                break
            fitted.append(after)
        return fitted

    def coarse_baseline(self, base: FittedModel) -> FittedModel | None:
        """Return the model as given over shorter windows where it is far off over its own, None where it is not."""
        search, found = self.cfg.search, None
        if base.ratio <= search.far_ratio:
            return None
        for length in search.coarse_windows:
            if max(w.end - w.start for w in base.windows) < 2 * length:
                continue
            found = self._refitted(base.model, self._windows(base.model, length))
            if found.ratio <= search.far_ratio:
                break
        return found

    def _refitted(self, model: Model, windows: Sequence[Window]) -> FittedModel:
        """Return a model with its own parameters and the initial states fitted to some windows."""
        fits = self.cfg.fits
        return fit_baseline(model, windows, cut_blocks(windows, fits.blocks), self.engine, cfg=fits)

    def baseline(self) -> FittedModel:
        """Return the model as given, with its own parameters and the initial states fitted."""
        fits = self.cfg.fits
        self.noise = channel_noises(self.model, self.recording, fits.observation)
        windows = self._windows(self.model, self.cfg.window)
        self.runner.progress(0.03, "fitting the model as given")
        given = Prediction(self.model, (), windows, engine=self.engine, cfg=fits.prediction)
        check_finite(given, self.model.scene.source)
        found = self._refitted(self.model, windows)
        search = self.cfg.search
        if found.noise_ratio <= search.far_ratio or not has_touchable_free_body(self.model.compile()):
            return found
        self.runner.progress(0.06, "fitting the model as given, its own error in the place of the noise")
        self.noise_scale = found.noise_ratio / search.contact_ratio
        return self._refitted(self.model, self._windows(self.model, self.cfg.window))

    def _windows(self, model: Model, length: float | None) -> Sequence[Window]:
        """Return the recording cut into windows of a length [s]; as long as the motion allows where it is None."""
        windows = observe(
            model,
            self.recording,
            length=length,
            noise={channel: self.noise_scale * std for channel, std in self.noise.items()},
            engine=self.engine,
            seed=self.cfg.seed,
            cfg=self.cfg.fits.observation,
        )
        return [replace(w, noise_scale=self.noise_scale) for w in windows]

    def find_addition(
        self, base: FittedModel, step: int, *, explained: bool = False
    ) -> tuple[FittedCandidate | None, tuple[Detectable, ...]]:
        """Return the effect to add to a fitted model, None where none is accepted, and the detectable sizes of all.

        Args:
            base: The fitted model.
            step: Index of the addition.
            explained: Whether the model explains the data already. An effect is then accepted only if the intervals
                that the answer would state, see `joint_parameters`, exclude its null values too.
        """
        cfg = self.cfg
        effects, parts = self._candidates(base)
        screened = self._screened(base, effects, step)
        if not screened:  # the model has all that were asked for
            return None, ()
        if least_ratio(base, self.noise_factors) <= cfg.search.explained_ratio:
            # What shows in the size of the residual no more than noise does must show the clearer in its structure.
            cfg = replace(cfg, significance_level=cfg.quiet_significance_level, min_gain=cfg.quiet_min_gain)
        level = cfg.significance_level
        null, critical = self._chance(base, screened, level)
        needed = max(critical, cfg.min_gain)
        smallest = tuple(found for s in screened if (found := detectable_size(base, s, needed)) is not None)

        def finding(c: FittedCandidate) -> Finding:
            return assess(base, c, null, step, effects, cfg)

        def short_windows() -> Sequence[Window]:
            return self._windows(base.model, cfg.search.shooting_window)

        least = self._least_promise(base)
        fits = CandidateFits(base, cfg, self.runner)
        fitted = fits.fit(screened, needed, short_windows, least)
        if parts and self._leaves_more(base, fitted):
            more, effects = self._screened_parts(base, parts, step), [*effects, *parts]
            null, critical = self._chance(base, [*screened, *more], level)
            fitted = fits.fit(more, max(critical, cfg.min_gain), short_windows, least)
        for sentence, decides in fits.unsettled(lambda effect: label(effect, effects)):
            self.budget.note(sentence, step if decides else None)
        if not fitted and fits.left:
            raise TimeUpError
        findings = [finding(c) for c in fitted]
        rivals = [c for c, f in zip(fitted, findings, strict=True) if f.accepted]
        if rivals and max(c.share(base) for c in rivals) < cfg.search.doubtful_gain:
            leading = sorted(rivals, key=lambda c: -c.share(base))[: cfg.search.rivals]
            unsettled = "Open: whether other initial states let the model explain more without an effect."
            base = self.budget.attempt(partial(refit_from_rivals, base, leading), base, unsettled)
            findings = [finding(c) for c in fitted]
        if explained:
            findings = self._established(base, fitted, findings)
        accepted = [(c, f) for c, f in zip(fitted, findings, strict=True) if f.accepted]
        if not accepted:
            self.findings += sorted(findings, key=lambda f: -f.gain)
            return None, smallest
        group = group_indistinguishable(base, accepted, finding, self.runner, cfg, self.budget)
        self.rivals[step] = near_best(base, fitted, findings, cfg)
        self._record(base, group, findings)
        return group[0][0], smallest

    def _least_promise(self, base: FittedModel) -> float:
        """Return the gain that an effect beside a provisional addition must promise, 0 where there is none.

        It is a share of what `DiagnoseCfg.max_remainder` asks for; an effect that makes an earlier one superfluous
        explains as much.
        """
        if self.provisional is None:
            return 0.0
        needed = (1 - self.cfg.max_remainder) * max(1 - 1 / base.ratio**2, 0.0)
        return self.cfg.search.remainder_promise * needed

    def _candidates(self, base: FittedModel) -> tuple[list[Effect], list[Effect]]:
        """Return the effects that a fitted model may lack, and those considered only where none of these explains it.

        The latter are parts of elements; those of an effect that was asked for by its name are among the former.
        """
        found = candidates(base.model, self.channels, self.cfg.effects)
        later = [e for e in found if e.is_part and e.name not in self.cfg.effects]
        return [e for e in found if e not in later], later

    def _leaves_more(self, base: FittedModel, fitted: Sequence[FittedCandidate]) -> bool:
        """Return whether the best of the fitted candidates, without any the model itself, leaves more than noise."""
        best = max(fitted, key=lambda c: c.share(base), default=base)
        return best.ratio > self.cfg.search.explained_ratio

    def _chance(
        self, base: FittedModel, screened: Sequence[ScreenedCandidate], level: float
    ) -> tuple[np.ndarray, float]:
        """Return the null distribution of the best candidate's gain, and its value at a significance level."""
        null = max_gain_under_null(base, screened, self.cfg.null_samples, self.cfg.seed)
        return null, float(np.quantile(null, 1 - level))

    def _screened_parts(self, base: FittedModel, parts: Sequence[Effect], step: int) -> list[ScreenedCandidate]:
        """Return parts with their expected gains, none where there was no time: the other candidates stay."""
        try:
            return self._screened(base, parts, step, share=0.0)
        except TimeUpError:
            self.budget.note(f"Not screened: {in_words([label(e, parts) for e in parts])}.", step)
            return []

    def _established(
        self, base: FittedModel, fitted: Sequence[FittedCandidate], findings: Sequence[Finding]
    ) -> list[Finding]:
        """Return findings, accepted ones with the intervals of the answer, refused if these include the null values.

        Sensitivities to nominal values are those of the model that the candidates are added to.
        """
        found = list(findings)
        if not any(f.accepted for f in findings):
            return found
        unsettled = "Left out of the intervals of candidates: errors of nominal values."
        shared = self.budget.attempt(partial(nominal_sensitivities, base), None, unsettled)
        for k, (c, f) in enumerate(zip(fitted, findings, strict=True)):
            if not f.accepted:
                continue
            added = add_candidate(base, c)
            widening = {len(added.model.effects) - 1: profile_widening(base, c)}
            nominal = None if shared is None else nominal_errors(added, self.cfg, shared)
            parameters = joint_parameters(added, widening, nominal)[-1]
            found[k] = replace(f, parameters=parameters)
            if not any(p.excludes_null for p in parameters):
                found[k] = replace(found[k], accepted=False, reason="its parameters may be at their null values")
        return found

    def _screened(
        self, base: FittedModel, effects: Sequence[Effect], step: int, share: float = 0.5
    ) -> list[ScreenedCandidate]:
        """Return candidates with their expected gains.

        Args:
            base: The fitted model.
            effects: Candidates.
            step: Index of the addition.
            share: Share of the addition that this takes, for the progress.
        """
        span = share * ADDITIONS_SPAN / self.cfg.max_additions
        at_measured = linear_at_measured_states(base, self.cfg.search)
        tasks = [(base, e, self.cfg.search, at_measured) for e in effects]
        found = self.runner.run_in_time(screen, tasks, "screening", span)
        screened = [s for s in found if s is not None]
        if len(screened) < len(effects):
            missed = [label(e, effects) for e, s in zip(effects, found, strict=True) if s is None]
            self.budget.note(f"Not screened: {in_words(missed)}.", step)
            if not screened:
                raise TimeUpError
        names = [label(e, effects) for e, s in zip(effects, found, strict=True) if s is not None]
        self.runner.progress(self.runner.share, ranking(base, screened, names, self.cfg.seed))
        return self.gradient.apply(base, screened, self.runner) if self.gradient else screened

    def _record(
        self, base: FittedModel, group: Sequence[tuple[FittedCandidate, Finding]], findings: Sequence[Finding]
    ) -> None:
        """Keep the findings of an addition to a fitted model, the accepted one first, and its group."""
        updated = {f.name: f for _, f in group}
        self.groups.append(tuple(updated))
        self.hypotheses.append({f.name: c.model for c, f in group})
        self.widening[group[0][1].step] = profile_widening(base, group[0][0])
        first = group[0][1]
        rest = [f for f in (updated.get(f.name, f) for f in findings) if f is not first]
        self.findings.append(first)
        self.findings += [
            replace(f, accepted=False, reason=f.reason or "another one explains more")
            for f in sorted(rest, key=lambda f: -f.gain)
        ]

    def simplified(self, fitted: list[FittedModel]) -> list[FittedModel]:
        """Return the fitted models without superfluous effects, and without one that takes up errors of formulas."""
        found = self.remove_superfluous(self.reconsidered(fitted))
        if len(found) > len(fitted) or self.provisional is None or len(fitted) <= self.provisional + 1:
            return found
        before, after = fitted[self.provisional], fitted[self.provisional + 1]
        if after.ratio**2 - 1 <= self.cfg.max_remainder * (before.ratio**2 - 1):
            return found
        self.groups, self.hypotheses = self.groups[: self.provisional], self.hypotheses[: self.provisional]
        reason = "explains no more than errors in the formulas of the others"
        self.findings = [
            replace(f, accepted=False, reason=reason) if f.accepted and f.step == self.provisional else f
            for f in self.findings
        ]
        if found[-1] is fitted[-1]:
            return found[: self.provisional + 1]
        # Another effect has taken the place of an earlier one since.
        return [*found[: self.provisional], refit_without_effect(found[-1], len(found[-1].model.effects) - 1)]

    def reconsidered(self, fitted: list[FittedModel]) -> list[FittedModel]:
        """Return the fitted models, in the last one the effect of each addition that explains most beside the others.

        The last addition has just been compared with its rivals beside all others.
        """
        accepted = self._accepted()
        for k, f in enumerate(accepted[:-1]):
            if len(among := self.rivals.get(f.step, ())) < 2:
                continue
            self.runner.progress(self.runner.share, "trying earlier rivals beside later effects")
            last, unsettled = fitted[-1], f"Open: whether another effect than {f.name} explains more beside the others."
            index = len(last.model.effects) - len(accepted) + k
            found = self.budget.attempt(partial(reconsider, last, index, among, self.cfg), None, unsettled)
            if found is None:
                continue
            fitted = [*fitted[:-1], found.last]
            names = [g.name for _, g in found.group]
            self.groups[f.step] = tuple(names)
            self.hypotheses[f.step] = {g.name: c.model for c, g in found.group}
            if names[0] != f.name:
                self.widening[f.step] = np.ones(len(found.group[0][1].parameters))
                old = replace(f, accepted=False, reason="another one explains more beside the others")
                self.findings[self.findings.index(f)] = old
                self.findings = [g for g in self.findings if g.step != f.step or g.name != names[0]]
                self.findings.append(found.group[0][1])
        return fitted

    def remove_superfluous(self, fitted: list[FittedModel]) -> list[FittedModel]:
        """Return the fitted models, with one more for each effect that is removed since later ones made it superfluous.

        The last one added has just been tested beside all others.
        """
        steps = list(range(len(fitted) - 1))
        # A shorter time step, or nominal values, may have made the last one superfluous too.
        untested = 0 if _is_other(fitted) else 1
        while len(steps) > untested:
            last = fitted[-1]
            owned = len(last.model.effects) - len(steps)
            self.runner.progress(self.runner.share, "removing one effect at a time")
            tasks = [(last, owned + k) for k in range(len(steps) - untested)]
            unsettled = "Open: whether an effect is superfluous beside the others."
            refit = partial(lambda given: list(run_tasks(refit_without_effect, given, self.cfg.jobs)), tasks)
            if (reduced := self.budget.attempt(refit, None, unsettled)) is None:
                break
            self.reduced = reduced
            reduced = [self._with_nominal_instead(one, last) for one in reduced]
            shares = [_gain_over(one, last) for one in reduced]
            least = int(np.argmin(shares))
            if shares[least] >= self.cfg.min_gain:
                break
            step = steps.pop(least)
            fitted = [*fitted, reduced[least]]
            self.groups[step], self.hypotheses[step] = (), {}
            self.findings = [
                replace(f, accepted=False, reason="made superfluous by effects added later")
                if f.accepted and f.step == step
                else f
                for f in self.findings
            ]
        self.groups = [group for group in self.groups if group]
        return fitted

    def _with_nominal_instead(self, reduced: FittedModel, last: FittedModel) -> FittedModel:
        """Return a model without one of the last model's effects, with nominal values within their tolerance if better.

        They were not fitted while other effects were missing, and then an effect may stand for them.
        """
        if _gain_over(reduced, last) < self.cfg.min_gain:
            return reduced
        found = self._nominal(reduced)
        return reduced if found is None else found

    def restore_given(self, fitted: list[FittedModel], given: FittedModel) -> list[FittedModel]:
        """Return the fitted models, the last with time step and nominal values as given where others explain no more.

        Effects that were added later may have made them superfluous. Where the model as given leaves no more than noise
        and no effect was accepted, it stays as given.
        """
        if not self._accepted() and not self._is_lacking(given):
            self.time_step = None
            return [given]
        last, sentence = fitted[-1], "Open: whether {} beside the effects."
        if self.time_step is not None:
            self.runner.progress(self.runner.share, "restoring the time step")
            refit = partial(at_given_step, last)
            restored = self._if_as_good(last, refit, sentence.format("a shorter time step is needed"))
            self.time_step = None if restored is not last else self.time_step
            last = restored
        if nominal_effects(last.model):
            self.runner.progress(self.runner.share, "restoring nominal values")
            refit = partial(without_nominal_values, last)
            last = self._if_as_good(last, refit, sentence.format("other nominal values are needed"))
        return [*fitted[:-1], last]

    def _if_as_good(self, last: FittedModel, refit: Callable[[], FittedModel], unsettled: str) -> FittedModel:
        """Return a simpler fitted model if it explains nearly as much as the last one, else that."""
        reduced = self.budget.attempt(refit, None, unsettled)
        return last if reduced is None or _gain_over(reduced, last) >= self.cfg.min_gain else reduced

    def final_values(self, fitted: list[FittedModel]) -> list[FittedModel]:
        """Return the fitted models, the last with all that was accepted fitted together, and update the findings to it.

        Effects that are not established beside the others are removed one at a time, the rest fitted again.
        """
        while True:
            found, without, established = self._fitted_together(fitted)
            if (fewer := self.remove_unestablished(found, without, established)) is None:
                return found
            self.with_unestablished = self.with_unestablished or found
            fitted = fewer

    def _fitted_together(
        self, fitted: list[FittedModel]
    ) -> tuple[list[FittedModel], list[FittedModel | None], list[bool]]:
        """Return the fitted models, the last with all that was accepted fitted together, and update the findings to it.

        The gain of each effect is then that over the same model without it. These models are returned too, one for each
        accepted effect, None where there was no time, and whether an interval of it without the profile likelihood,
        which a rough cost widens, excludes its null value.
        """
        accepted, reduced = self._accepted(), []
        if not accepted and not nominal_effects(fitted[-1].model):
            self.nominal_values = ()
            return fitted, reduced, []
        self.runner.progress(self.runner.share, "fitting all effects together")
        attempt = self.budget.attempt
        unsettled = "Not refitted: all effects together."
        last = attempt(lambda: self._joint(fitted[-1]), fitted[-1], unsettled, TOGETHER_SHARE)
        owned = len(last.model.effects) - len(accepted)
        widening = {owned + k: self.widening[f.step] for k, f in enumerate(accepted)}
        unsettled = "Left out of the intervals: errors of nominal values."
        nominal = attempt(lambda: nominal_errors(last, self.cfg), None, unsettled, TOGETHER_SHARE)
        parameters, linear = (joint_parameters(last, by, nominal) for by in (widening, None))
        established = [any(p.excludes_null for p in linear[owned + k]) for k in range(len(accepted))]
        self.nominal_values = tuple(p for k in nominal_effects(last.model) for p in parameters[k])
        for k, f in enumerate(accepted):
            alone = len(accepted) == 1 and not _is_other(fitted) and not nominal_effects(last.model)
            final = replace(f, parameters=parameters[owned + k])
            unsettled = f"Not refitted: the model without {f.name}, for its gain beside the other effects."
            without = fitted[0]
            if not alone and (without := without_effect(last, owned + k, self.reduced)) is None:
                without = attempt(partial(refit_without_effect, last, owned + k), None, unsettled)
            if without is not None:
                final = joint_finding(f, parameters[owned + k], last, without, self.cfg.seed)
            self.findings[self.findings.index(f)] = final
            reduced.append(without)
        return [*fitted[:-1], with_intervals(last, parameters)], reduced, established

    def remove_unestablished(
        self, fitted: list[FittedModel], without: Sequence[FittedModel | None], established: Sequence[bool]
    ) -> list[FittedModel] | None:
        """Return the fitted models without one effect that is not established, None where all are.

        All intervals of such an effect include the null values, and the data are explained without it, if need be with
        nominal values within their tolerance in its place. Of several it is the one with the smallest gain. One that
        the data need stays: its gain is the evidence, even where a rough cost or what else is missing widens its
        interval.

        Args:
            fitted: The fitted models, the last with all that was accepted.
            without: The last one without each accepted effect, in the order of their addition.
            established: Whether an interval of each excludes its null value.
        """
        accepted, first, last = self._accepted(), fitted[0], fitted[-1]
        for f, refitted, sure in sorted(zip(accepted, without, established, strict=True), key=lambda row: row[0].gain):
            if refitted is None or sure:
                continue
            reduced = self._with_nominal_instead(refitted, last)
            if not self._explains(reduced, first, added=len(accepted) > 1):
                continue
            reason = "its parameters may be at their null values beside the others"
            if len(accepted) == 1:
                reason = "its parameters may be at their null values"
            self.findings[self.findings.index(f)] = replace(f, accepted=False, reason=reason)
            place = accepted.index(f)
            self.groups = [group for k, group in enumerate(self.groups) if k != place]
            self.hypotheses = [h for k, h in enumerate(filter(None, self.hypotheses)) if k != place]
            if len(accepted) > 1:
                return [*fitted, reduced]
            return [reduced] if _is_other([first, reduced]) else [first]
        return None

    def _joint(self, last: FittedModel) -> FittedModel:
        """Return the last model with all that was accepted fitted together."""
        return renew_defects(refit_jointly(last), self.cfg.time_step)

    def conclude(
        self,
        given: FittedModel,
        fitted: Sequence[FittedModel],
        detectable: tuple[Detectable, ...],
        issues: Sequence[str],
    ) -> Diagnosis:
        """Return the verdict.

        Args:
            given: The model as given.
            fitted: The same, with a shorter time step where that explains more, and after each addition or removal.
            detectable: Smallest detectable sizes.
            issues: Sentences on the data.
        """
        cfg, last = self.cfg, fitted[-1]
        left, lacked = discrepancies(last, given)
        added = any(f.accepted for f in self.findings)
        unexplained = (
            float(np.clip(left / max(lacked, 1e-9), 0.0, 1.0)) if added or given.ratio > cfg.adequate_ratio else 0.0
        )
        adequate, form_error = self._explains(last, given, added=added), None
        if added and is_lacking(last, self.noise_factors, cfg) and self._is_form_error(last, given):
            form_error = unexplained
        unknown = None
        if adequate and added:
            # What an effect explains with values that may be its null values needs no force of unknown form.
            tested = self.with_unestablished or fitted
            nodes = [given, *(tested[1:] or tested)]
            unknown = self.budget.attempt(
                lambda: unknown_force(nodes, cfg, self._results),
                None,
                "Open: whether a force of unknown form explains more.",
            )
        if (
            unknown is not None
            and self.form_corrected
            and not unknown.form_error
            and unknown.share < cfg.max_form_error
        ):
            unknown = replace(unknown, form_error=True)
        verdict: Verdict = "none_needed"
        lacking = unknown is not None and not unknown.form_error
        if not adequate or lacking:
            verdict = "none_of_these"
        elif len(fitted) > 1:
            verdict = "group" if any(len(group) > 1 for group in self.groups) else "effect"
        explained = verdict == "none_needed" or not cfg.explain
        verdict = self.budget.verdict(verdict, [f.step for f in self.findings if f.accepted])
        unsettled = "Left out: where the model fails, and the next experiment."
        where = self.budget.attempt(lambda: () if explained else self._failures(given), (), unsettled)
        experiment = self.budget.attempt(lambda: None if explained else self._suggested_experiment(), None, unsettled)
        after = fitted[1:] if fitted[0] is given else fitted
        return Diagnosis(
            verdict=verdict,
            effects=tuple(sorted(self.findings, key=lambda f: (not f.accepted, f.step, -f.gain))),
            groups=tuple(self.groups),
            where=where,
            unexplained=max(unexplained, unknown.share) if unknown is not None and lacking else unexplained,
            ratio=(given.noise_ratio, *(one.noise_ratio for one in after)),
            detectable=detectable,
            next_experiment=experiment,
            issues=tuple(issues),
            models=(given.model, *(one.delivered for one in after)),
            seed=cfg.seed,
            unknown_force=unknown,
            form_error=form_error if verdict in ("effect", "group") else None,
            time_step=self.time_step,
            nominal_values=self.nominal_values,
            unsettled=tuple(self.budget.unsettled),
            explains=verdict != "none_of_these" or unexplained <= 1 - cfg.min_explained,
        )

    def _suggested_experiment(self) -> SuggestedExperiment | None:
        """Return the experiment that distinguishes the first group of effects, None where there is no such group."""
        groups = [found for found in self.hypotheses if len(found) > 1]
        if not groups:
            return None
        cfg = replace(self.cfg.experiment, seed=self.cfg.seed, observation=self.cfg.fits.observation)
        return suggest_experiment(groups[0], self.recording, cfg, engine=self.engine)

    def _failures(self, given: FittedModel) -> tuple[Mapping[str, Any], ...]:
        """Return where the model as given fails."""
        cfg = self.cfg.failures
        return tuple(
            locate_failures(
                given.model,
                self.recording,
                replace(cfg, max_seconds=min(cfg.max_seconds, self.budget.left())),
                engine=self.engine,
                windows=given.windows,
                offsets=given.fit.offsets,
            )
        )


def _gain_over(reduced: FittedModel, last: FittedModel) -> float:
    """Return the share of a simpler model's error that the last one removes: held out, or of its cost if that is more.

    Held-out errors come from linear steps, which the bounds of the parameters do not stop.
    """
    pairs = ((last.errors.sum(), reduced.errors.sum()), (last.fit.cost, reduced.fit.cost))
    return float(max(1 - less / max(more, 1e-12) for less, more in pairs))


def _is_other(fitted: Sequence[FittedModel]) -> bool:
    """Return whether the last of some fitted models has another time step, or other nominal values, than the first."""
    first, last = fitted[0], fitted[-1]
    return first.timestep != last.timestep or len(nominal_effects(first.model)) != len(nominal_effects(last.model))
