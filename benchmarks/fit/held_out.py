"""How well a model predicts windows of recordings that it was not fitted to, for `real.py` and its like.

A window starts where the measured motion is calm. Its initial state is the measured one, corrected within the noise by
what is seen in the window's first part (the head), in the same way for every model; what is judged is the prediction
of the rest, which nothing was fitted to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from concent_warp.estimation.windows import window_starts
from concent_warp.fit.effects.least_squares import Solver
from concent_warp.fit.effects.observation import ObservedRecording, Window
from concent_warp.fit.effects.observe import channel_noises, observe
from concent_warp.fit.effects.prediction import Prediction
from concent_warp.model import Model
from concent_warp.recording.recording import Recording

RESAMPLES = 5_000


@dataclass(frozen=True)
class Spans:
    """Windows of a recording, each whole and its head alone."""

    whole: list[Window]
    head: list[Window]
    names: tuple[str, ...]
    """Demonstrations, by their number."""

    @property
    def group(self) -> np.ndarray:
        """Demonstration of each window, shape (W,)."""
        return np.array([w.number for w in self.whole])


def cut_spans(model: Model, recording: Recording, length: float | None, head: float, moving: float = 0.0) -> Spans:
    """Cut a recording into windows of `length` [s], of which the first `head` [s] tells the initial state.

    Windows in which no channel moves by more than `moving` (in the channel's unit) are left out: rest is no test.
    Without a length, each demonstration is one window.
    """
    source = ObservedRecording(model, recording, channel_noises(model, recording))
    whole: list[Window] = []
    heads: list[Window] = []
    for number, d in enumerate(recording.demonstrations):
        measured = source.measured(d)
        clock = np.unique(np.concatenate([d.measured[c].time for c in source.noise if c in d.measured]))
        if measured is None:
            raise ValueError(f"{d.name}: the state was not measured")
        starts = [0.0] if length is None else window_starts(clock, measured.scatter(clock), length, length)
        for start in starts:
            full = source.window(number, float(start), clock[-1] if length is None else float(start) + length)
            first = source.window(number, float(start), float(start) + head)
            if full is None or first is None:
                continue
            if max(float(np.ptp(r.value, axis=0).max()) for r in full.readings) > moving:
                whole.append(full)
                heads.append(first)
    return Spans(whole, heads, tuple(d.name for d in recording.demonstrations))


def prediction_errors(model: Model, spans: Spans, channels: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the root mean square error of each window beyond its head, by channel, each of shape (W,), in SI units."""
    solver = Solver(Prediction(model, (), spans.head, threads=1))
    values = solver.p.start
    offsets, _ = solver.fit_initial_states(values, [np.zeros(len(w.spread)) for w in spans.head])
    judged = Solver(Prediction(model, (), spans.whole, threads=1))
    residuals = judged.p.residuals(judged.trials(values, offsets))
    found = {name: np.full(len(spans.whole), np.nan) for name in channels}
    for k, (whole, head, residual) in enumerate(zip(spans.whole, spans.head, residuals, strict=True)):
        for r in whole.readings:
            if r.channel not in found:
                continue
            error = residual[r.rows].reshape(len(r.time), -1) * r.std
            later = r.time > head.end - head.start + 1e-9
            if later.any():
                found[r.channel][k] = np.sqrt(np.mean(np.sum(error[later] ** 2, axis=1)))
    return found


def by_demonstration(errors: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return the root mean square of the windows of each demonstration that has any, shape (D,)."""
    return np.array([np.sqrt(np.nanmean(errors[group == g] ** 2)) for g in np.unique(group)])


@dataclass(frozen=True)
class Change:
    """Errors of the same windows or demonstrations before and after, in one figure each and paired."""

    before: float
    after: float
    fall: float
    """Share by which the error falls."""
    low: float
    """Lower end of its 95 % bootstrap interval over the units."""
    high: float
    better: float
    """Share of the units whose error falls."""
    p: float
    """Wilcoxon's signed-rank test, two-sided."""
    units: int


def change(before: np.ndarray, after: np.ndarray, seed: int = 0) -> Change:
    """Compare the errors of the same units, shape (n,) each; figures are root mean squares over the units."""
    known = np.isfinite(before) & np.isfinite(after)
    before, after = before[known], after[known]
    rows = np.random.default_rng(seed).integers(len(before), size=(RESAMPLES, len(before)))
    falls = 1 - rms(after[rows]) / np.maximum(rms(before[rows]), 1e-12)
    low, high = np.percentile(falls, [2.5, 97.5])
    first, last = float(rms(before)), float(rms(after))
    same = np.allclose(before, after, rtol=1e-9, atol=0)
    p = 1.0 if same else float(np.asarray(stats.wilcoxon(before, after))[1])
    better = float(np.mean(after < before))
    return Change(first, last, 1 - last / first, float(low), float(high), better, p, len(before))


def rms(values: np.ndarray) -> np.ndarray:
    """Return the root mean square over the last axis."""
    return np.sqrt(np.mean(values**2, axis=-1))


def spans_of(model: Model, recording: Recording, share: float) -> Spans:
    """Cut a recording into the windows that a fit would see, the first `share` of each as its head."""
    noise = channel_noises(model, recording)
    source = ObservedRecording(model, recording, noise)
    whole: list[Window] = []
    heads: list[Window] = []
    for window in observe(model, recording, noise=noise):
        first = source.window(window.number, window.start, window.start + share * (window.end - window.start))
        if first is not None:
            whole.append(window)
            heads.append(first)
    return Spans(whole, heads, tuple(d.name for d in recording.demonstrations))


def noise_errors(model: Model, spans: Spans) -> np.ndarray:
    """Return the root mean square of residual over noise of each window beyond its head, all channels, shape (W,)."""
    solver = Solver(Prediction(model, (), spans.head, threads=1))
    values = solver.p.start
    offsets, _ = solver.fit_initial_states(values, [np.zeros(len(w.spread)) for w in spans.head])
    judged = Solver(Prediction(model, (), spans.whole, threads=1))
    found = np.full(len(spans.whole), np.nan)
    for k, r in enumerate(judged.p.residuals(judged.trials(values, offsets))):
        later = spans.whole[k].clock > spans.head[k].end + 1e-9
        if later.any():
            found[k] = np.sqrt(np.mean(r[later] ** 2))
    return found
