"""Effects added to a fitted model until no more than noise, or errors in their formulas, is left.

Beside each addition a shorter time step, nominal values within their tolerance and a flexible correction of the effects
before it are tried: what one of them explains needs no further effect.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from concent_warp.diagnosis.candidates.baseline import add_candidate, errors_like
from concent_warp.diagnosis.candidates.candidate import FittedCandidate, FittedModel
from concent_warp.diagnosis.candidates.evidence import largest_size, leaves_more
from concent_warp.diagnosis.detectable import Detectable
from concent_warp.diagnosis.search.adequacy import discrepancies, is_lacking, is_near_noise
from concent_warp.diagnosis.search.beside_nominal import BesideNominalValues
from concent_warp.diagnosis.search.context import SearchContext
from concent_warp.diagnosis.search.find_addition import AdditionFinder
from concent_warp.diagnosis.search.form_error import flexible_correction
from concent_warp.diagnosis.search.holding import hold
from concent_warp.diagnosis.search.nominal_values import has_bounded_nominal_values, stays_within
from concent_warp.diagnosis.search.time_step import at_finer_step, finer_time_step, renew_defects
from concent_warp.diagnosis.search.time_step import finding as time_step_finding
from concent_warp.diagnosis.search.unknown_force import with_interleaved_folds
from concent_warp.fit.effects.observe import has_touchable_free_body
from concent_warp.simulate.time_limit import TimeUpError


class Additions:
    """Adds effects to fitted models."""

    def __init__(self, context: SearchContext, finder: AdditionFinder) -> None:
        """Prepare to add effects.

        Args:
            context: What the parts of the search share.
            finder: Finds each of them.
        """
        self.context, self.finder = context, finder

    def add_effects(
        self, fitted: list[FittedModel], detectable: tuple[Detectable, ...], *, effects_alone: bool = False
    ) -> tuple[list[FittedModel], tuple[Detectable, ...]]:
        """Return the fitted models with one more for each effect that is added, and the detectable sizes of all.

        Args:
            fitted: The model as given and after earlier additions.
            detectable: Smallest detectable sizes as far as they are known.
            effects_alone: Whether time step and nominal values stay as they are: over short windows the initial states
                hide what they change. Where nominal values explain what the first effects leave, no more are added.
        """
        context, record, fitted, first = self.context, self.context.record, list(fitted), fitted[0]
        cfg, factors = context.cfg, context.noise_factors
        while True:
            step = len(fitted) - 1
            # What a shorter time step leaves has a structure, too: that of the errors of both steps.
            explained = step or record.time_step is not None
            if explained and not is_lacking(fitted[-1], factors, cfg):
                if step and not effects_alone and is_lacking(fitted[-1], {}, cfg):
                    # More is left than the noise as estimated: nominal values may explain it, which are no effect.
                    fitted = self._with_nominal(fitted, None, first) or fitted
                break
            if step and context.is_form_error(fitted[-1], first):
                if record.provisional is None:
                    if effects_alone:
                        break
                    record.provisional = step
                elif step > record.provisional:
                    break
            if step and effects_alone and self._is_within_tolerances(fitted[-1], first):
                break
            if step and not effects_alone:
                fitted[-1] = self.with_holding(fitted[-1])
            finer = None if effects_alone else self._finer(fitted[-1], step)
            if finer is not None and not is_lacking(finer, factors, cfg):
                fitted = self._adopt(fitted, finer)
                break
            if finer is not None and self._is_decisive(fitted[-1], finer):
                fitted = self._adopt(fitted, finer)
                continue
            bounded, before = None, record.constants
            if not effects_alone and (found := self._with_nominal(fitted, finer, first)) is not None:
                if not step:
                    record.held_first = len(record.holding)
                if step >= cfg.max_additions or not self._is_at_bounds(found[-1]):
                    fitted = found
                    continue
                # Something larger may be missing: an effect that explains more comes first.
                bounded, record.constants, before = found, before, record.constants
            if step >= cfg.max_additions:
                return (fitted if finer is None else self._adopt(fitted, finer)), detectable
            if step and self._is_futile(fitted[-1]):
                if finer is None:
                    break
                fitted = self._adopt(fitted, finer)
                continue
            recorded = len(record.findings), len(record.groups)
            correction = None if effects_alone else self._correction(fitted[-1], first)
            try:
                adequate = not effects_alone and context.explains(fitted[-1], first, added=step > 0)
                best, smallest = self.finder.find(
                    fitted[-1], step, explained=adequate, beside_nominal=not effects_alone and cfg.nominal.enabled
                )
            except TimeUpError:
                context.budget.note(f"Open: whether {'another effect' if step else 'any effect'} is missing.", step)
                if bounded is not None:
                    fitted, record.constants = bounded, before
                break
            detectable = detectable or smallest
            if best is not None and not effects_alone and (held := self._held_instead(fitted[-1])) is not None:
                record.forget(*recorded)
                fitted, record.time_step, record.held_first = (
                    [*fitted[:-1], held],
                    before.time_step,
                    len(record.holding),
                )
                continue
            beside = None if best is None or effects_alone else self._comparison(fitted[-1], best)
            least = None if best is None else best.errors if beside is None else beside.errors(best)
            if bounded is not None and (
                least is None or not leaves_more(errors_like(bounded[-1], fitted[-1]), least, cfg.search)
            ):
                record.forget(*recorded)
                fitted, record.constants = bounded, before
                continue
            if finer is not None and (least is None or self._explains_as_much(finer, fitted[-1], least, beside)):
                record.forget(*recorded)
                fitted = self._adopt(fitted, finer)
                continue
            if best is not None and self._is_unsettled_remainder(fitted[-1], first, step):
                record.take_back(*recorded, "there was no time to fit what may explain as much of so small a remainder")
                break
            if best is not None and correction is not None and not self._explains_more(fitted[-1], best, correction):
                record.take_back(*recorded, "explains no more than a flexible correction of the effects before it")
                best = None
            if best is not None and self._is_implausible(fitted[-1], best, first):
                record.take_back(*recorded, "explains a small remainder by a size that is far beyond typical ones")
                best = None
            if best is None:
                record.form_corrected = self._is_corrected(fitted[-1], correction)
                break
            added = add_candidate(fitted[-1], best)
            renew = partial(renew_defects, added, cfg.time_step)
            unsettled = "Not computed again beside the last effect: what a shorter time step changes."
            fitted.append(context.budget.attempt(renew, added, unsettled))
        return fitted, detectable

    def _is_within_tolerances(self, one: FittedModel, first: FittedModel) -> bool:
        """Return whether nominal values within their tolerance leave no more than noise or errors in formulas."""
        found = self.context.nominal(one)
        if found is None:
            return False
        lacking = is_lacking(found, self.context.noise_factors, self.context.cfg)
        return not lacking or self.context.is_form_error(found, first)

    def _is_at_bounds(self, one: FittedModel) -> bool:
        """Return whether nominal values of a model are at their bounds, and more than noise is left."""
        return one.ratio > self.context.cfg.nominal.bounded_ratio and has_bounded_nominal_values(one.model)

    def _is_futile(self, one: FittedModel) -> bool:
        """Return whether no further effect could be accepted: down to the noise, less is left than it must remove."""
        cfg = self.context.cfg
        return 1 - 1 / one.ratio**2 < (cfg.quiet_min_gain if self._is_quiet(one) else cfg.min_gain)

    def _is_quiet(self, one: FittedModel) -> bool:
        """Return whether a model leaves little more than noise."""
        return is_near_noise(one, self.context.noise_factors, self.context.cfg)

    def _is_unsettled_remainder(self, one: FittedModel, first: FittedModel, step: int) -> bool:
        """Return whether a model leaves no more than errors in formulas, and the search for a further effect was cut.

        What is established explains nearly all then, and stands without the effect that is not settled.
        """
        return step > 0 and step in self.context.budget.cut and self.context.is_form_error(one, first)

    def _correction(self, one: FittedModel, first: FittedModel) -> np.ndarray | None:
        """Return the held-out errors of a model with a flexible correction of the effects that were added.

        It is None where there are none, and where they leave more than errors in their formulas may be.
        """
        context, cfg = self.context, self.context.cfg
        left, lacked = discrepancies(one, first)
        added = [a.effect for a in one.model.effects[len(first.model.effects) :] if not a.effect.nominal]
        if not added or left >= cfg.max_form_error * lacked or one.ratio > cfg.form_error_ratio:
            return None
        context.progress("correcting the formulas of the effects")
        unsettled = "Open: whether what is left is an error in the formulas of the effects."
        correct = partial(flexible_correction, one, added, cfg, context.results)
        return context.budget.attempt(correct, None, unsettled)

    def _explains_more(self, one: FittedModel, best: FittedCandidate, correction: np.ndarray) -> bool:
        """Return whether a candidate explains what a flexible correction of the effects of a model does not."""
        errors = with_interleaved_folds(add_candidate(one, best)).errors
        return leaves_more(correction, errors, self.context.cfg.search)

    def _is_implausible(self, one: FittedModel, best: FittedCandidate, first: FittedModel) -> bool:
        """Return whether a candidate explains a small remainder of a model by a size that hardly any machine has."""
        cfg, (left, lacked) = self.context.cfg, discrepancies(one, first)
        if one is first or left >= cfg.max_form_error * lacked:
            return False
        return largest_size(one, best) > cfg.max_typical_sizes

    def _is_corrected(self, one: FittedModel, correction: np.ndarray | None) -> bool:
        """Return whether a flexible correction of the effects of a model leaves little more than noise."""
        if correction is None:
            return False
        left = correction.sum() / max(float(with_interleaved_folds(one).errors.sum()), 1e-12)
        return one.ratio * float(np.sqrt(left)) <= self.context.cfg.search.explained_ratio

    def with_holding(self, one: FittedModel) -> FittedModel:
        """Return a fitted model with constraints that hold where more than noise is left and that explains more."""
        context = self.context
        return self._held(one) if is_lacking(one, context.noise_factors, context.cfg) else one

    def _held(self, one: FittedModel) -> FittedModel:
        """Return a fitted model with constraints that hold where that explains more, else that model."""
        context = self.context
        context.progress("constraints that hold")
        unsettled = "Open: whether constraints that hold explain more."
        found = context.budget.attempt(lambda: hold(one, context.record.holding, context.cfg), None, unsettled)
        if found is None:
            return one
        held, context.record.holding = found
        return held

    def _held_instead(self, one: FittedModel) -> FittedModel | None:
        """Return the model as given with constraints that hold where it leaves no more than noise, else None.

        It is None, too, where that explains no more. Such a model stays as given until an effect is found beside it;
        beside effects, and where more is left, friction has been tried before.
        """
        context = self.context
        if is_lacking(one, context.noise_factors, context.cfg):
            return None
        held = self._held(one)
        return None if held is one else held

    def _finer(self, one: FittedModel, step: int | None = None) -> FittedModel | None:
        """Return a fitted model with a shorter time step where that explains more and none has been adopted yet.

        Args:
            one: The fitted model.
            step: Index of the addition beside which it is tried, None for none.
        """
        context = self.context
        if context.record.time_step is not None:
            return None
        context.progress("halving the time step")
        unsettled = "Open: whether the model's time step is too long."
        cfg = replace(context.cfg, min_gain=context.least_gain(one))
        doubted = step if self._is_quiet(one) else None
        return context.budget.attempt(lambda: finer_time_step(one, cfg), None, unsettled, doubted=doubted)

    def _is_decisive(self, one: FittedModel, finer: FittedModel) -> bool:
        """Return whether a shorter time step explains so much that no effect may take its place."""
        left = float(errors_like(finer, one).sum() / max(one.errors.sum(), 1e-12))
        return left <= 1 - self.context.cfg.time_step.decisive_gain

    def _with_nominal(
        self, fitted: list[FittedModel], finer: FittedModel | None, first: FittedModel
    ) -> list[FittedModel] | None:
        """Return the fitted models, the last with nominal values and, where that explains more, a shorter time step.

        It is None where nominal values explain nothing more. Beside an effect they may be at their bounds where they
        leave no more than an error in its formula, which they take up before another effect does; without one, where
        they leave next to nothing of the discrepancy.
        """
        added = len(fitted) > 1
        enough = partial(self.context.is_form_error if added else self.context.is_little, first=first)
        both = None if finer is None else self._nominal(finer, enough, dependent=added)
        plain = self._nominal(fitted[-1], enough, dependent=added, with_step=added and finer is None)
        if finer is not None and both is not None and (plain is None or self._needs_step(plain, both)):
            return [*self._adopt(fitted, finer)[:-1], both]
        return None if plain is None else [*fitted[:-1], plain]

    def _nominal(
        self,
        one: FittedModel,
        enough: Callable[[FittedModel], bool],
        *,
        dependent: bool,
        with_step: bool = False,
        least: float | None = None,
    ) -> FittedModel | None:
        """Return a fitted model with nominal values within their tolerance, None where that explains nothing more.

        Errors of nominal values may hide those of the simulator's constants, and nominal values stand in for these:
        where they leave more than noise, constraints that hold are tried beside them, and then a shorter time step.

        Args:
            one: The fitted model.
            enough: Whether a model with values at their bounds leaves little enough.
            dependent: See `with_nominal_values`.
            with_step: Whether to try a shorter time step beside them.
            least: Share of the held-out error that they must remove [-]; by default that of an effect.
        """
        context, holding = self.context, self.context.record.holding
        found = context.nominal_fit(one, dependent=dependent, least=least)
        if found is None:
            return None
        held = self.with_holding(found)
        if stays_within(held, context.cfg.nominal, enough):
            return held
        # Constraints that hold, beside which nominal values are right, may need a shorter step than those as given.
        finer = self._finer(held) if with_step or held is not found else None
        if finer is not None and stays_within(finer, context.cfg.nominal, enough):
            return self._adopt([held], finer)[-1]
        context.record.holding = holding
        return found if stays_within(found, context.cfg.nominal, enough) else None

    def within_tolerances(self, given: FittedModel) -> FittedModel | None:
        """Return the model as given with constants within their tolerance where that leaves next to nothing.

        Nominal values, constraints that hold, and a shorter time step where the model needs one. Where a model is far
        off effects are looked for over short windows, without these, and would stand in for them. None where they
        leave more.

        Args:
            given: The model as given, over windows as long as the motion allows.
        """
        context, cfg = self.context, self.context.cfg
        if not cfg.nominal.enabled or has_touchable_free_body(given.model.compile()):
            return None
        before, unsettled = context.record.copy(), "Open: whether nominal values alone explain the data."

        def attempt() -> FittedModel | None:
            """Return the model where nominal values take away most of what is left, if need be with a shorter step."""
            enough, least = partial(context.is_little, first=given), cfg.nominal.decisive_gain
            held = self.with_holding(given)
            found = self._nominal(held, enough, dependent=True, least=least)
            if found is not None and not is_lacking(found, context.noise_factors, cfg):
                return found
            # Values at their bounds stand in for a part of the step's error, and then hide what it would explain.
            if (finer := at_finer_step(held, cfg.time_step)) is None:
                return found
            both = self._nominal(finer, enough, dependent=True, least=least)
            if both is None or (found is not None and not self._needs_step(found, both)):
                return found
            return self._adopt([held if found is None else found], both)[-1]

        found = context.budget.attempt(attempt, None, unsettled)
        if found is None or (is_lacking(found, context.noise_factors, cfg) and not context.is_little(found, given)):
            context.record = before
            return None
        context.record.held_first = len(context.record.holding)
        return found

    def _needs_step(self, plain: FittedModel, finer: FittedModel) -> bool:
        """Return whether a model explains more with a shorter time step, which nominal values may stand in for."""
        return bool(errors_like(finer, plain).sum() < (1 - self.context.cfg.min_gain) * plain.errors.sum())

    def _comparison(self, one: FittedModel, best: FittedCandidate) -> BesideNominalValues | None:
        """Return what compares a candidate beside nominal values where these are compared so, else None."""
        found = self.context.beside_nominal(one) if self.context.cfg.nominal.enabled else None
        return found if found is not None and found.tells([best], self.context.cfg) else None

    def _explains_as_much(
        self, finer: FittedModel, one: FittedModel, least: np.ndarray, beside: BesideNominalValues | None
    ) -> bool:
        """Return whether a model with a shorter time step leaves no more than a candidate does.

        Args:
            finer: The model with a shorter time step.
            one: The model as the candidate was added to it.
            least: Held-out errors of blocks that the candidate leaves, shape (B,).
            beside: Compares beside nominal values, None where the candidate was not compared so.
        """
        left = errors_like(finer, one) if beside is None else beside.errors(finer)
        return bool(left.sum() <= (1 + self.context.cfg.search.equal_error) * least.sum())

    def _adopt(self, fitted: list[FittedModel], finer: FittedModel) -> list[FittedModel]:
        """Return the fitted models with the last one replaced by that with a shorter time step."""
        self.context.record.time_step = time_step_finding(fitted[-1], finer, self.context.cfg.seed)
        return [*fitted[:-1], finer]
