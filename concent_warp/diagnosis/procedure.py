"""The procedure of a diagnosis, from a recording and a model to a verdict.

Cut the recording into windows and fit the model's own parameters and the initial states. Then, up to a few times:
screen all candidate effects, fit the most promising ones, test their held-out gains against the null distribution of
the best candidate's gain, and add the best accepted one to the model. In the end remove effects that later ones have
made superfluous.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from concent_warp.comparison.residuals import instrument_noise
from concent_warp.diagnosis.candidates.baseline import errors_like, fit_baseline
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.candidates.gradient_start import GradientStarts
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.check_data import check_data, noise_remarks, start_remarks
from concent_warp.diagnosis.detectable import Detectable
from concent_warp.diagnosis.experiment.suggest import SuggestedExperiment, suggest_experiment
from concent_warp.diagnosis.failures import locate_failures
from concent_warp.diagnosis.replayed import Replayed, replayed
from concent_warp.diagnosis.result import Diagnosis, Verdict
from concent_warp.diagnosis.search.additions import Additions
from concent_warp.diagnosis.search.adequacy import discrepancies, is_lacking, is_near_noise, qualified_by_noise
from concent_warp.diagnosis.search.alternatives import try_alternatives
from concent_warp.diagnosis.search.consistency import beyond_effects
from concent_warp.diagnosis.search.context import (
    ADDITIONS_DONE,
    BASELINE_DONE,
    REVISION_DONE,
    VALUES_DONE,
    SearchContext,
)
from concent_warp.diagnosis.search.find_addition import AdditionFinder
from concent_warp.diagnosis.search.form_error import error_of_own_friction, said_of_own_friction
from concent_warp.diagnosis.search.impact_errors import said_of_impacts, stand, with_errors_of_impacts
from concent_warp.diagnosis.search.record import SearchRecord
from concent_warp.diagnosis.search.revision import Revision
from concent_warp.diagnosis.search.time_step import corrected, longer_time_step, may_be_step, renew_defects
from concent_warp.diagnosis.tasks import TaskRunner
from concent_warp.diagnosis.time_budget import SEARCH_SHARE
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.fit import check_finite
from concent_warp.fit.effects.observation import Window
from concent_warp.fit.effects.observe import channel_noises, has_touchable_free_body, observe
from concent_warp.fit.effects.prediction import Prediction
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from concent_warp.simulate.parallel import limit_simulations
from concent_warp.simulate.select import EngineName


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
        self.model, self.recording = model, recording
        self.engine: EngineName = engine
        self.noise: dict[str, float] = {}
        self.noise_scale = 1.0
        """See `Window.noise_scale`."""
        self.impacts_left = False
        """Whether errors of impacts are what the answer leaves."""
        self.held: FittedModel | None = None
        """The model that effects are added to where its friction holds and that of the model as given does not."""
        channels = {c for d in recording.demonstrations for c in d.measured}
        gradient = GradientStarts(model, recording) if cfg.gradient else None
        self.context = SearchContext(cfg, runner or TaskRunner(cfg.jobs))
        self.additions = Additions(self.context, AdditionFinder(self.context, channels, self._windows, gradient))
        self.revision = Revision(self.context)

    @property
    def record(self) -> SearchRecord:
        """What the search has found so far."""
        return self.context.record

    def run(self) -> Diagnosis:
        """Return the diagnosis."""
        jobs = self.context.cfg.jobs
        with limit_simulations(jobs if jobs > 0 else None):
            return self._run()

    def _run(self) -> Diagnosis:
        context, cfg, runner = self.context, self.context.cfg, self.context.runner
        noises = instrument_noise(self.model.compile(), self.recording.demonstrations)
        context.noise_factors = {channel: noise.factor for channel, noise in noises.items()}
        compiled = self.model.compile()
        issues = [*check_data(self.recording, cfg.data), *noise_remarks(compiled, noises)]
        issues += start_remarks(compiled, self.recording)
        runner.progress(0.0, "cutting windows")
        given = self.baseline()
        runner.enter(BASELINE_DONE, ADDITIONS_DONE)
        with context.budget.until(SEARCH_SHARE):
            start = self.additions.with_holding(given)
            context.record.held_first, is_given = len(context.record.holding), start is given
            begun, fitted, detectable = self.search_beside_impacts(self._with_longer_step(start))
        if is_given:
            given = begun
        else:
            self.held = begun
        revision = self.revision
        runner.enter(ADDITIONS_DONE, REVISION_DONE)
        fitted = revision.restore_given(revision.simplified(fitted), given)
        fitted = revision.final_values(revision.with_resolved_impacts(revision.profiled(fitted)))
        found = qualified_by_noise(self.conclude(given, fitted, detectable, issues), fitted[-1], noises, cfg)
        runner.progress(1.0, "done")
        return found

    def search_beside_impacts(
        self, given: FittedModel
    ) -> tuple[FittedModel, list[FittedModel], tuple[Detectable, ...]]:
        """Return the model as given, the same and after each addition, and the detectable sizes of all effects.

        Where these do not explain the data, or errors of impacts may stand behind them or hide them, the search is
        repeated with such errors among the noise. What it finds counts where it explains the data; if the first answer
        explained them, too, where it does so down to the noise by fewer effects. Beside a small effect that stands, and
        where none was found, a single one counts. The model as given is then fitted to windows with such errors.
        """
        context, begun = self.context, self.context.record.copy()
        fitted, detectable = self.search(given)
        added = bool(self.record.accepted())
        explained = context.explains(fitted[-1], given, added=added)
        if (explained and not added and not self._may_be_hidden()) or context.budget.cut:
            return given, fitted, detectable
        left_open = "Open: what is missing where errors of impacts are allowed for."
        begin = partial(self.baseline_with_errors_of_impacts, given, fitted)
        rough = context.budget.attempt(begin, None, left_open)
        if rough is None:
            return given, fitted, detectable
        stands = not added
        if added and explained:
            stands = context.budget.attempt(lambda: self._stand(given, fitted, rough), True, left_open)
            if stands and not self._is_small(given):
                return given, fitted, detectable
        budget, settled = context.budget, context.record
        cut, doubted, unsettled = budget.cut, budget.doubted, budget.unsettled
        context.record = replace(begun, beside_impacts=True)
        budget.cut, budget.doubted, budget.unsettled = set(), set(), []
        beside, smallest = self.search(rough)
        count = len(self.record.accepted())
        enough = context.explains(beside[-1], rough, added=count > 0)
        if explained and stands:
            enough &= count == 1
        elif explained:
            enough &= count < len(settled.accepted())
            enough &= is_near_noise(beside[-1], context.noise_factors, context.cfg)
        if enough and not budget.cut:
            self.impacts_left = True
            return rough, beside, smallest
        context.record = settled
        budget.cut, budget.doubted, budget.unsettled = cut, doubted, unsettled
        return given, fitted, detectable

    def _may_be_hidden(self) -> bool:
        """Return whether an effect that was refused would not be by its gain alone: what impacts leave may hide it."""
        cfg = self.context.cfg
        return any(f.p <= cfg.quiet_significance_level and f.gain >= cfg.min_gain for f in self.record.findings)

    def _is_small(self, given: FittedModel) -> bool:
        """Return whether a single effect was added that removes little of the little that the model as given leaves.

        One of contacts themselves does not count: errors of impacts are about these.
        """
        context, accepted = self.context, self.record.accepted()
        quiet = is_near_noise(given, context.noise_factors, context.cfg)
        little = len(accepted) == 1 and accepted[0].gain < context.cfg.quiet_min_gain
        return quiet and little and accepted[0].family != "contact"

    def _stand(self, given: FittedModel, fitted: Sequence[FittedModel], rough: FittedModel) -> bool:
        """Return whether the effects that were added stand beside errors of impacts.

        A single one that leaves no more than noise stands, unless it is one of objects, which act through their
        contacts as laws of these do, or is small, or is none of contacts where such errors alone bring what is left
        down to noise. Several do not where one is of objects, or where they leave more than noise: each was chosen
        beside the others, and then all may be wrong.

        Args:
            given: The model as given.
            fitted: The same and after each addition.
            rough: The model as given where errors of impacts count as noise.
        """
        context, accepted = self.context, self.record.accepted()
        near_noise = is_near_noise(fitted[-1], context.noise_factors, context.cfg)
        plain = near_noise and all(f.family != "objects" for f in accepted)
        alone = is_near_noise(rough, context.noise_factors, context.cfg)
        alone &= not is_near_noise(given, context.noise_factors, context.cfg)
        doubtful = self._is_small(given) or (alone and accepted[0].family != "contact")
        if len(accepted) == 1 and plain and not doubtful:
            return True
        if len(accepted) > 1 and not plain:
            return False
        context.progress("refitting the effects beside errors of impacts")
        refitted = self._refitted(fitted[-1].model, rough.windows)
        return all(stand(rough, refitted, len(accepted), context.noise_factors, context.cfg))

    def baseline_with_errors_of_impacts(self, given: FittedModel, fitted: Sequence[FittedModel]) -> FittedModel | None:
        """Return the model as given where errors of impacts count as noise, see `with_errors_of_impacts`."""
        return with_errors_of_impacts(self.context, given, fitted, self._refitted)

    def search(self, given: FittedModel) -> tuple[list[FittedModel], tuple[Detectable, ...]]:
        """Return the model as given and after each addition, and the detectable sizes of all effects."""
        budget, add_effects = self.context.budget, self.additions.add_effects
        attempt, detectable, fitted = budget.attempt, (), [given]
        if given.ratio > self.context.cfg.search.far_ratio:
            fitted = [self.additions.within_tolerances(given) or given]
        far = "Open: how far the model as given is off over short windows."
        if fitted[0] is given and (coarse := attempt(lambda: self.coarse_baseline(given), None, far)) is not None:
            found, detectable = add_effects([coarse], detectable, effects_alone=True)
            unsettled = "Not refitted: values over windows as long as the motion allows."
            fitted = attempt(lambda: self.carry_over(given, found), [], unsettled)
            if not fitted:
                budget.cut |= set(range(len(found)))
                return found, detectable
        fitted, smallest = self._added(fitted, given, detectable)
        return fitted, detectable or smallest

    def _added(
        self, fitted: list[FittedModel], first: FittedModel, detectable: tuple[Detectable, ...]
    ) -> tuple[list[FittedModel], tuple[Detectable, ...]]:
        """Return fitted models with one more for each effect that is added, and the detectable sizes of all effects.

        Args:
            fitted: The model as given and after earlier additions.
            first: The model as given.
            detectable: Smallest detectable sizes as far as they are known.
        """
        fitted, detectable = self.additions.add_effects(fitted, detectable)
        if self._may_be_imitation(fitted, first):
            fitted = try_alternatives(self.additions, fitted)
        return fitted, detectable

    def _may_be_imitation(self, fitted: Sequence[FittedModel], given: FittedModel) -> bool:
        """Return whether the effects that were added may stand for others that act together.

        Several may always. A single one that explains the data does not; one that leaves more than noise and errors in
        its formula, beside which nothing else was accepted, takes up parts of several effects, and then each of these
        is left too small, or too much distorted, to be found beside it.

        Args:
            fitted: The model as given and after each addition.
            given: The model as given, over windows as long as the motion allows.
        """
        count = len(self.record.accepted())
        return count > 1 or (count == 1 and not self.context.explains(fitted[-1], given, added=True))

    def carry_over(self, base: FittedModel, coarse: Sequence[FittedModel]) -> list[FittedModel]:
        """Return the model as given and after each addition over short windows, fitted again to its own windows.

        The first addition that explains too little there is taken back, with those after it.

        Args:
            base: The model as given.
            coarse: The model as given and after each addition, over short windows.
        """
        record, least, fitted = self.record, self.context.cfg.min_gain, [base]
        for step, one in enumerate(coarse[1:]):
            after = self._refitted(one.model, base.windows)
            if 1 - errors_like(after, fitted[-1]).sum() / max(fitted[-1].errors.sum(), 1e-12) < least:
                record.keep_groups(step)
                reason = "explains nothing more over longer windows"
                record.refuse(lambda f, step=step: f.step >= step, reason)
                break
            fitted.append(after)
        return fitted

    def coarse_baseline(self, base: FittedModel) -> FittedModel | None:
        """Return the model as given over shorter windows where it is far off over its own, None where it is not."""
        search, found = self.context.cfg.search, None
        if base.ratio <= search.far_ratio:
            return None
        for length in search.coarse_windows:
            if max(w.end - w.start for w in base.windows) < 2 * length:
                continue
            found = self._refitted(base.model, self._windows(base.model, length))
            if found.ratio <= search.far_ratio:
                break
        return found

    def _with_longer_step(self, one: FittedModel) -> FittedModel:
        """Return a fitted model whose simulations take longer steps where that changes little.

        Where it is far off they do not: corrections about its motion mean little for that which was measured.
        """
        context = self.context
        if one.noise_ratio > context.cfg.search.far_ratio:
            return one
        context.progress("trying longer time steps")
        unsettled = "Not tried: longer time steps."
        return context.budget.attempt(lambda: longer_time_step(one, context.cfg.time_step), one, unsettled)

    def _refitted(self, model: Model, windows: Sequence[Window], timestep: float | None = None) -> FittedModel:
        """Return a model with its own parameters and the initial states fitted to some windows.

        Predictions are those of a time step [s], by default that of the model as given, also where simulations take
        longer ones.
        """
        fits, cfg = self.context.cfg.fits, self.context.cfg.time_step
        found = fit_baseline(model, windows, cut_blocks(windows, fits.blocks), self.engine, cfg=fits)
        aimed = self.model.scene.model.opt.timestep if timestep is None else timestep
        return corrected(found, aimed, cfg) if found.timestep > aimed else renew_defects(found, cfg)

    def baseline(self) -> FittedModel:
        """Return the model as given, with its own parameters and the initial states fitted."""
        runner, cfg = self.context.runner, self.context.cfg
        fits, search = cfg.fits, cfg.search
        self.noise = channel_noises(self.model, self.recording, fits.observation)
        windows = self._windows(self.model, cfg.window)
        runner.progress(0.03, "fitting the model as given")
        given = Prediction(self.model, (), windows, engine=self.engine, cfg=fits.prediction)
        check_finite(given, self.model.scene.source)
        found = self._refitted(self.model, windows)
        if found.noise_ratio <= search.far_ratio or not has_touchable_free_body(self.model.compile()):
            return found
        runner.progress(0.06, "fitting the model as given, its own error in the place of the noise")
        self.noise_scale = found.noise_ratio / search.contact_ratio
        raised = self._windows(self.model, cfg.window)
        if len(raised) > len(windows):  # a body that spins: initial states within so much noise soon differ by a turn
            self.noise_scale = 1.0
            return found
        return self._refitted(self.model, raised)

    def _windows(self, model: Model, length: float | None) -> Sequence[Window]:
        """Return the recording cut into windows of a length [s]; as long as the motion allows where it is None."""
        cfg = self.context.cfg
        windows = observe(
            model,
            self.recording,
            length=length,
            noise={channel: self.noise_scale * std for channel, std in self.noise.items()},
            engine=self.engine,
            seed=cfg.seed,
            cfg=cfg.fits.observation,
        )
        return [replace(w, noise_scale=self.noise_scale) for w in windows]

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
        begun = self.held or given
        context, record, last = self.context, self.record, fitted[-1]
        cfg, budget = context.cfg, context.budget
        left, lacked = discrepancies(last, begun)
        added = any(f.accepted for f in record.findings)
        share = float(np.clip(left / max(lacked, 1e-9), 0.0, 1.0))
        unexplained = share if added or begun.ratio > cfg.adequate_ratio else 0.0
        adequate = context.explains(last, begun, added=added) and not context.takes_up_parts(last)
        own_error = None if adequate or added else self._error_of_own_friction(last)
        adequate |= own_error is not None
        form_error = None
        if added and is_lacking(last, context.noise_factors, cfg) and context.is_form_error(last, begun):
            form_error = unexplained
        unknown = None
        if adequate and (added or record.part_refused):
            # What an effect explains with values that may be its null values needs no force of unknown form.
            tested = record.with_unestablished or fitted
            nodes = [begun, *(tested[1:] or tested)]
            context.runner.enter(VALUES_DONE, 1.0)
            context.progress("testing forces of no known form")
            unknown = budget.attempt(
                lambda: beyond_effects(
                    nodes, record.hypotheses, cfg, context.results, form_corrected=record.form_corrected
                ),
                None,
                "Open: whether a force of unknown form explains more.",
            )
        if unknown is not None and unknown.varies and context.explains(begun, begun, added=False):
            # What changes from window to window, where the model as given leaves no more than noise, is no effect.
            record.refuse(
                lambda _: True, "its value changes from window to window, and noise explains the data as well"
            )
            record.keep_groups(0)
            return self.conclude(given, self.revision.restore_given([begun], given), detectable, issues)
        verdict: Verdict = "none_needed"
        lacking = unknown is not None and not unknown.form_error
        if lacking and not added:
            unexplained = share
        if not adequate or lacking:
            verdict = "none_of_these"
        elif len(fitted) > 1:
            verdict = "group" if any(len(group) > 1 for group in record.groups) else "effect"
        explained = verdict == "none_needed" or not cfg.explain
        verdict = budget.verdict(verdict, [f.step for f in record.findings if f.accepted])
        step = record.time_step
        in_time, doubtful = verdict != "unsettled", not adequate and verdict in ("none_of_these", "unsettled")
        if step is not None and doubtful and may_be_step(last, step, cfg.time_step, of_any_size=not in_time):
            verdict, step = "unsettled", replace(step, too_long=True)
        named = verdict in ("effect", "group")
        where = budget.attempt(
            lambda: () if explained else self._failures(given), (), "Left out: where the model as given fails."
        )
        experiment = budget.attempt(
            lambda: None if explained else self._suggested_experiment(), None, "Left out: the next experiment."
        )
        after = fitted[1:] if fitted[0] is given else fitted
        replay = (cfg.explain or not named) and fitted[-1] is not given
        alike = budget.attempt(
            lambda: self._replayed(given, last) if replay else None, None, "Left out: a replay in one piece."
        )
        # What is not named is saved only where it follows the recording better.
        least = cfg.min_explained if verdict == "none_of_these" else 0.0
        farther = not named and alike is not None and not alike.explains(least)
        return Diagnosis(
            verdict=verdict,
            effects=tuple(sorted(record.findings, key=lambda f: (not f.accepted, f.step, -f.gain))),
            groups=tuple(record.groups),
            where=where,
            unexplained=max(unexplained, unknown.share) if unknown is not None and lacking else unexplained,
            ratio=(given.noise_ratio, *(one.noise_ratio for one in after)),
            detectable=detectable,
            next_experiment=experiment,
            issues=(
                *issues,
                *(said_of_impacts(cfg.search.impact_error) if self.impacts_left else ()),
                *said_of_own_friction(own_error),
            ),
            models=(given.delivered, *(one.delivered for one in after)),
            seed=cfg.seed,
            unknown_force=unknown,
            form_error=form_error if named else None,
            remainder_searched=not budget.cut if named else None,
            replayed=alike if named else None,
            time_step=step,
            holding=record.holding,
            nominal_values=record.nominal_values,
            unsettled=tuple(budget.unsettled),
            explains=not farther and (verdict != "none_of_these" or unexplained <= 1 - cfg.min_explained),
            farther=farther,
        )

    def _replayed(self, given: FittedModel, last: FittedModel) -> Replayed | None:
        """Return what a replay in one piece says of the last model."""
        limit = self.context.cfg.doubtful_replay
        return replayed(given.delivered, last.delivered, self.recording, last.windows, limit, self.engine)

    def _error_of_own_friction(self, last: FittedModel) -> float | None:
        """Return what a model without added effects leaves where that may be the error of its friction, else None."""
        error = partial(error_of_own_friction, last, self.context.cfg, self.context.results)
        return self.context.budget.attempt(
            error, None, "Open: whether what is left is an error of the model's friction."
        )

    def _suggested_experiment(self) -> SuggestedExperiment | None:
        """Return the experiment that distinguishes the first group of effects, None where there is no such group."""
        groups = [found for found in self.record.hypotheses if len(found) > 1]
        if not groups:
            return None
        cfg = self.context.cfg
        cfg = replace(cfg.experiment, seed=cfg.seed, observation=cfg.fits.observation)
        given = self.model.scene.model.opt.timestep
        models = {
            name: m if m.scene.model.opt.timestep == given else replace(m, scene=m.scene.with_timestep(given))
            for name, m in groups[0].items()
        }
        return suggest_experiment(models, self.recording, cfg, engine=self.engine)

    def _failures(self, given: FittedModel) -> tuple[Mapping[str, Any], ...]:
        """Return where the model as given fails."""
        cfg = self.context.cfg.failures
        return tuple(
            locate_failures(
                given.delivered,
                self.recording,
                replace(cfg, max_seconds=min(cfg.max_seconds, self.context.budget.left())),
                engine=self.engine,
                windows=given.windows,
                offsets=given.fit.offsets,
            )
        )
