"""What becomes of the accepted effects after a search.

Earlier ones are tried again beside later ones, those that others have made superfluous are removed, and all that stay
are fitted together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from concent_warp.diagnosis.candidates.baseline import (
    add_candidate,
    cost_like,
    errors_like,
    refit_without_effect,
    without_effect,
)
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.candidates.evidence import AT_NULL, profile_widening
from concent_warp.diagnosis.candidates.profile_likelihood import refine_by_profile
from concent_warp.diagnosis.search.context import PROFILES_DONE, REVISION_DONE, VALUES_DONE, SearchContext
from concent_warp.diagnosis.search.holding import with_scene
from concent_warp.diagnosis.search.impact_step import resolved_impacts
from concent_warp.diagnosis.search.joint_fit import (
    established_effects,
    joint_finding,
    joint_parameters,
    refit_jointly,
    with_intervals,
)
from concent_warp.diagnosis.search.nominal_values import nominal_effects, nominal_errors, without_nominal_values
from concent_warp.diagnosis.search.reconsider import reconsider
from concent_warp.diagnosis.search.time_step import at_given_step, renew_defects
from concent_warp.diagnosis.time_budget import PROFILE_SHARE, TOGETHER_SHARE


class Revision:
    """Revises the fitted models of a search, and its record with them."""

    def __init__(self, context: SearchContext) -> None:
        """Prepare to revise what a search has found."""
        self.context = context
        self.reduced: list[FittedModel] = []
        """The last fitted model without one of its effects each, as refitted when that was tried."""
        self.hurried = False
        """Whether there was no time for what errors of nominal values do to the intervals of the answer."""

    def simplified(self, fitted: list[FittedModel]) -> list[FittedModel]:
        """Return the fitted models without superfluous effects, and without one that takes up errors of formulas.

        Where no effect is left, it is one model: with nominal values in their place, or the first.
        """
        record = self.context.record
        found, provisional = self.remove_superfluous(self.reconsidered(fitted)), record.provisional
        if len(found) > 1 and not record.accepted():
            return found[-1:] if _is_other(found) else found[:1]
        if len(found) > len(fitted) or provisional is None or len(fitted) <= provisional + 1:
            return found
        before, after = fitted[provisional], fitted[provisional + 1]
        if after.ratio**2 - 1 <= self.context.cfg.max_remainder * (before.ratio**2 - 1):
            return found
        record.keep_groups(provisional)
        reason = "explains no more than errors in the formulas of the others"
        record.refuse(lambda f: f.step == provisional, reason)
        if found[-1] is fitted[-1]:
            return found[: provisional + 1]
        # Another effect has taken the place of an earlier one since.
        return [*found[:provisional], refit_without_effect(found[-1], len(found[-1].model.effects) - 1)]

    def reconsidered(self, fitted: list[FittedModel]) -> list[FittedModel]:
        """Return the fitted models, in the last one the effect of each addition that explains most beside the others.

        The last addition has just been compared with its rivals beside all others, unless a shorter time step or
        nominal values were adopted after it: what these explain was then left by all of them, and hid their differences
        or was taken up by some.
        """
        context, record = self.context, self.context.record
        accepted = record.accepted()
        compared = accepted[:-1] if len(fitted) < 2 or not _is_other(fitted[-2:]) else accepted
        for k, f in enumerate(compared):
            among = record.rivals.get(f.step, ())[: context.cfg.search.reconsidered]
            if len(among) < 2:
                continue
            context.progress("trying earlier rivals beside later effects")
            last, unsettled = fitted[-1], f"Open: whether another effect than {f.name} explains more beside the others."
            index = len(last.model.effects) - len(accepted) + k
            found = context.budget.attempt(partial(reconsider, last, index, among, context.cfg), None, unsettled)
            if found is None:
                continue
            fitted = [*fitted[:-1], found.last]
            record.exchange(f, found.group)
        return fitted

    def remove_superfluous(self, fitted: list[FittedModel]) -> list[FittedModel]:
        """Return the fitted models, with one more for each effect that is removed since later ones made it superfluous.

        The last one added has just been tested beside all others.
        """
        context, record = self.context, self.context.record
        steps = list(range(len(fitted) - 1))
        # A shorter time step, or nominal values in place of another one, may have made the last one superfluous too.
        while len(steps) > (untested := 0 if _is_other(fitted) else 1):
            last = fitted[-1]
            owned = len(last.model.effects) - len(steps)
            context.progress("removing one effect at a time")
            tasks = [(last, owned + k) for k in range(len(steps) - untested)]
            unsettled = "Open: whether an effect is superfluous beside the others."
            refit = partial(lambda given: list(context.results(refit_without_effect, given)), tasks)
            if (reduced := context.budget.attempt(refit, None, unsettled)) is None:
                break
            self.reduced = reduced
            reduced = [self._with_nominal_instead(one, last) for one in reduced]
            shares = [_gain_over(one, last) for one in reduced]
            needed = [self._least_share(one, fitted[0]) for one in reduced]
            least = int(np.argmin(np.subtract(shares, needed)))
            if shares[least] >= needed[least]:
                break
            step = steps.pop(least)
            fitted = [*fitted, reduced[least]]
            record.groups[step], record.hypotheses[step] = (), {}
            record.refuse(lambda f, step=step: f.step == step, "made superfluous by effects added later")
        record.groups = [group for group in record.groups if group]
        return fitted

    def _least_share(self, reduced: FittedModel, first: FittedModel) -> float:
        """Return the share of a model's error that an effect must explain which it lacks.

        Where other effects leave no more than errors in their formulas may be, it is that of a further effect beside
        them, see `DiagnoseCfg.max_remainder`.
        """
        context, cfg = self.context, self.context.cfg
        others = len(reduced.model.effects) > len(first.model.effects)
        if not others or reduced.ratio <= cfg.form_error_ratio or not context.is_form_error(reduced, first):
            return cfg.min_gain
        return max(cfg.min_gain, (1 - cfg.max_remainder) * max(1 - 1 / reduced.ratio**2, 0.0))

    def _with_nominal_instead(self, reduced: FittedModel, last: FittedModel) -> FittedModel:
        """Return a model without one of the last model's effects, with nominal values within their tolerance if better.

        They were not fitted while other effects were missing, and then an effect may stand for them.
        """
        if _gain_over(reduced, last) < self.context.cfg.min_gain:
            return reduced
        found = self.context.nominal(reduced)
        return reduced if found is None else found

    def restore_given(self, fitted: list[FittedModel], given: FittedModel) -> list[FittedModel]:
        """Return the fitted models, the last with constants and nominal values as given where others explain no more.

        Effects that were added later may have made them superfluous. Where the model as given leaves no more than noise
        and no effect was accepted, it stays as given.
        """
        context, record = self.context, self.context.record
        if not record.accepted() and not self._is_lacking(given):
            record.time_step, record.holding = None, ()
            return [given]
        last, sentence = fitted[-1], "Open: whether {} beside the effects."
        if record.time_step is not None:
            context.progress("restoring the time step")
            refit = partial(at_given_step, last, given.timestep, context.cfg.time_step)
            restored = self._if_as_good(last, refit, sentence.format("a shorter time step is needed"))
            record.time_step = None if restored is not last else record.time_step
            last = restored
        if record.holding:
            context.progress("restoring the constants of constraints")
            refit = partial(with_scene, last, given.model.scene, context.cfg.time_step)
            restored = self._if_as_good(last, refit, sentence.format("constraints that hold are needed"))
            record.holding = () if restored is not last else record.holding
            last = restored
        if nominal_effects(last.model):
            context.progress("restoring nominal values")
            refit = partial(without_nominal_values, last)
            last = self._if_as_good(last, refit, sentence.format("other nominal values are needed"))
        return [*fitted[:-1], last]

    def with_resolved_impacts(self, fitted: list[FittedModel]) -> list[FittedModel]:
        """Return the fitted models, the last with a step that resolves impacts where an effect is one of contacts."""
        context, record = self.context, self.context.record
        if record.time_step is not None or all(f.family != "contact" for f in record.accepted()):
            return fitted
        context.progress("shortening the time step for impacts")
        unsettled = "Open: whether a shorter time step changes the constants of contacts."
        found = context.budget.attempt(lambda: resolved_impacts(fitted[-1], context.cfg), None, unsettled)
        if found is None:
            return fitted
        last, record.time_step = found
        return [*fitted[:-1], last]

    def _is_lacking(self, one: FittedModel) -> bool:
        """Return whether the residual beyond the noise is as much as an effect must remove."""
        return one.ratio**2 >= 1 + self.context.cfg.min_gain

    def _if_as_good(self, last: FittedModel, refit: Callable[[], FittedModel], unsettled: str) -> FittedModel:
        """Return a simpler fitted model if it explains nearly as much as the last one, else that."""
        reduced = self.context.budget.attempt(refit, None, unsettled)
        return last if reduced is None or _gain_over(reduced, last) >= self.context.cfg.min_gain else reduced

    def profiled(self, fitted: list[FittedModel]) -> list[FittedModel]:
        """Return the fitted models, with the profile likelihood of each accepted effect in the record.

        Where that of the last addition finds a lower cost, the last model continues there.
        """
        context, record, cfg = self.context, self.context.record, self.context.cfg
        context.runner.enter(REVISION_DONE, PROFILES_DONE)
        for f in record.accepted():
            if f.step not in record.unprofiled:
                continue
            base, c = record.unprofiled.pop(f.step)
            is_last = fitted[-1].fit is c.fit
            refine = partial(refine_by_profile, base, c, context.runner, cfg.profile, restarts=is_last)
            unsettled = f"Interval of {f.name} from the linear fit, not from its profile likelihood."
            found = context.budget.attempt(refine, c, unsettled, PROFILE_SHARE)
            record.widening[f.step] = profile_widening(base, found)
            if is_last and found.fit.cost < c.fit.cost:
                fitted = [*fitted[:-1], renew_defects(add_candidate(base, found), cfg.time_step)]
        return fitted

    def final_values(self, fitted: list[FittedModel]) -> list[FittedModel]:
        """Return the fitted models, the last with all that was accepted fitted together, and update the findings to it.

        Effects that are not established beside the others are removed one at a time, the rest fitted again.
        """
        record = self.context.record
        while True:
            found, without, established = self._fitted_together(fitted)
            if (fewer := self.remove_unestablished(found, without, established)) is None:
                return found
            record.with_unestablished = record.with_unestablished or found
            fitted = fewer

    def _fitted_together(
        self, fitted: list[FittedModel]
    ) -> tuple[list[FittedModel], list[FittedModel | None], list[bool]]:
        """Return the fitted models, the last with all that was accepted fitted together, and update the findings to it.

        The gain of each effect is then that over the same model without it. These models are returned too, one for each
        accepted effect, None where there was no time, and whether an interval of it without the profile likelihood,
        which a rough cost widens, excludes its null value.
        """
        context, record = self.context, self.context.record
        accepted, reduced = record.accepted(), []
        if not accepted and not nominal_effects(fitted[-1].model):
            record.nominal_values = ()
            return fitted, reduced, []
        context.runner.enter(PROFILES_DONE, VALUES_DONE)
        context.progress("fitting all effects together")
        attempt = context.budget.attempt
        unsettled = "Not refitted: all effects together."
        last = attempt(lambda: self._joint(fitted[-1]), fitted[-1], unsettled, TOGETHER_SHARE)
        owned = len(last.model.effects) - len(accepted)
        widening = {owned + k: record.widening[f.step] for k, f in enumerate(accepted)}
        unsettled = "Left out of the intervals: errors of nominal values."
        nominal = attempt(lambda: nominal_errors(last, context.cfg), None, unsettled, TOGETHER_SHARE)
        parameters, linear = (joint_parameters(last, by, nominal) for by in (widening, None))
        established = established_effects(last, linear, context.cfg.search.dependent_share, None, nominal)[owned:]
        self.hurried = nominal is None
        if self.hurried:  # errors of nominal values may be all that an effect beside another one stands for
            established = [sure and not k for k, sure in enumerate(established)]
        record.nominal_values = tuple(p for k in nominal_effects(last.model) for p in parameters[k])
        for k, f in enumerate(accepted):
            alone = len(accepted) == 1 and not _is_other(fitted) and not nominal_effects(last.model)
            final = replace(f, parameters=parameters[owned + k])
            unsettled = f"Not refitted: the model without {f.name}, for its gain beside the other effects."
            without = fitted[0]
            if not alone and (without := without_effect(last, owned + k, self.reduced)) is None:
                without = attempt(partial(refit_without_effect, last, owned + k), None, unsettled)
            if without is not None:
                final = joint_finding(f, parameters[owned + k], last, without, context.cfg.seed)
            record.update(f, final)
            reduced.append(without)
        return [*fitted[:-1], with_intervals(last, parameters, widening, nominal)], reduced, established

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
        accepted, first, last = self.context.record.accepted(), fitted[0], fitted[-1]
        for f, refitted, sure in sorted(zip(accepted, without, established, strict=True), key=lambda row: row[0].gain):
            if refitted is None or sure:
                continue
            reduced = self._with_nominal_instead(refitted, last)
            if not self.context.explains(reduced, first, added=len(accepted) > 1):
                continue
            reason = f"{AT_NULL} beside the others"
            if len(accepted) == 1:
                reason = AT_NULL
            elif self.hurried:
                reason = "there was no time to tell it from errors of nominal values"
            self.context.record.remove(f, reason)
            if len(accepted) > 1:
                return [*fitted, reduced]
            return [reduced] if _is_other([first, reduced]) else [first]
        return None

    def _joint(self, last: FittedModel) -> FittedModel:
        """Return the last model with all that was accepted fitted together."""
        return renew_defects(refit_jointly(last), self.context.cfg.time_step)


def _gain_over(reduced: FittedModel, last: FittedModel) -> float:
    """Return the share of a simpler model's error that the last one removes: held out, or of its cost if that is more.

    Held-out errors come from linear steps, which the bounds of the parameters do not stop.
    """
    pairs = ((errors_like(last, reduced).sum(), reduced.errors.sum()), (cost_like(last, reduced), reduced.fit.cost))
    return float(max(1 - less / max(more, 1e-12) for less, more in pairs))


def _is_other(fitted: Sequence[FittedModel]) -> bool:
    """Return whether the last of some fitted models has other constants, or nominal values, than the first."""
    first, last = fitted[0], fitted[-1]
    constants = first.timestep != last.timestep or first.model.scene.xml != last.model.scene.xml
    return constants or len(nominal_effects(first.model)) != len(nominal_effects(last.model))
