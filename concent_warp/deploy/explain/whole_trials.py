"""Effects that explain a short free motion alike, distinguished by the whole trials, their contacts included."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.stats import wilcoxon

from concent_warp.deploy.explain.cfg import JudgeCfg
from concent_warp.diagnosis.result import Finding

MOST_RIVALS = 3
"""Rivals that trials are replayed with, those of the largest gains."""


def better_in_whole_trials(
    effects: Sequence[Finding], explained: Callable[[Finding], np.ndarray], cfg: JudgeCfg
) -> tuple[Finding, str] | None:
    """Return the effect that whole trials prefer to the one that was named, and a sentence; None where there is none.

    Rivals are effects whose held-out gain lies in the interval of the named one's or above. One is preferred where it
    explains more of the trials' difference, by `JudgeCfg.least_gain` of it in the median trial, by a signed-rank test;
    of several, that of the largest gain, unless another explains as much more.

    Args:
        effects: Findings of a diagnosis.
        explained: Returns the share of the difference of each trial that an effect explains as fitted, shape (T,).
        cfg: Settings.
    """
    named = next((f for f in effects if f.accepted), None)
    if named is None:
        return None
    rivals = [f for f in effects if not f.accepted and f.step == named.step and f.parameters and f.gain >= named.low]
    mine, best = explained(named), None
    for rival in sorted(rivals, key=lambda f: -f.gain)[:MOST_RIVALS]:
        more = explained(rival) - mine
        share = float(np.median(mine + more))
        if np.median(more) < cfg.least_gain:
            continue
        test: Any = wilcoxon(more, alternative="greater")
        if test.pvalue > cfg.significance:
            continue
        if best is None or share > best[0] + cfg.least_gain:
            best = share, rival
    if best is None:
        return None
    share, rival = best
    sentence = (
        f"{named.name} explains what it was searched for in as well, but only {np.median(mine):.0%} of the difference "
        f"of whole trials, where {rival.name} explains {share:.0%}."
    )
    return rival, sentence
