"""One addition of a search: the effect that explains most of what a fitted model leaves.

Screen all candidate effects, fit the most promising ones and test their held-out gains against the null distribution
of the best candidate's gain. Parts of elements are candidates only where no other one explains the data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from concent_warp.diagnosis.candidates.baseline import add_candidate, refit_from_rivals
from concent_warp.diagnosis.candidates.candidate import FittedCandidate, FittedModel, ScreenedCandidate
from concent_warp.diagnosis.candidates.candidates import candidates, is_single_of_many, label
from concent_warp.diagnosis.candidates.evidence import (
    AT_NULL,
    assess,
    detectable_size,
    leaves_more,
    profile_widening,
    with_scattering,
    without_implausible,
)
from concent_warp.diagnosis.candidates.fit_promising import CandidateFits
from concent_warp.diagnosis.candidates.gradient_start import GradientStarts
from concent_warp.diagnosis.candidates.grouping import group_indistinguishable
from concent_warp.diagnosis.candidates.null_distribution import max_gain_under_null
from concent_warp.diagnosis.candidates.screening import linear_at_measured_states, ranking, screen
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.detectable import Detectable
from concent_warp.diagnosis.result import Finding
from concent_warp.diagnosis.search.adequacy import is_adequate, is_near_noise, least_ratio
from concent_warp.diagnosis.search.beside_nominal import BesideNominalValues
from concent_warp.diagnosis.search.context import FITTED_PART, SCREENED_PART, SearchContext
from concent_warp.diagnosis.search.joint_fit import established_effects, joint_parameters
from concent_warp.diagnosis.search.nominal_values import (
    nominal_effects,
    nominal_errors,
)
from concent_warp.diagnosis.search.reconsider import near_best
from concent_warp.diagnosis.time_budget import in_words
from concent_warp.effects.effect import Effect
from concent_warp.effects.library.limits import is_stopped, reached_stops
from concent_warp.fit.effects.observation import Window
from concent_warp.model import Model
from concent_warp.simulate.time_limit import TimeUpError

CutWindows = Callable[[Model, float | None], Sequence[Window]]
"""Cuts the recording into windows of a length [s] for a model; as long as the motion allows where it is None."""


class AdditionFinder:
    """Finds the effects that a search adds, one at a time."""

    def __init__(
        self,
        context: SearchContext,
        channels: set[str],
        windows: CutWindows,
        gradient: GradientStarts | None = None,
    ) -> None:
        """Prepare to find effects.

        Args:
            context: What the parts of the search share.
            channels: Names of the measured channels.
            windows: See `CutWindows`.
            gradient: Starts fits by gradients, None where these are not asked for.
        """
        self.context, self.channels, self.windows, self.gradient = context, channels, windows, gradient

    def find(
        self, base: FittedModel, step: int, *, explained: bool = False, beside_nominal: bool = False
    ) -> tuple[FittedCandidate | None, tuple[Detectable, ...]]:
        """Return the effect to add to a fitted model, None where none is accepted, and the detectable sizes of all.

        Args:
            base: The fitted model.
            step: Index of the addition.
            explained: Whether the model explains the data already. An effect is then accepted only if the intervals
                that the answer would state, see `joint_parameters`, exclude its null values too.
            beside_nominal: Whether candidates are compared beside nominal values within their tolerance.

        Raises:
            TimeUpError: There was no time to fit a candidate.
        """
        context, cfg = self.context, self.context.cfg
        effects, parts = self._candidates(base)
        context.enter_addition(step, 0.0, SCREENED_PART)
        screened = self._screened(base, effects, step)
        if not screened:  # the model has all that were asked for
            return None, ()
        quiet = is_near_noise(base, context.noise_factors, cfg)
        doubted = step if quiet else None
        small = quiet and explained and step == 0 and self._is_as_given(base)
        if quiet:
            # What shows in the size of the residual no more than noise does must show the clearer in its structure.
            least_small = cfg.min_gain if context.record.beside_impacts else cfg.small_min_gain
            least_gain = least_small if small else cfg.quiet_min_gain
            cfg = replace(cfg, significance_level=cfg.quiet_significance_level, min_gain=least_gain)
        level = cfg.significance_level
        null, critical = self._chance(base, screened, level)
        needed = max(critical, cfg.min_gain)
        smallest = tuple(found for s in screened if (found := detectable_size(base, s, needed)) is not None)

        def finding(c: FittedCandidate) -> Finding:
            return assess(base, c, null, step, effects, cfg)

        def short_windows() -> Sequence[Window]:
            return self.windows(base.model, cfg.search.shooting_window)

        context.enter_addition(step, SCREENED_PART, FITTED_PART)
        least = self._least_promise(base)
        beside = context.beside_nominal(base) if beside_nominal else None
        if beside is not None:
            screened = beside.promoted(screened, cfg)
        fits = CandidateFits(base, cfg, context.runner)
        fitted = fits.fit(screened, needed, short_windows, least)
        if parts and context.record.provisional is None and self._leaves_more(base, fitted):
            more, effects = self._screened_parts(base, parts, step), [*effects, *parts]
            null, critical = self._chance(base, [*screened, *more], level)
            fitted = fits.fit(more, max(critical, cfg.min_gain), short_windows, least)
            fitted = without_imitations(base, fitted, cfg)
        for sentence, decides in fits.unsettled(lambda effect: label(effect, effects)):
            context.budget.note(sentence, step if decides else None)
        if not fitted and fits.left:
            raise TimeUpError
        findings = [finding(c) for c in fitted]
        rivals = [c for c, f in zip(fitted, findings, strict=True) if f.accepted]
        if rivals and max(c.share(base) for c in rivals) < cfg.search.doubtful_gain:
            leading = sorted(rivals, key=lambda c: -c.share(base))[: cfg.search.rivals]
            unsettled = "Open: whether other initial states let the model explain more without an effect."
            again = partial(refit_from_rivals, base, leading)
            base = context.budget.attempt(again, base, unsettled, doubted=doubted)
            findings = [finding(c) for c in fitted]
        # Of the base as it is now: its initial states may have been fitted anew.
        wanted = (explained or beside_nominal) and any(f.accepted for f in findings)
        beside = context.beside_nominal(base, doubted if beside_nominal else None) if wanted else None
        if explained:
            findings = self._established(base, fitted, findings, beside, quiet=quiet)
        elif not quiet:
            findings = with_scattering(base, fitted, findings, cfg.search)
        if beside is not None and beside_nominal:
            findings = self._beyond_nominal(beside, fitted, findings, step, small=small)
        whole = [f for f in findings if f.accepted and f.gain >= self._least_share(base)]
        context.record.part_refused = not whole and any(f.accepted for f in findings)
        if context.record.part_refused:
            reason = "removes a part of what may be errors in formulas"
            findings = [replace(f, accepted=False, reason=f.reason or reason) for f in findings]
        findings = without_implausible(base, fitted, findings, cfg)
        accepted = [(c, f) for c, f in zip(fitted, findings, strict=True) if f.accepted]
        if not accepted:
            context.record.findings += sorted(findings, key=lambda f: -f.gain)
            return None, smallest
        context.enter_addition(step, FITTED_PART, 1.0)
        tells = beside is not None and beside_nominal and beside.tells([c for c, _ in accepted], cfg)
        compare = beside.errors if beside is not None and tells else None
        group = group_indistinguishable(base, accepted, finding, context.runner, cfg, context.budget, compare)
        context.record.rivals[step] = near_best(base, fitted, findings, cfg)
        best = group[0][0]
        if compare is not None:
            most, reason = group[0][1].gain, "another one explains more beside nominal values"
            findings = [replace(f, reason=reason) if f.accepted and f.gain > most else f for f in findings]
        context.record.add(group, findings, profile_widening(base, best))
        if best.std is None:
            context.record.unprofiled[step] = base, best
        return best, smallest

    def _least_share(self, base: FittedModel) -> float:
        """Return the gain that the best effect must have where a model leaves little beyond the noise, 0 elsewhere."""
        cfg, factors = self.context.cfg, self.context.noise_factors
        if not is_adequate(base, factors, cfg):
            return 0.0
        return cfg.min_remainder_gain * max(1 - 1 / least_ratio(base, factors) ** 2, 0.0)

    def _least_promise(self, base: FittedModel) -> float:
        """Return the gain that an effect beside a provisional addition must promise, 0 where there is none.

        It is a share of what `DiagnoseCfg.max_remainder` asks for; an effect that makes an earlier one superfluous
        explains as much.
        """
        if self.context.record.provisional is None:
            return 0.0
        cfg = self.context.cfg
        needed = (1 - cfg.max_remainder) * max(1 - 1 / base.ratio**2, 0.0)
        return cfg.search.remainder_promise * needed

    def _stopped(self, base: FittedModel) -> set[str]:
        """Return the joints that come near a limit in the motion of a fitted model.

        Where a stop lies elsewhere, the model moves on to its own.
        """
        m = base.model.scene.model
        if not any(is_stopped(m, j) for j in range(m.njnt)):
            return set()
        solver = base.solver()
        courses = solver.p.courses(solver.trials(base.fit.values, base.fit.offsets))
        return reached_stops(m, [c.qpos for c in courses], self.context.cfg.search.stop_margin)

    def _candidates(self, base: FittedModel) -> tuple[list[Effect], list[Effect]]:
        """Return the effects that a fitted model may lack, and those considered only where none of these explains it.

        The latter are parts of elements, and single ones of some effects (`Effect.singles_last`); those of an effect
        that was asked for by its name are among the former.
        """
        asked = self.context.cfg.effects
        found = candidates(base.model, self.channels, asked, self._stopped(base))
        later = [e for e in found if e.name not in asked and (e.is_part or is_single_of_many(e, found))]
        return [e for e in found if e not in later], later

    def _leaves_more(self, base: FittedModel, fitted: Sequence[FittedCandidate]) -> bool:
        """Return whether the best of the fitted candidates, without any the model itself, leaves more than noise."""
        best = max(fitted, key=lambda c: c.share(base), default=base)
        return best.ratio > self.context.cfg.search.explained_ratio

    def _chance(
        self, base: FittedModel, screened: Sequence[ScreenedCandidate], level: float
    ) -> tuple[np.ndarray, float]:
        """Return the null distribution of the best candidate's gain, and its value at a significance level."""
        cfg = self.context.cfg
        null = max_gain_under_null(base, screened, cfg.null_samples, cfg.seed)
        return null, float(np.quantile(null, 1 - level))

    def _screened_parts(self, base: FittedModel, parts: Sequence[Effect], step: int) -> list[ScreenedCandidate]:
        """Return parts with their expected gains, none where there was no time: the other candidates stay."""
        try:
            return self._screened(base, parts, step, part=0.0)
        except TimeUpError:
            self.context.budget.note(f"Not screened: {in_words([label(e, parts) for e in parts])}.", step)
            return []

    def _established(
        self,
        base: FittedModel,
        fitted: Sequence[FittedCandidate],
        findings: Sequence[Finding],
        beside: BesideNominalValues | None,
        *,
        quiet: bool,
    ) -> list[Finding]:
        """Return findings, accepted ones with the intervals of the answer, refused if these include the null values.

        Refused, too, where the model leaves little more than noise in size, are those that remove little and do not so
        beside all nominal values. Sensitivities to these are those of the model that the candidates are added to.
        Effects of sensors that remove little are refused, too, where errors of impacts do not count as noise: scales
        and zeros of readings are as good as a calibration, and no nominal value stands for them.
        """
        found = list(findings)
        for k, (c, f) in enumerate(zip(fitted, findings, strict=True)):
            if not f.accepted:
                continue
            added = add_candidate(base, c)
            widening = {len(added.model.effects) - 1: profile_widening(base, c)}
            nominal = None if beside is None else nominal_errors(added, self.context.cfg, beside.sensitivities)
            parameters = joint_parameters(added, widening, nominal)
            found[k] = replace(f, parameters=parameters[-1])
            share = self.context.cfg.search.dependent_share
            if not established_effects(added, parameters, share, widening, nominal)[-1]:
                found[k] = replace(found[k], accepted=False, reason=AT_NULL)
            elif quiet and f.gain < self.context.cfg.quiet_min_gain:
                if f.family == "measurement" and not self.context.record.beside_impacts:
                    found[k] = replace(found[k], accepted=False, reason="removes little, as calibrations do")
                elif beside is None or not self._removes(beside, c, self.context.cfg.min_gain):
                    reason = "removes little, and less beside nominal values within their tolerance"
                    found[k] = replace(found[k], accepted=False, reason=reason)
        return found

    def _is_as_given(self, base: FittedModel) -> bool:
        """Return whether nominal values and time step of a fitted model are as given, while they might be others.

        What other ones leave has the structure of their errors.
        """
        given = self.context.record.time_step is None and not nominal_effects(base.model)
        return self.context.cfg.nominal.enabled and given

    def _beyond_nominal(
        self,
        beside: BesideNominalValues,
        fitted: Sequence[FittedCandidate],
        findings: Sequence[Finding],
        step: int,
        *,
        small: bool,
    ) -> list[Finding]:
        """Return findings, accepted ones refused that explain little beyond all nominal values within their tolerance.

        Of a model that is far off that says little: many values near their bounds at once are less plausible than one
        effect. What an effect leaves is another matter where they explain all of it, down to the noise.

        Args:
            beside: Compares beside nominal values.
            fitted: The candidates.
            findings: Their evidence, in the same order.
            step: Index of the addition.
            small: Whether a small effect is enough, see `DiagnoseCfg.small_min_gain`.
        """
        cfg, base = self.context.cfg, beside.base
        factor = least_ratio(base, self.context.noise_factors) / max(base.ratio, 1e-12)
        explained = factor * beside.ratio(base) <= cfg.search.explained_ratio
        if base.ratio > cfg.form_error_ratio and not (step and explained):
            return list(findings)
        needed = cfg.quiet_min_gain if explained and not small else cfg.min_gain
        reason = "explains little beyond nominal values within their tolerance"
        return [
            replace(f, accepted=False, reason=reason) if f.accepted and not self._removes(beside, c, needed) else f
            for c, f in zip(fitted, findings, strict=True)
        ]

    def _removes(self, beside: BesideNominalValues, c: FittedCandidate, share: float) -> bool:
        """Return whether a candidate removes a share of what all nominal values within their tolerance leave."""
        before, after = beside.errors(beside.base), beside.errors(c)
        return bool(after.sum() <= (1 - share) * before.sum() and leaves_more(before, after, self.context.cfg.search))

    def _screened(
        self, base: FittedModel, effects: Sequence[Effect], step: int, part: float = 1.0
    ) -> list[ScreenedCandidate]:
        """Return candidates with their expected gains.

        Args:
            base: The fitted model.
            effects: Candidates.
            step: Index of the addition.
            part: Share of the present phase that this takes, for the progress.
        """
        context, cfg = self.context, self.context.cfg
        at_measured = linear_at_measured_states(base, cfg.search)
        tasks = [(base, e, cfg.search, at_measured) for e in effects]
        found = context.runner.run_in_time(screen, tasks, "screening", part)
        screened = [s for s in found if s is not None]
        if len(screened) < len(effects):
            missed = [label(e, effects) for e, s in zip(effects, found, strict=True) if s is None]
            context.budget.note(f"Not screened: {in_words(missed)}.", step)
            if not screened:
                raise TimeUpError
        names = [label(e, effects) for e, s in zip(effects, found, strict=True) if s is not None]
        context.progress(ranking(base, screened, names, cfg.seed))
        return self.gradient.apply(base, screened, context.runner) if self.gradient else screened


def without_imitations(base: FittedModel, fitted: Sequence[FittedCandidate], cfg: DiagnoseCfg) -> list[FittedCandidate]:
    """Return candidates less those that count only where they explain the data alone, and leave more than they may.

    One of these that leaves far less than all others, and the model itself, stays: each other would stand in for it.
    """
    least = min((c.ratio for c in fitted if not c.effect.is_alone), default=base.ratio)
    most = max(cfg.form_error_ratio, np.sqrt(1 + cfg.search.alone_share * max(least**2 - 1, 0.0)))
    return [c for c in fitted if not c.effect.is_alone or c.ratio <= most]
