"""Effects that errors of impacts may stand behind.

No law of contact is exact outside a simulator. What it leaves looks like an effect that moves or turns a body in its
impacts, or like one that acts in flight and thereby changes when and how fast a body meets something. An effect that is
missing is still seen where errors of impacts count as noise: in the flights between them, or as a change of all impacts
that is larger.
"""

from __future__ import annotations

from collections.abc import Mapping

from concent_warp.diagnosis.candidates.baseline import refit_without_effect
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.candidates.evidence import leaves_more
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.search.adequacy import least_ratio


def stand(
    rough: FittedModel, refitted: FittedModel, count: int, noise_factors: Mapping[str, float], cfg: DiagnoseCfg
) -> list[bool]:
    """Return which of the effects that were added to a model explain more than errors of impacts do, in their order.

    Args:
        rough: The model as given where such errors count as noise.
        refitted: The same with the effects.
        count: How many were added.
        noise_factors: By how much the noise of each channel may be larger than its estimate, 1 where it is stated [-].
        cfg: Settings.
    """
    found, owned = [], len(refitted.model.effects) - count
    for k in range(count):
        plain = count == 1 and len(refitted.model.effects) == len(rough.model.effects) + 1
        without = rough if plain else refit_without_effect(refitted, owned + k)
        least = least_ratio(without, noise_factors)
        fall = float(without.errors.sum() - refitted.errors.sum())
        gain = fall / max(float(without.errors.sum()), 1e-12)
        enough = gain >= cfg.min_gain
        if least <= cfg.search.explained_ratio:
            evidence = 0.5 * fall * (least / max(without.ratio, 1e-12)) ** 2
            enough = gain >= cfg.quiet_min_gain or evidence >= cfg.min_impact_evidence
        found.append(bool(enough and leaves_more(without.errors, refitted.errors, cfg.search)))
    return found
