"""Spans of time in which a model fails worst: where its error is largest over the measurement noise, in words.

The error of a channel over its noise is smoothed; a span lies about a peak of it, where it stays above half the peak
and above `WorstSpanCfg.min_ratio`. Overlapping spans of several channels of one body are one span. What the body
touches in it is read from the contacts of the model's replay.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from concent_warp.checks import Count, Share
from concent_warp.comparison.contact_names import ContactPartners
from concent_warp.comparison.phases import Phase
from concent_warp.comparison.residuals import Residual
from concent_warp.comparison.units import channel_text, ratio_text, unit_text, value_text
from concent_warp.estimation.noise_ratio import noise_ratio
from concent_warp.events.filter import true_runs

AXES = "xyz"


@dataclass(frozen=True)
class WorstSpanCfg:
    """Settings of the search for spans of large error.

    Example:
        >>> import concent_warp as cw
        >>> cw.CompareCfg().worst_spans.min_ratio
        3.0
    """

    smoothing: float = 0.05
    """Length of the windows over which errors are averaged [s]."""
    min_samples: Count = 3
    """Samples of a window and of a span, at least."""
    min_ratio: float = 3.0
    """Smoothed error over noise above which there is a span [-]."""
    valley_slack: float = 0.5
    """Rise of the error over noise that does not yet end the shoulder of a peak [-]."""
    max_similar: int = 3
    """Most spans of one channel in one demonstration, and most similar spans of all demonstrations."""
    max_spans: int = 20
    """Most spans of all demonstrations."""
    max_shown: int = 5
    """Most spans shown with a comparison in a notebook."""
    assumed_noise: float = 0.01
    """Noise of a channel whose noise is not known, as a share of the extent of its readings [-]."""
    axis_share: Share = 0.85
    """Share of a direction above which it is named by one axis alone [-]."""
    steady_share: Share = 0.5
    """Mean residual over its root mean square above which it points in one direction [-]."""


@dataclass(frozen=True)
class WorstSpan:
    """A span of time in which a channel of one body, or several of them, is far off."""

    demonstration: str
    channels: tuple[str, ...]
    """The worst first; `error`, `ratio`, `direction` and `vector` are its."""
    body: str | None
    phase: str | None
    """Phase that most of the error falls in, where phases are known."""
    start: float
    """[s]"""
    end: float
    """[s]"""
    peak: float
    """Time of the largest error [s]."""
    onset: float
    """Since when the error has been above `WorstSpanCfg.min_ratio` times the noise without a break [s]."""
    error: float
    """RMS error over the span, in `unit`; infinite where the model has diverged."""
    unit: str
    ratio: float | None
    """The same over the noise floor [-]; None where the noise is not known."""
    against: tuple[str, ...]
    """What the body touches there in the replay, as far as it has a name; the objects first."""
    point: tuple[float, float, float] | None
    """Mean contact point with the first of these [m], in the frame of `body`."""
    direction: str
    """Where the measurement lies as seen from the model, in words."""
    vector: tuple[float, ...]
    """The same as a unit vector; shorter where the residual points to and fro."""
    arose: str | None = None
    """Phase in which most of the error at the peak has come about; open loop, what is off once stays off."""
    recurs: int = 1
    """Number of demonstrations with a span of the same channel and phase against the same thing."""

    @property
    def size(self) -> str:
        """How far off, in words."""
        if not np.isfinite(self.error):
            return "diverged"
        size = f"{value_text(self.error, self.unit)} {unit_text(self.unit)}".strip()
        return size if self.ratio is None else f"{ratio_text(self.ratio)} noise ({size})"

    def sentence(self, *, demonstration: bool = False) -> str:
        """Return the span in words, such as "block position, insert phase, 3.1-3.6 s, 8 x noise (3.4 mm), ..."."""
        name = channel_text(self.channels[0])
        if len(self.channels) > 1:
            also = (channel_text(c).removeprefix(f"{channel_text(self.body or '')} ") for c in self.channels[1:])
            name += f" (and {', '.join(also)})"
        parts = [f"{self.demonstration}: {name}" if demonstration else name]
        parts += [f"{self.phase} phase"] if self.phase else []
        parts += [f"{self.start:.2f}-{self.end:.2f} s", self.size]
        parts += [f"against {' and '.join(self.against)}"] if self.against else []
        parts += [self.direction] if self.direction else []
        since = f"off since {self.onset:.2f} s" if self.start - self.onset > WorstSpanCfg.smoothing else ""
        if self.arose != self.phase and self.arose:
            since = f"{since}, mostly from the {self.arose} phase".removeprefix(", ")
        return ", ".join([*parts, *([since] if since else [])])


def find_worst_spans(
    residuals: Sequence[Residual],
    phases: Mapping[str | None, Sequence[Phase]],
    partners: ContactPartners | None,
    demonstration: str,
    cfg: WorstSpanCfg,
) -> list[WorstSpan]:
    """Return the spans of one demonstration, the worst first.

    Args:
        residuals: Of one model.
        phases: Of each body that has phases of its own, and under None of the demonstration; may be empty.
        partners: Who touches whom in the model's replay, where it is known.
        demonstration: Its name.
        cfg: Settings.
    """
    found = [
        span
        for residual in residuals
        for span in _channel_spans(residual, phases.get(residual.body, phases[None]), partners, demonstration, cfg)
    ]
    return _merged(sorted(found, key=_severity, reverse=True))


def rank_worst_spans(spans: Sequence[WorstSpan], cfg: WorstSpanCfg) -> tuple[WorstSpan, ...]:
    """Return the worst of the spans of all demonstrations, the worst first, each with how often it recurs.

    Of spans that are alike in many demonstrations the worst few are kept, so that there is room for others.
    """
    seen: dict[tuple, set[str]] = {}
    for span in spans:
        seen.setdefault(span_kind(span), set()).add(span.demonstration)
    kept: list[WorstSpan] = []
    count: dict[tuple, int] = {}
    for span in sorted(spans, key=_severity, reverse=True):
        count[span_kind(span)] = count.get(span_kind(span), 0) + 1
        if count[span_kind(span)] <= cfg.max_similar and len(kept) < cfg.max_spans:
            kept.append(replace(span, recurs=len(seen[span_kind(span)])))
    return tuple(kept)


def span_kind(span: WorstSpan) -> tuple:
    """Return what two spans that are the same in different demonstrations have in common."""
    return span.channels[0], span.phase, span.against[:1]


def _severity(span: WorstSpan) -> tuple[float, float]:
    """Return a key that is larger for worse spans; known noise counts before unknown."""
    return (np.inf if not np.isfinite(span.error) else -1.0 if span.ratio is None else span.ratio), span.error


def _channel_spans(
    residual: Residual, phases: Sequence[Phase], partners: ContactPartners | None, demonstration: str, cfg: WorstSpanCfg
) -> Iterator[WorstSpan]:
    """Yield the spans of one channel."""
    floor = residual.noise or cfg.assumed_noise * residual.extent
    if not floor or not len(residual.time):
        return
    if (lost := np.isinf(residual.error)).any():
        first, last = float(residual.time[lost.argmax()]), float(residual.time[-1])
        rows = np.flatnonzero(lost)
        yield _described(residual, rows, first, first, phases, partners, demonstration, cfg, last)
    level = _smoothed(residual.time, np.where(lost, np.nan, residual.weighted) / floor, cfg)
    above = level >= cfg.min_ratio
    taken = np.zeros(len(level), dtype=bool)
    for _ in range(cfg.max_similar):
        left = np.where(taken | ~above, -np.inf, level)
        if not np.isfinite(peak := left.max()):
            return
        top = int(left.argmax())
        start, end = _run_at(above & ~taken & (level >= peak / 2), top)
        onset = _run_at(above, top)[0]
        taken[slice(*_downhill(level, start, end, cfg.valley_slack))] = True
        if end - start < cfg.min_samples:
            continue
        rows, (at, since) = np.arange(start, end), residual.time[[top, onset]].tolist()
        span = _described(residual, rows, at, since, phases, partners, demonstration, cfg)
        growth = np.diff(np.maximum.accumulate(level[onset : top + 1]), prepend=0.0)
        yield replace(span, arose=_main_phase(residual.time[onset : top + 1], growth, phases))


def _smoothed(time: np.ndarray, ratio: np.ndarray, cfg: WorstSpanCfg) -> np.ndarray:
    """Return the root mean square of `ratio` (T,) over centred windows; 0 where nothing was measured.

    Args:
        time: Times [s], shape (T,).
        ratio: Error over noise [-], NaN where nothing was measured.
        cfg: Settings.
    """
    period = float(np.median(np.diff(time))) if len(time) > 1 else cfg.smoothing
    width = min(max(cfg.min_samples, round(cfg.smoothing / period)), len(time))
    valid = np.isfinite(ratio)
    kernel = np.ones(width)
    square = np.convolve(np.where(valid, ratio, 0) ** 2, kernel, mode="same")
    count = np.convolve(valid, kernel, mode="same")
    return np.sqrt(square / np.maximum(count, 1))[: len(time)]


def _run_at(mask: np.ndarray, row: int) -> tuple[int, int]:
    """Return first and one-past-last row of the run of True in `mask` (T,) that holds `row`."""
    spans = true_runs(mask)
    start, end = spans[(spans[:, 0] <= row) & (row < spans[:, 1])][0]
    return int(start), int(end)


def _downhill(level: np.ndarray, start: int, end: int, slack: float) -> tuple[int, int]:
    """Return a span of `level` (T,) widened to where it stops falling: its shoulders are no further spans."""
    least = level[start]
    while start > 0 and level[start - 1] < 1.1 * least + slack:
        start -= 1
        least = min(least, level[start])
    least = level[end - 1]
    while end < len(level) and level[end] < 1.1 * least + slack:
        least = min(least, level[end])
        end += 1
    return start, end


def _described(
    residual: Residual,
    rows: np.ndarray,
    peak: float,
    onset: float,
    phases: Sequence[Phase],
    partners: ContactPartners | None,
    demonstration: str,
    cfg: WorstSpanCfg,
    end: float | None = None,
) -> WorstSpan:
    """Return the span at some rows of a residual."""
    start, end = float(residual.time[rows[0]]), float(residual.time[rows[-1]]) if end is None else end
    error = residual.error[rows]
    rms = float(np.sqrt(np.nanmean(error**2)))
    text, vector = _direction(residual, rows, cfg)
    touching = None if partners is None or residual.body is None else partners.of(residual.body, start, end)
    return WorstSpan(
        demonstration=demonstration,
        channels=(residual.channel,),
        body=residual.body,
        phase=_main_phase(residual.time[rows], np.nan_to_num(error, posinf=1.0), phases),
        start=start,
        end=end,
        peak=peak,
        onset=onset,
        error=rms,
        unit=residual.unit,
        ratio=noise_ratio(residual.weighted[rows], residual.noise) if residual.noise else None,
        against=touching.names if touching else (),
        point=touching.point if touching else None,
        direction=text if np.isfinite(rms) else "",
        vector=vector if np.isfinite(rms) else (),
    )


def _main_phase(time: np.ndarray, error: np.ndarray, phases: Sequence[Phase]) -> str | None:
    """Return the name of the phase in which errors (n,) at `time` (n,) weigh most."""
    weight: dict[str, float] = {}
    for phase in phases:
        within = (time >= phase.start) & (time < phase.end)
        weight[phase.name] = weight.get(phase.name, 0.0) + float(error[within].sum())
    return max(weight, key=lambda name: weight[name]) if weight else None


def whole_rows(value: np.ndarray) -> np.ndarray:
    """Return the rows (T, dim) of which anything is known, the mean of a component in place of what is missing in it.

    A component that is missing throughout is 0.
    """
    known = np.isfinite(value)
    rows = value[np.asarray(known.any(axis=1))]
    missing = ~np.isfinite(rows)
    if missing.any():
        mean = [column[here].mean() if here.any() else 0.0 for column, here in zip(value.T, known.T, strict=True)]
        rows = np.where(missing, mean, rows)
    return rows


def _direction(residual: Residual, rows: np.ndarray, cfg: WorstSpanCfg) -> tuple[str, tuple[float, ...]]:
    """Return where the measurement lies as seen from the model, in words and as a vector of length 0 to 1."""
    value = residual.value[rows]
    value = whole_rows(value)
    if not len(value) or not (size := float(np.sqrt((value**2).sum(axis=1).mean()))):
        return "", ()
    mean = value.mean(axis=0) / size
    vector = tuple(float(v) for v in mean)
    steady = float(np.linalg.norm(mean)) >= cfg.steady_share
    if len(mean) == 1:
        side = "more" if mean[0] > 0 else "less"
        return f"measured value {side} than the model's" if steady else "to and fro", vector
    if len(mean) != 3:
        return "", vector
    extent = mean if steady else np.sqrt((value**2).mean(axis=0))
    axes = _named_axes(extent, cfg.axis_share, signed=steady)
    turning = residual.unit.startswith("rad") or residual.unit == "N m"
    along = f"{'about' if turning else 'along'} {'its own ' if residual.local else ''}{axes}"
    return along if steady else f"to and fro {along}", vector


def _named_axes(vector: np.ndarray, share: float, *, signed: bool) -> str:
    """Return the one or two axes along which a vector (3,) mostly points."""
    order = np.argsort(-np.abs(vector))
    count = 1 if abs(vector[order[0]]) >= share * np.linalg.norm(vector) else 2
    names = [f"{('-' if vector[k] < 0 else '+') if signed else ''}{AXES[k]}" for k in order[:count]]
    return " and ".join(names)


def _merged(spans: Sequence[WorstSpan]) -> list[WorstSpan]:
    """Return `spans`, the worst first, with those of one body that overlap by half of the shorter made one."""
    kept: list[WorstSpan] = []
    for span in spans:
        for i, other in enumerate(kept):
            shared = min(span.end, other.end) - max(span.start, other.start)
            half = 0.5 * min(span.end - span.start, other.end - other.start)
            if span.body is not None and span.body == other.body and shared >= half:
                if span.channels[0] not in other.channels:
                    kept[i] = replace(other, channels=(*other.channels, *span.channels))
                break
        else:
            kept.append(span)
    return kept
