"""What ordinary errors of nominal values alone do to a replay: the measure for what a model leaves.

Over seconds without feedback from the measurements, masses, lengths and gains that are off by a per cent move a replay
by many times the noise of good encoders. A model that leaves as much need not lack an effect. How much it is follows
from a few replays of models whose nominal values are all drawn from their tolerances at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import numpy as np

from concent_warp.checks import Bounds, Count, Factor
from concent_warp.comparison.residuals import Residual, ResidualCfg, residuals
from concent_warp.comparison.units import channel_text, ratio_text
from concent_warp.effects.effect import AddedEffect
from concent_warp.effects.library.nominal import CLOCK_TOLERANCE, FRICTION_TOLERANCE, PRIOR_SCALES, TOLERANCE
from concent_warp.estimation.noise import Noise
from concent_warp.estimation.noise_ratio import noise_ratio
from concent_warp.fit.effects.nominal import possible_nominal_effects
from concent_warp.simulate.replay import replay, step_count
from concent_warp.simulate.select import EngineName, make_engine

if TYPE_CHECKING:
    from concent_warp.model import Model
    from concent_warp.recording.recording import Demonstration


@dataclass(frozen=True)
class ToleranceCfg:
    """How it is found out what ordinary errors of nominal values do to a replay."""

    draws: Annotated[int, Bounds(0, 1000)] = 8
    """Models whose nominal values are drawn from their tolerances [-]; 0 for none."""
    min_ratio: Factor = 1.5
    """RMS error over the noise in a channel of a demonstration from which on this is asked [-]."""
    max_steps: Count = 1_000_000
    """Most simulation steps for all draws together; with more, there are fewer draws. Some seconds of computation."""


@dataclass(frozen=True)
class ToleranceRange:
    """What ordinary errors of nominal values alone do to one channel."""

    low: float
    """RMS error over the noise that the mildest draw gives, noise included [-]."""
    high: float
    """The same of the worst draw; infinite where a replay diverges."""

    @property
    def text(self) -> str:
        """The range in words, such as ``1.2 to 8.0 x``."""
        low, high = ratio_text(self.low), ratio_text(self.high)
        return high if low == high else f"{low.removesuffix(' x')} to {high}"


def tolerance_ranges(
    model: Model,
    demonstrations: Sequence[Demonstration],
    found: Mapping[str, Sequence[Residual]],
    noise: Mapping[str, Noise],
    engine: EngineName = "mujoco",
    cfg: ToleranceCfg | None = None,
    residual_cfg: ResidualCfg | None = None,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> dict[str, ToleranceRange]:
    """Return what ordinary errors of a model's nominal values alone would leave, by channel.

    The replays begin where those of the model do. Empty where the model leaves little, has no nominal values or takes
    too many steps.

    Args:
        model: The model, as it is taken for true.
        demonstrations: Demonstrations with initial states.
        found: Its residuals, by demonstration.
        noise: Noise by channel, see `instrument_noise`.
        engine: Which engine simulates.
        cfg: Settings.
        residual_cfg: Settings of the residuals.
        seed: Seed of the draws.
        progress: Called with the share done, 0..1, after each draw.
    """
    cfg = cfg or ToleranceCfg()
    steps = sum(step_count(d, model.scene.model.opt.timestep) for d in demonstrations)
    draws = min(cfg.draws, cfg.max_steps // max(steps, 1))
    kinds = possible_nominal_effects(model)
    if draws < 2 or not kinds or _largest_ratio(found) < cfg.min_ratio:
        return {}
    rng, plain = np.random.default_rng(seed), model.compile()
    bounds = [np.array([[p.low, p.null, p.high, p.scale] for p in kind.parameters(plain)]).T for kind in kinds]
    ratios: dict[str, list[float]] = {}
    for k in range(draws):
        drawn = (
            AddedEffect(kind, tuple(np.clip(rng.normal(null, PRIOR_SCALES * scale), low, high).tolist()))
            for kind, (low, null, high, scale) in zip(kinds, bounds, strict=True)
        )
        other = replace(model, effects=(*model.effects, *drawn))
        for channel, ratio in _changes(other, demonstrations, found, noise, engine, residual_cfg).items():
            ratios.setdefault(channel, []).append(float(np.hypot(1.0, ratio)))
        if progress is not None:
            progress((k + 1) / draws)
    return {channel: ToleranceRange(min(of), max(of)) for channel, of in ratios.items()}


def tolerance_sentences(ranges: Mapping[str, ToleranceRange], left: Mapping[str, float], most: int = 3) -> list[str]:
    """Return what ordinary errors of nominal values would leave, and whether a model leaves more, in words.

    Args:
        ranges: What such errors leave, by channel.
        left: RMS error over the noise of the model, by channel.
        most: Most channels to name in a sentence, those first in which the model leaves most.
    """
    named = sorted((c for c in ranges if c in left), key=lambda c: -left[c])
    if not named:
        return []
    shown = ", ".join(f"{channel_text(c)} {ranges[c].text} noise" for c in named[:most])
    sentences = [
        f"Nominal values within ordinary tolerances ({100 * TOLERANCE:g} %, friction and damping of joints "
        f"{100 * FRICTION_TOLERANCE:g} %, latencies {1e3 * CLOCK_TOLERANCE:g} ms) would alone leave: {shown}."
    ]
    beyond = [f"{channel_text(c)} ({ratio_text(left[c])})" for c in named if left[c] > ranges[c].high]
    if beyond:
        others = f" and {len(beyond) - most} more" if len(beyond) > most else ""
        sentences.append(f"The model leaves more than that in {', '.join(beyond[:most])}{others}.")
    else:
        sentences.append("What the model leaves may be no more than that.")
    return sentences


def _largest_ratio(found: Mapping[str, Sequence[Residual]]) -> float:
    """Return the largest RMS error over the noise of a channel in a demonstration, 0 where no noise is known."""
    known = [noise_ratio(r.weighted, r.noise) for of in found.values() for r in of if r.noise]
    return max((ratio for ratio in known if not np.isnan(ratio)), default=0.0)


def _changes(
    other: Model,
    demonstrations: Sequence[Demonstration],
    found: Mapping[str, Sequence[Residual]],
    noise: Mapping[str, Noise],
    engine: EngineName,
    residual_cfg: ResidualCfg | None,
) -> dict[str, float]:
    """Return by how much another model's predictions differ from those of found residuals, RMS over the noise.

    By channel with known noise; infinite where a replay diverges. Of tracked points it is how far their mean moves.
    """
    simulator, compiled = make_engine(engine, other), other.compile()
    changes: dict[str, list[np.ndarray]] = {}
    for d in demonstrations:
        rollout = replay(other, d, simulator).numpy()
        changed = residuals(compiled, rollout, d, noise, other.effects, residual_cfg)
        for before, after in zip(found[d.name], changed, strict=True):
            there = np.isfinite(before.error)
            if before.noise and there.any():
                away = np.linalg.norm(np.nan_to_num(after.value - before.value), axis=1)
                away *= 1.0 if before.weight is None else before.weight
                away[np.isinf(after.error)] = np.inf
                changes.setdefault(before.channel, []).append(away[there] / before.noise)
    return {channel: noise_ratio(np.concatenate(of)) for channel, of in changes.items()}
