"""Which nominal values of a model may be off within their tolerance."""

from __future__ import annotations

from concent_warp.effects.effect import Effect
from concent_warp.effects.registry import NOMINAL
from concent_warp.model import Model


def possible_nominal_effects(model: Model) -> list[Effect]:
    """Return all nominal values of a model as effects, less those that an effect of the model is."""
    compiled, found = model.compile(), []
    for kind in NOMINAL:
        taken = {t for a in model.effects if kind.is_within(a.effect) for t in a.effect.target}
        for targets in kind.targets(compiled):
            if names := [t for t in targets if t not in taken]:
                found.append(kind(*names))
    return found
