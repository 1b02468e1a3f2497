"""Effects that errors of impacts may stand behind.

No law of contact is exact outside a simulator. What it leaves looks like an effect that moves or turns a body in its
impacts, or like one that acts in flight and thereby changes when and how fast a body meets something. An effect that is
missing is still seen where errors of impacts count as noise: in the flights between them, or as a change of all impacts
that is larger.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Protocol

from concent_warp.diagnosis.candidates.baseline import refit_without_effect
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.candidates.evidence import leaves_more
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.search.adequacy import least_ratio
from concent_warp.diagnosis.search.context import SearchContext
from concent_warp.diagnosis.search.time_step import without_defects
from concent_warp.fit.effects.impacts import flying_bodies
from concent_warp.fit.effects.observation import Window
from concent_warp.fit.effects.scatter import with_scatter
from concent_warp.model import Model


class Refit(Protocol):
    """Fits a model's own parameters and the initial states to some windows, for a time step [s] or the given one's."""

    def __call__(self, model: Model, windows: Sequence[Window], timestep: float | None = None, /) -> FittedModel:
        """Return the fitted model."""
        ...


def said_of_impacts(error: float) -> tuple[str]:
    """Return a sentence on what an answer leaves of impacts.

    Args:
        error: Error of a law of contact over the change of velocity in each impact [-].
    """
    return (
        f"What follows impacts is explained only within an error of {100 * error:g} % of the change of velocity in "
        "each, which laws of contact leave open: `compare` shows it.",
    )


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


def with_errors_of_impacts(
    context: SearchContext, given: FittedModel, fitted: Sequence[FittedModel], refit: Refit
) -> FittedModel | None:
    """Return the model as given where errors of impacts count as noise; None where there are no impacts.

    It is None, too, where the model is far off, with what was found as well, if anything, and beside such errors.

    Args:
        context: What the parts of the search share.
        given: The model as given.
        fitted: The same and after each addition.
        refit: See `Refit`.
    """
    cfg = context.cfg
    observation = replace(cfg.fits.observation, impact_error=cfg.search.impact_error)
    flies = bool(flying_bodies(given.model.compile()))
    if not (observation.impact_error and flies) or len(fitted[-1].windows) != len(given.windows):
        return None
    followed = _followed(context, given, fitted[-1], refit)
    if given.noise_ratio > cfg.search.far_ratio and all(one is given for one in followed):
        return None
    found = []
    for one in followed:
        begun = [offset * w.spread for offset, w in zip(one.fit.offsets, given.windows, strict=True)]
        plain = without_defects(given).windows
        windows = with_scatter(one.delivered, plain, given.engine, observation, begun)
        more = [_directions(a) > _directions(b) for a, b in zip(windows, given.windows, strict=True)]
        if any(more):
            found.append(refit(given.model, windows, given.timestep))
    rough, far = min(found, key=lambda one: one.ratio, default=None), context.is_far_off
    if rough is not None and far(fitted[-1], given):
        return None if far(refit(fitted[-1].model, rough.windows), rough) else rough
    return rough


def _followed(context: SearchContext, given: FittedModel, last: FittedModel, refit: Refit) -> list[FittedModel]:
    """Return the models whose impacts may be those that were measured.

    One has the effects that were added; the other one not those of objects, which may stand for errors of impacts.

    Args:
        context: What the parts of the search share.
        given: The model as given.
        last: The same with all additions.
        refit: See `Refit`.
    """
    accepted, effects = context.record.accepted(), list(last.model.effects)
    owned = len(effects) - len(accepted)
    kept = [added for k, added in enumerate(effects[owned:]) if accepted[k].family != "objects"]
    if not kept or len(kept) == len(accepted):
        return [given, last] if accepted and not kept else [last if accepted else given]
    return [refit(replace(last.model, effects=(*effects[:owned], *kept)), given.windows), last]


def _directions(window: Window) -> int:
    """Return in how many directions predictions of a window scatter."""
    return 0 if window.scatter is None else window.scatter.deviations.shape[1]
