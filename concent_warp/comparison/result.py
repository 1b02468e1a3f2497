"""The result of a comparison of models with measurements, and figures derived from it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from concent_warp.comparison.bootstrap import BootstrapCfg, effective_count, mean_interval
from concent_warp.comparison.html import comparison_html
from concent_warp.comparison.phases import FREE, Phase
from concent_warp.comparison.residuals import Residual
from concent_warp.comparison.tolerances import ToleranceRange, tolerance_sentences
from concent_warp.comparison.units import ratio_text, unit_text, value_text
from concent_warp.comparison.worst_spans import WorstSpan, WorstSpanCfg
from concent_warp.errors import ModelError, RecordingError
from concent_warp.estimation.noise import Source
from concent_warp.estimation.noise_ratio import noise_ratio
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.model import Model

CARRIED = (FREE, "pick")
"""Phases in which an object stands still or is carried: its motion then depends little on its contact geometry."""


@dataclass(frozen=True)
class Summary:
    """Errors of one model on one channel, over some phases and demonstrations, in `unit`."""

    model: str
    channel: str
    phase: str
    """Name of a phase, several joined by " + ", or "all"."""
    unit: str
    count: int
    """Number of samples."""
    effective: float
    """Number of independent samples that their autocorrelation leaves."""
    mean: float
    low: float
    """Lower end of the interval of the mean (see `concent_warp.comparison.bootstrap`); NaN with too few samples."""
    high: float
    """Upper end."""
    rms: float
    p95: float
    """95th percentile."""
    max: float
    noise: float | None
    """Root mean square error that the measurement noise alone leaves; None where it is not known."""
    ratio: float | None
    """Root mean square error over `noise` [-] ("x noise", see `concent_warp.estimation.noise_ratio`)."""
    source: Source
    """Where the noise is from."""


@dataclass(frozen=True)
class Difference:
    """Mean error of one model less that of another, over the same samples; negative where it has fallen."""

    before: str
    after: str
    channel: str
    phase: str
    unit: str
    mean: float
    low: float
    """Lower end of the interval of the difference."""
    high: float
    """Upper end."""
    share: float
    """Difference over the mean error before [-]."""

    @property
    def verdict(self) -> str:
        """Whether the interval excludes no change: "fallen", "risen" or "unclear"."""
        return "fallen" if self.high < 0 else "risen" if self.low > 0 else "unclear"


@dataclass(frozen=True)
class Comparison:
    """Residuals of some models on the same demonstrations. The first model is `before`, the last one `after`.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> comparison = cw.compare(cw.Model.from_recording(recording), recording)
        >>> comparison.channels
        ('hinge_position', 'marker_position')
        >>> round(comparison.summarise("model", "hinge_position").ratio)  # RMS error over noise
        7
    """

    models: Mapping[str, Model]
    """By name, the baseline first."""
    demonstrations: tuple[str, ...]
    residuals: Mapping[tuple[str, str], tuple[Residual, ...]]
    """By model and demonstration; the same channels in the same order for each model."""
    phases: Mapping[str, tuple[Phase, ...]]
    """By demonstration; empty where phases are not known."""
    diverged: Mapping[tuple[str, str], float]
    """Time [s] at which a replay stopped being finite, by model and demonstration; absent where it stayed so."""
    seed: int = 0
    """Seed of the bootstrap."""
    bootstrap: BootstrapCfg = field(default_factory=BootstrapCfg)
    """Settings of the intervals."""
    worst_spans: tuple[WorstSpan, ...] = ()
    """Spans of time in which the last model fails worst, the worst first."""
    span_cfg: WorstSpanCfg = field(default_factory=WorstSpanCfg)
    """Settings with which these were found."""
    staged: bool = True
    """Whether the phases are contact stages; else they are phases of motion."""
    events: Mapping[str, ContactEventSequence] = field(default_factory=dict)
    """Contact event sequences of the last model, by demonstration, where they were extracted."""
    tolerances: Mapping[str, ToleranceRange] = field(default_factory=dict)
    """What ordinary errors of the last model's nominal values alone would leave, by channel; empty where that was not
    asked (`ToleranceCfg`)."""
    remarks: tuple[str, ...] = ()
    """What to know about the comparison, a sentence each."""

    @property
    def before(self) -> str:
        """Name of the first model."""
        return next(iter(self.models))

    @property
    def after(self) -> str:
        """Name of the last model."""
        return list(self.models)[-1]

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Names of all channels, in the order of the recording."""
        return tuple(dict.fromkeys(r.channel for d in self.demonstrations for r in self.residuals[self.before, d]))

    @cached_property
    def object_channels(self) -> tuple[str, ...]:
        """Names of the channels that are about where bodies are: positions, orientations and points."""
        kinds = {r.channel: r.kind for d in self.demonstrations for r in self.residuals[self.before, d]}
        return tuple(c for c in self.channels if kinds[c] in ("position", "orientation", "points"))

    @cached_property
    def phase_names(self) -> tuple[str, ...]:
        """Names of all phases, in the order of time."""
        return tuple(dict.fromkeys(phase.name for d in self.demonstrations for phase in self.phases.get(d, ())))

    def contact_phases(self) -> tuple[str, ...]:
        """Return the phases in which the contact geometry shows: all but `CARRIED`, if any are left.

        None, which stands for all times, where the phases are those of motion.
        """
        if not self.staged:
            return ()
        return tuple(name for name in self.phase_names if name not in CARRIED) or self.phase_names

    def residual(self, model: str, demonstration: str, channel: str) -> Residual | None:
        """Return one residual, None where the demonstration lacks the channel."""
        return next((r for r in self.residuals[model, demonstration] if r.channel == channel), None)

    def errors(
        self, model: str, channel: str, phases: Collection[str] = (), demonstrations: Collection[str] = ()
    ) -> list[np.ndarray]:
        """Return the errors of the samples in `phases`, one array (n_d,) a demonstration; all of either where empty."""
        return [r.error[mask] for r, mask in self._samples(model, channel, phases, demonstrations)]

    def _samples(
        self, model: str, channel: str, phases: Collection[str], demonstrations: Collection[str]
    ) -> Iterator[tuple[Residual, np.ndarray]]:
        """Yield the residual of each demonstration and which of its samples (T,) were measured in `phases`."""
        for d in demonstrations or self.demonstrations:
            if (r := self.residual(model, d, channel)) is None:
                continue
            mask = ~np.isnan(r.error)
            if phases:
                within = [(r.time >= p.start) & (r.time < p.end) for p in self.phases.get(d, ()) if p.name in phases]
                mask &= np.any(within, axis=0) if within else False
            yield r, mask

    def summarise(
        self, model: str, channel: str, phases: Collection[str] = (), demonstrations: Collection[str] = ()
    ) -> Summary:
        """Return the summary of one model on one channel; over all `phases` or `demonstrations` where empty."""
        found = list(self._samples(model, channel, phases, demonstrations))
        if not found:
            raise ModelError(f"no channel {channel!r} to summarise", expected=f"one of {list(self.channels)}")
        parts = [r.error[mask] for r, mask in found]
        pooled = np.concatenate(parts)
        low, high = mean_interval(parts, self.seed, self.bootstrap)
        noises = [(r.noise, mask.sum()) for r, mask in found if r.noise is not None]
        weight = sum(n for _, n in noises)
        sources: list[Source] = [r.source for r, _ in found if r.noise is not None]
        noise = float(np.sqrt(sum(noise**2 * n for noise, n in noises) / weight)) if weight else None
        mean = _statistic(np.mean, pooled)
        return Summary(
            model=model,
            channel=channel,
            phase=" + ".join(phases) or "all",
            unit=found[0][0].unit,
            count=len(pooled),
            effective=effective_count([p for p in parts if np.isfinite(p).all()]),
            mean=mean,
            low=low,
            high=high,
            rms=_statistic(lambda e: np.sqrt(np.mean(e**2)), pooled),
            p95=_statistic(lambda e: np.percentile(e, 95), pooled),
            max=_statistic(np.max, pooled),
            noise=noise,
            ratio=noise_ratio(np.concatenate([r.weighted[mask] for r, mask in found]), noise) if noise else None,
            source=sources[0] if sources else "unknown",
        )

    def difference(
        self,
        channel: str,
        phases: Collection[str] = (),
        demonstrations: Collection[str] = (),
        *,
        before: str | None = None,
        after: str | None = None,
    ) -> Difference:
        """Return what `after` (the last model) has gained over `before` (the first), sample by sample."""
        before, after = before or self.before, after or self.after
        summary = self.summarise(after, channel, phases, demonstrations)
        first, second = (self.errors(model, channel, phases, demonstrations) for model in (before, after))
        with np.errstate(invalid="ignore"):
            parts = [b - a for a, b in zip(first, second, strict=True)]
            mean = _statistic(np.mean, np.concatenate(second)) - (base := _statistic(np.mean, np.concatenate(first)))
        finite = bool(np.isfinite(mean))
        low, high = mean_interval(parts, self.seed, self.bootstrap) if finite else (mean, mean)
        share = mean / base if finite and base else np.nan
        return Difference(before, after, channel, summary.phase, summary.unit, float(mean), low, high, float(share))

    def main_channel(self) -> str:
        """Return the channel that says most of the objects' motion.

        The position of a body, of points, or anything measured, in this order of preference; among several the one with
        the largest error before, over the contact phases. Positions and orientations that do not move come last: the
        origin of a lever stays where it is.
        """
        every = [r for d in self.demonstrations for r in self.residuals[self.before, d]]
        kinds, moving = {r.channel: r.kind for r in every}, {r.channel for r in every if r.moves}
        objects = ("position", "points", "orientation")
        choices = [(kind, moving) for kind in objects] + [(kind, kinds.keys()) for kind in (*objects, "joint", "other")]
        for kind, among in choices:
            if channels := [c for c in self.channels if kinds[c] == kind and c in among]:
                errors = [self.summarise(self.before, c, self.contact_phases()).mean for c in channels]
                return channels[int(np.argmax(np.nan_to_num(errors, nan=-1, posinf=np.finfo(float).max)))]
        raise RecordingError("nothing was measured that could be compared with a model")

    def tolerance_sentences(self) -> list[str]:
        """Return sentences on what ordinary errors of the last model's nominal values alone would leave; none where
        that was not asked.
        """
        ratios = {channel: self.summarise(self.after, channel).ratio for channel in self.tolerances}
        return tolerance_sentences(
            self.tolerances, {c: r for c, r in ratios.items() if r is not None and not np.isnan(r)}
        )

    def rows(self) -> Iterator[tuple[str, tuple[str, ...]]]:
        """Yield what a table shows: each channel over all times, then by phase."""
        for channel in self.channels:
            yield channel, ()
            if len(self.phase_names) > 1:
                for name in self.phase_names:
                    yield channel, (name,)

    def to_json(self) -> dict[str, Any]:
        """Return all figures as one JSON object, SI units; numbers that are not finite are null."""
        rows = list(self.rows())
        main = (self.main_channel(), self.contact_phases())
        document = {
            "models": list(self.models),
            "demonstrations": list(self.demonstrations),
            "phases": {d: [asdict(p) for p in self.phases.get(d, ())] for d in self.demonstrations},
            "diverged": [{"model": m, "demonstration": d, "time": t} for (m, d), t in self.diverged.items()],
            "phases_are": "contact stages" if self.staged else "phases of motion",
            "headline": {
                "channel": main[0],
                "phases": list(main[1]),
                "tolerances": {channel: asdict(found) for channel, found in self.tolerances.items()},
                "summaries": [asdict(self.summarise(m, *main)) for m in self.models],
                "difference": self._difference_json(*main),
            },
            "worst_spans": [
                {**asdict(span), "sentence": span.sentence(demonstration=True)} for span in self.worst_spans
            ],
            "tolerances": {channel: asdict(found) for channel, found in self.tolerances.items()},
            "summaries": [asdict(self.summarise(m, c, p)) for c, p in rows for m in self.models],
            "differences": [d for c, p in rows if (d := self._difference_json(c, p))],
            "interval": {"level": self.bootstrap.level, "rule": self.bootstrap.rule, "seed": self.seed},
        }
        return finite(document)

    def _repr_html_(self) -> str:
        """Return mean errors and x noise of all channels, and the worst spans, as HTML, for notebooks."""
        models = list(self.models)
        header = ["channel", "unit", *(f"mean error, {m}" for m in models), *(f"x noise, {m}" for m in models)]
        header += ["verdict"] if len(models) > 1 else []
        rows = []
        for channel in self.channels:
            found = [self.summarise(model, channel) for model in models]
            row = [channel, unit_text(found[0].unit)]
            row += [value_text(summary.mean, summary.unit) for summary in found]
            row += ["-" if summary.ratio is None else ratio_text(summary.ratio) for summary in found]
            rows.append(row + ([self.difference(channel).verdict] if len(models) > 1 else []))
        spans = self.worst_spans[: self.span_cfg.max_shown]
        notes = self.tolerance_sentences()
        return comparison_html(header, rows, notes, [span.sentence(demonstration=True) for span in spans])

    def _difference_json(self, channel: str, phases: tuple[str, ...]) -> dict[str, Any] | None:
        if len(self.models) < 2:
            return None
        found = self.difference(channel, phases)
        return {**asdict(found), "verdict": found.verdict}


def _statistic(function: Any, values: np.ndarray) -> float:
    """Return `function` of values (n,); NaN of none, infinite where one of them is."""
    if not len(values):
        return np.nan
    return float(function(values)) if np.isfinite(values).all() else np.inf


def finite(value: Any) -> Any:
    """Return nested lists and dictionaries with null in place of numbers that are not finite."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
