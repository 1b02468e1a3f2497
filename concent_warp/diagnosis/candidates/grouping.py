"""The accepted effects of one addition that the data cannot distinguish."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from concent_warp.diagnosis.candidates.candidate import FittedCandidate, FittedModel
from concent_warp.diagnosis.candidates.evidence import equal_at_noise, indistinguishable
from concent_warp.diagnosis.candidates.fit_candidate import polish_candidate
from concent_warp.diagnosis.candidates.profile_likelihood import refine_by_profile
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.result import Finding
from concent_warp.diagnosis.tasks import TaskRunner
from concent_warp.diagnosis.time_budget import TimeBudget

Pair = tuple[FittedCandidate, Finding]
"""A candidate and its evidence."""


def group_indistinguishable(
    base: FittedModel,
    accepted: Sequence[Pair],
    assess: Callable[[FittedCandidate], Finding],
    runner: TaskRunner,
    cfg: DiagnoseCfg,
    budget: TimeBudget | None = None,
    compare: Callable[[FittedModel | FittedCandidate], np.ndarray] | None = None,
) -> list[Pair]:
    """Return the accepted candidates that cannot be distinguished from the best, the most plausible first.

    The first one is polished. Where more candidates are nearly equal, the profile likelihoods of their parameters are
    evaluated, which lowers their costs and measures their roughness; over many windows the latter shows in the
    differences of their errors anyway. What the intervals alone need a profile for comes after the search.

    Args:
        base: The fitted baseline.
        accepted: Candidates with their evidence.
        assess: Returns the evidence of a candidate.
        runner: Runs the evaluations.
        cfg: Settings.
        budget: What has no time is left out and noted there.
        compare: Returns the held-out errors of blocks, shape (B,), by which candidates and baseline are compared; by
            default their own.
    """
    search, budget = cfg.search, budget or TimeBudget(None)

    def profiled(c: FittedCandidate) -> FittedCandidate:
        unsettled = f"Left out of the comparison: the profile likelihood of {c.effect.name}."
        return budget.attempt(lambda: refine_by_profile(base, c, runner, cfg.profile), c, unsettled)

    def with_evidence(c: FittedCandidate) -> Pair:
        # An accepted effect stays accepted: its gain is the evidence, even where a rough cost widens its interval.
        return c, replace(assess(c), accepted=True, reason="")

    def alike(pairs: Sequence[Pair], slack: float = 1.0) -> list[Pair]:
        if compare is None:
            return indistinguishable(base, pairs, search, slack)
        beside, pairs = replace(base, errors=compare(base)), list(pairs)
        weighed = [_weighed(beside, c, f, compare(c)) for c, f in pairs]
        places = {id(c): k for k, (c, _) in enumerate(weighed)}
        group = equal_at_noise(beside, indistinguishable(beside, weighed, search, slack), weighed, search)
        return [pairs[places[id(c)]] for c, _ in group]

    near = alike(accepted, search.near_equal_factor)
    if len(near) > len(alike(accepted)) and len(base.windows) <= base.cfg.least_squares.max_polished_windows:
        first, rest = near[: search.profiled], near[search.profiled :]
        near = [with_evidence(profiled(c)) for c, _ in first] + rest
    group = alike(near)
    best = group[0][0]
    unsettled = f"Fit not refined: {best.effect.name}."
    best = budget.attempt(lambda: polish_candidate(base, best, search, thorough=True), best, unsettled)
    group[0] = with_evidence(best)
    return group


def _weighed(beside: FittedModel, c: FittedCandidate, f: Finding, errors: np.ndarray) -> Pair:
    """Return a candidate and its evidence with other held-out errors of blocks, shape (B,)."""
    count = sum(len(piece.residual) for piece in c.pieces)
    c = replace(c, errors=errors, ratio=beside.noise_scale * float(np.sqrt(errors.sum() / count)))
    return c, replace(f, gain=c.share(beside))
