"""The first of several effects replaced by its rivals, and the search continued from each.

Effects are added one at a time, and the first is chosen while the others are still missing: one that stands for parts
of several then comes before each of them, and what is left leads to a second imitation. A search that keeps a few
beginnings finds sets of effects that no exchange of a single one leads to (beam search).
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.result import Detectable, Finding, FinerTimeStep
from concent_warp.diagnosis.search.candidate import FittedModel
from concent_warp.diagnosis.search.evidence import leaves_more, surprise
from concent_warp.diagnosis.search.reconsider import Rival, beside
from concent_warp.diagnosis.tasks import TaskRunner
from concent_warp.diagnosis.time_budget import TimeBudget
from concent_warp.model import Model

KEPT = ("findings", "groups", "hypotheses", "widening", "rivals", "time_step", "provisional", "form_corrected")
"""What a search records in its procedure."""


class Search(Protocol):
    """A diagnosis that can continue its search, see `concent_warp.diagnosis.procedure`."""

    cfg: DiagnoseCfg
    runner: TaskRunner
    budget: TimeBudget
    findings: list[Finding]
    groups: list[tuple[str, ...]]
    hypotheses: list[dict[str, Model]]
    widening: dict[int, np.ndarray]
    rivals: dict[int, tuple[Rival, ...]]
    time_step: FinerTimeStep | None
    provisional: int | None
    form_corrected: bool

    def add_effects(
        self, fitted: list[FittedModel], detectable: tuple[Detectable, ...]
    ) -> tuple[list[FittedModel], tuple[Detectable, ...]]:
        """Return the fitted models with one more for each effect that is added, and the detectable sizes of all."""
        ...


def try_alternatives(procedure: Search, fitted: list[FittedModel]) -> list[FittedModel]:
    """Return the fitted models of the search from another first effect, where that leads to a more plausible answer.

    Answers count that explain as much as the best, or leave little more than noise: what one with more parameters
    explains beyond that is weighed by their number. An answer that the data cannot distinguish from the best, and that
    differs by one effect, adds that to the group of the one in whose place it stands.

    Args:
        procedure: The diagnosis; what it has recorded is that of the returned models afterwards.
        fitted: The model as given and after each addition, at least two.
    """
    cfg, first, budget = procedure.cfg, fitted[0], procedure.budget
    begun, cut, unsettled = _recorded(procedure), set(budget.cut), list(budget.unsettled)
    answers = [(fitted, begun)]
    equals = set(procedure.groups[0])
    others = [
        r for r in procedure.rivals.get(0, ()) if r.finding.name not in equals and r.finding.p <= cfg.significance_level
    ]
    for rival in others[: cfg.search.alternatives]:
        _record(procedure, begun)
        procedure.runner.progress(procedure.runner.share, f"trying {rival.finding.name} as the first effect")
        open_question = f"Open: whether {rival.finding.name} with another effect explains more."
        found = budget.attempt(lambda r=rival: _from(procedure, first, r), None, open_question)
        if found is not None and budget.cut == cut:
            answers.append((found, _recorded(procedure)))
            continue
        # The first answer is none the less complete.
        budget.cut, budget.unsettled = set(cut), list(unsettled)
        budget.note(open_question)
        unsettled = list(budget.unsettled)
    least = min(answers, key=lambda answer: answer[0][-1].errors.sum())[0][-1]
    equal = [
        (found, recorded)
        for found, recorded in answers
        if not leaves_more(found[-1].errors, least.errors, cfg.search) or found[-1].ratio <= cfg.search.explained_ratio
    ]
    equal.sort(key=lambda answer: -plausibility(answer[0][-1]))
    best, recorded = equal[0]
    _record(procedure, recorded)
    for other, of_other in equal[1:]:
        if plausibility(other[-1]) > plausibility(best[-1]) - 2 * np.log(cfg.search.max_odds):
            _add_to_group(procedure, of_other, other[-1])
    return best


def _add_to_group(procedure: Search, recorded: Mapping[str, Any], last: FittedModel) -> None:
    """Add the effect by which another answer differs from a procedure's to the group of the one that it replaces."""
    steps = {f.name: f.step for f in procedure.findings if f.accepted}
    names = {f.name for f in recorded["findings"] if f.accepted}
    ours, theirs = sorted(steps.keys() - names), sorted(names - steps.keys())
    if len(ours) == len(theirs) == 1 and theirs[0] not in procedure.groups[steps[ours[0]]]:
        step = steps[ours[0]]
        procedure.groups[step] = (*procedure.groups[step], theirs[0])
        procedure.hypotheses[step] = {**procedure.hypotheses[step], theirs[0]: last.model}


def _from(procedure: Search, first: FittedModel, rival: Rival) -> list[FittedModel]:
    """Return the fitted models of the search that begins with a rival of the first effect."""
    instead = replace(rival.finding, accepted=True, reason="")
    procedure.findings = [
        replace(f, accepted=False, reason="another one explains more beside the others") if f.accepted else f
        for f in procedure.findings
        if f.step == 0 and f.name != instead.name
    ]
    procedure.findings.insert(0, instead)
    begun = beside(first, rival)
    procedure.groups, procedure.hypotheses = [(instead.name,)], [{instead.name: begun.model}]
    procedure.widening = {0: np.ones(len(instead.parameters))}
    procedure.rivals = {0: procedure.rivals[0]}
    procedure.provisional, procedure.form_corrected = None, False
    if first.windows[0].defect is None:
        procedure.time_step = None
    return procedure.add_effects([first, begun], ())[0]


def plausibility(one: FittedModel) -> float:
    """Return twice the log posterior of a fitted model's effects, up to a constant.

    Schwarz's criterion with noise of unknown size, blocks of time as the observations (Annals of Statistics 6, 1978),
    a Cauchy prior of the effects' sizes and a normal one of nominal values, and the effects' rarity.
    """
    prediction, count = one.prediction(), one.blocks.count
    score = -count * float(np.log(max(one.errors.sum(), 1e-12)))
    for added, part in zip(one.model.effects, prediction.split, strict=True):
        parameters, values = prediction.parameters[part], one.fit.values[part]
        if added.effect.nominal:
            away = np.array([(v - p.null) / p.scale for v, p in zip(values, parameters, strict=True)])
            score -= float((away**2).sum()) / one.cfg.least_squares.prior**2
        else:
            score -= surprise(added.effect, parameters, values.tolist(), count)
    return score


def _recorded(procedure: Search) -> dict[str, Any]:
    """Return copies of what a search has recorded."""
    return {name: copy(getattr(procedure, name)) for name in KEPT}


def _record(procedure: Search, recorded: Mapping[str, Any]) -> None:
    """Set what a search has recorded."""
    for name, value in recorded.items():
        setattr(procedure, name, copy(value))
