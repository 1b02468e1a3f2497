"""What the parts of a search for missing effects share.

Settings, tasks, time and record of the search, and whether a fitted model explains the data.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.search.adequacy import discrepancies, is_adequate, is_near_noise
from concent_warp.diagnosis.search.beside_nominal import BesideNominalValues
from concent_warp.diagnosis.search.nominal_values import (
    nominal_effects,
    nominal_sensitivities,
    stays_within,
    with_nominal_values,
)
from concent_warp.diagnosis.search.record import SearchRecord
from concent_warp.diagnosis.tasks import TaskRunner, run_tasks
from concent_warp.diagnosis.time_budget import TimeBudget

T = TypeVar("T")

BASELINE_DONE, ADDITIONS_DONE, REVISION_DONE, PROFILES_DONE, VALUES_DONE = 0.1, 0.78, 0.8, 0.92, 0.95
"""Shares of a diagnosis that are done after baseline, additions, their revision, the profile likelihoods and the final
values. Empirical."""
ADDITION_PART = 0.75
"""Share of what is left that an addition takes if it is the last, and what is left then if it is not [-]. Empirical."""
SCREENED_PART, FITTED_PART = 0.4, 0.8
"""Shares of an addition that are done once candidates are screened, and fitted [-]. Empirical."""


class SearchContext:
    """What the parts of one search share. Its time starts when it is made."""

    def __init__(self, cfg: DiagnoseCfg, runner: TaskRunner) -> None:
        """Prepare a search."""
        self.cfg, self.runner = cfg, runner
        self.budget = TimeBudget(cfg.seconds)
        self.noise_factors: Mapping[str, float] = {}
        """By how much the noise of each channel may be larger than its estimate, 1 where it is stated [-]."""
        self.record = SearchRecord()
        self._beside: BesideNominalValues | None = None

    def progress(self, text: str) -> None:
        """Report what is being done."""
        self.runner.progress(self.runner.share, text)

    def enter_addition(self, step: int, begin: float, end: float) -> None:
        """Begin a phase of an addition, from one share of it to another, 0..1.

        That further additions follow is not known before: the share of the diagnosis falls where one does.
        """
        left = (1 - BASELINE_DONE) * ADDITION_PART**step
        span = ADDITION_PART * left
        self.runner.enter(1 - left + begin * span, 1 - left + end * span)

    def results(self, task: Callable[..., T], tasks: Sequence[tuple[Any, ...]]) -> Iterable[T]:
        """Return the results of a task for each tuple of arguments."""
        return run_tasks(task, tasks, self.cfg.jobs)

    def least_gain(self, one: FittedModel) -> float:
        """Return the share of a model's held-out error that a shorter time step or nominal values must remove."""
        near = one.ratio <= self.cfg.form_error_ratio
        return self.cfg.min_gain if near else max(self.cfg.min_gain, self.cfg.search.far_min_gain)

    def is_form_error(
        self, one: FittedModel, first: FittedModel, record: SearchRecord | None = None, *, near_noise: bool = False
    ) -> bool:
        """Return whether a model with added effects leaves no more than errors in their formulas.

        Little is then left beside the discrepancy of the first model, and little beside the noise; less beside the
        discrepancy where it is more beside the noise.

        Args:
            one: The fitted model.
            first: The model as given.
            record: What the search that led to the model has found; by default that of this context.
            near_noise: Whether no more than `DiagnoseCfg.form_error_ratio` beside the noise counts in any case.
        """
        left, lacked = discrepancies(one, first)
        share = self.cfg.max_form_error if (record or self.record).form_corrected else self.cfg.unknown_force.min_share
        if one.ratio > self.cfg.form_error_ratio:
            small = not near_noise and one.ratio <= self.cfg.small_form_error_ratio
            share = self.cfg.small_form_error if small else 0.0
        return left < share * lacked

    def is_little(self, one: FittedModel, first: FittedModel) -> bool:
        """Return whether a model without added effects leaves next to nothing of the discrepancy of the first one.

        See `NominalCfg.bounded_remainder`.

        Args:
            one: The fitted model.
            first: The model as given.
        """
        left, lacked = discrepancies(one, first)
        return one.ratio <= self.cfg.adequate_ratio and left < self.cfg.nominal.bounded_remainder * lacked

    def explains(self, one: FittedModel, first: FittedModel, *, added: bool) -> bool:
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
        return (adequate and is_near_noise(one, self.noise_factors, self.cfg)) or self.is_form_error(one, first)

    def is_far_off(self, one: FittedModel, first: FittedModel) -> bool:
        """Return whether a model with added effects leaves far more than noise, and much of the discrepancy.

        Nothing that is combined from what was found explains the data then.

        Args:
            one: The fitted model.
            first: The model as given.
        """
        left, lacked = discrepancies(one, first)
        return one.noise_ratio > self.cfg.search.far_ratio and left > self.cfg.search.far_min_gain * lacked

    def takes_up_parts(self, last: FittedModel) -> bool:
        """Return whether one of several accepted effects leaves too large a part of what is left without it.

        Where more than noise is left, an effect that is missing explains nearly all of what the others leave, one that
        stands in for what the library lacks a part, see `DiagnoseCfg.max_remainder`.

        Args:
            last: The fitted model with all of them.
        """
        gains = [f.gain for f in self.record.accepted()]
        if len(gains) < 2 or is_near_noise(last, self.noise_factors, self.cfg):
            return False
        without = last.ratio**2 / max(1 - min(gains), 1e-12)
        return last.ratio**2 - 1 > self.cfg.max_remainder * (without - 1)

    def nominal(self, one: FittedModel) -> FittedModel | None:
        """Return a fitted model with nominal values within their tolerance, None where that explains nothing more.

        It is None, too, where one runs to its bound and more than noise is left.

        Args:
            one: The fitted model.
        """
        found = self.nominal_fit(one)
        return found if found is not None and stays_within(found, self.cfg.nominal) else None

    def nominal_fit(
        self, one: FittedModel, *, dependent: bool = False, least: float | None = None
    ) -> FittedModel | None:
        """Return a fitted model with nominal values up to their bounds, None where that explains nothing more.

        Args:
            one: The fitted model.
            dependent: See `with_nominal_values`.
            least: Share of the held-out error that they must remove [-]; by default that of an effect.
        """
        if not self.cfg.nominal.enabled or nominal_effects(one.model):
            return None
        self.progress("fitting nominal values within their tolerance")
        unsettled = "Open: whether nominal values are off within their tolerance."
        beside = self.beside_nominal(one)
        if beside is None:
            return None
        least = self.least_gain(one) if least is None else least
        fit = partial(with_nominal_values, one, self.cfg.nominal, least, beside.sensitivities, dependent)
        return self.budget.attempt(fit, None, unsettled)

    def beside_nominal(self, base: FittedModel, doubted: int | None = None) -> BesideNominalValues | None:
        """Return what compares candidates for a fitted model beside nominal values, None where there was no time.

        Args:
            base: The fitted model.
            doubted: Index of the addition that is in doubt without it, see `TimeBudget.doubted`.
        """
        if self._beside is None or self._beside.base is not base:
            unsettled = "Left out of the comparison of candidates: errors of nominal values."
            work = partial(nominal_sensitivities, base)
            found = self.budget.attempt(work, None, unsettled, doubted=doubted)
            self._beside = None if found is None else BesideNominalValues(base, found)
        return self._beside
