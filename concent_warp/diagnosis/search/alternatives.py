"""The first of several effects replaced by its rivals, and the search continued from each.

Effects are added one at a time, and the first is chosen while the others are still missing: one that stands for parts
of several then comes before each of them, and what is left leads to a second imitation, or to nothing. A search that
keeps a few beginnings finds sets of effects that no exchange of a single one leads to (beam search).

The strongest rival comes first. The strongest ones are often alike, such as a lag, a delay and a latency, and searches
from them end in the same place: of the others those come next that take something else from the residuals.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.candidates.evidence import leaves_more, surprise
from concent_warp.diagnosis.cfg import DiagnoseCfg, SearchCfg
from concent_warp.diagnosis.search.additions import Additions
from concent_warp.diagnosis.search.adequacy import discrepancies, is_near_noise
from concent_warp.diagnosis.search.context import SearchContext
from concent_warp.diagnosis.search.reconsider import Rival, beside
from concent_warp.diagnosis.search.record import SearchRecord


def try_alternatives(additions: Additions, fitted: list[FittedModel]) -> list[FittedModel]:
    """Return the fitted models of the search from another first effect, where that leads to a more plausible answer.

    Answers count that explain as much as the best, or leave no more than noise or errors in formulas: what one explains
    beyond that is weighed by its parameters, sizes and rarity. An answer that the data cannot distinguish from the
    best, and that differs by one effect, adds that to the group of the one in whose place it stands. Nothing is tried
    where all answers so far are far off, see `SearchContext.is_far_off`.

    Args:
        additions: The search; its record is that of the returned models afterwards.
        fitted: The model as given and after each addition, at least one.
    """
    context, first = additions.context, fitted[0]
    cfg, budget, begun = context.cfg, context.budget, context.record
    cut, doubted, unsettled = set(budget.cut), set(budget.doubted), list(budget.unsettled)
    answers = [(fitted, begun)]
    equals = set(begun.groups[0])
    rivals = begun.rivals.get(0, ())
    tried = [r for r in rivals if r.finding.name in equals]
    others = [r for r in rivals if r.finding.name not in equals and r.finding.p <= cfg.significance_level]
    for count in range(_most(cfg.search)):
        ends = [found[-1] for found, _ in answers]
        enough = count >= cfg.search.alternatives and any(_reaches_noise(context, end) for end in ends)
        if not others or enough or all(context.is_far_off(end, first) for end in ends):
            break
        rival = others.pop(0)
        context.record = begun.copy()
        context.progress(f"trying {rival.finding.name} as the first effect")
        open_question = f"Open: whether {rival.finding.name} with another effect explains more."
        found = budget.attempt(lambda r=rival: _from(additions, first, r), None, open_question)
        tried.append(rival)
        others = [r for r in others if not any(r.is_like(t, cfg.search.parallel_rivals) for t in tried)]
        if found is not None and (budget.cut, budget.doubted) == (cut, doubted):
            answers.append((found, context.record))
            continue
        # The first answer is none the less complete.
        budget.cut, budget.doubted, budget.unsettled = set(cut), set(doubted), list(unsettled)
        budget.note(open_question)
        unsettled = list(budget.unsettled)
    least = min(answers, key=lambda answer: answer[0][-1].errors.sum())[0][-1]
    equal = [
        (found, recorded)
        for found, recorded in answers
        if not leaves_more(found[-1].errors, least.errors, cfg.search)
        or found[-1].ratio <= cfg.search.explained_ratio
        or context.is_form_error(found[-1], first, recorded, near_noise=True)
    ]
    equal.sort(key=lambda answer: -plausibility(answer[0][-1]))
    best, context.record = equal[0]
    formulas = context.is_form_error(best[-1], first, near_noise=True)
    for other, of_other in equal[1:]:
        errors = formulas and context.is_form_error(other[-1], first, of_other, near_noise=True)
        if log_odds(other[-1], best[-1], first if errors else None, cfg) > -2 * np.log(cfg.search.max_odds):
            _add_to_group(context.record, of_other, other[-1])
    return best


def _most(cfg: SearchCfg) -> int:
    """Return how many rivals are tried at most."""
    return max(cfg.alternatives, cfg.alternatives_beyond_noise) if cfg.alternatives else 0


def _reaches_noise(context: SearchContext, one: FittedModel) -> bool:
    """Return whether a fitted model leaves little more than noise: no other effects could explain more then."""
    return is_near_noise(one, context.noise_factors, context.cfg)


def log_odds(other: FittedModel, best: FittedModel, first: FittedModel | None, cfg: DiagnoseCfg) -> float:
    """Return twice the log posterior odds of another answer against the best one.

    Where both leave no more than errors in their formulas, how much either leaves is little evidence: errors of
    formulas are systematic, the same in all blocks of time, and of unknown size. With a scale-invariant prior of that
    size the odds are then those of what is left, and not that to the power of the number of blocks.

    Args:
        other: Last fitted model of the other answer.
        best: That of the best one.
        first: The model as given where both leave no more than errors in their formulas, else None.
        cfg: Settings.
    """
    odds = plausibility(other) - plausibility(best)
    if first is None:
        return odds
    by_blocks = best.blocks.count * float(np.log(best.errors.sum() / max(other.errors.sum(), 1e-12)))
    # What counts as noise still may be left by either.
    less, more = (max(discrepancies(one, first)[0], cfg.min_gain) for one in (best, other))
    return odds - by_blocks + max(by_blocks, 2 * float(np.log(less / more)))


def _add_to_group(record: SearchRecord, other: SearchRecord, last: FittedModel) -> None:
    """Add the effect by which another answer differs from that of a record to the group of the one that it replaces.

    Args:
        record: What was recorded of the answer.
        other: The same of the other one.
        last: Last model of the other one.
    """
    steps, names = ({f.name: f.step for f in one.findings if f.accepted} for one in (record, other))
    ours, theirs = sorted(steps.keys() - names.keys()), sorted(names.keys() - steps.keys())
    if len(ours) == len(theirs) == 1 and theirs[0] not in record.groups[steps[ours[0]]]:
        step = steps[ours[0]]
        record.equals[step] = {**record.equals.get(step, {}), theirs[0]: last.model}
        record.add_equals(step)


def _from(additions: Additions, first: FittedModel, rival: Rival) -> list[FittedModel]:
    """Return the fitted models of the search that begins with a rival of the first effect."""
    before, instead = additions.context.record, replace(rival.finding, accepted=True, reason="")
    others = [
        replace(f, accepted=False, reason="another one explains more beside the others") if f.accepted else f
        for f in before.findings
        if f.step == 0 and f.name != instead.name
    ]
    begun = beside(first, rival)
    additions.context.record = SearchRecord(
        findings=[instead, *others],
        groups=[(instead.name,)],
        hypotheses=[{instead.name: begun.model}],
        widening={0: np.ones(len(instead.parameters))},
        rivals={0: before.rivals[0]},
        time_step=before.time_step if _is_of(first, before) else None,
        holding=before.holding[: before.held_first],
        held_first=before.held_first,
    )
    return additions.add_effects([first, begun], ())[0]


def _is_of(one: FittedModel, record: SearchRecord) -> bool:
    """Return whether a fitted model has the shorter time step of a record."""
    return record.time_step is not None and one.timestep == record.time_step.used


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
