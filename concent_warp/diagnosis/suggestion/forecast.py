"""What hypotheses predict for motions that were not recorded yet, and how well they can then be distinguished.

Let y_i be the readings that hypothesis i predicts, in units of their noise, F_j the dependence of those of hypothesis
j on its parameters, A their dependence on the initial states of the windows, in units of the standard deviations with
which the data at hand leave both open. Where i is true, refitting j to old and new data leaves the squared error

    2 E_ij = min over p, a of  |y_i - y_j - F_j p - A a|^2 + |p|^2 + |a|^2,

to first order. E_ij [nat] is the expected log likelihood ratio of i to j, the Kullback-Leibler divergence of their
predictions with what a refit absorbs removed: T-optimality (Atkinson and Fedorov, "The design of experiments for
discriminating between two rival models", Biometrika 62, 1975), with the data at hand as prior as in Box and Hill
("Discrimination among mechanistic models", Technometrics 9, 1967).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
from scipy.linalg import block_diag

from concent_warp.diagnosis.experiment.future_window import difference_in_noise, future_window
from concent_warp.diagnosis.experiment.motions import ProposedMotion, RecordedRange
from concent_warp.diagnosis.suggestion.hypotheses import Hypothesis
from concent_warp.effects.effect import Reader
from concent_warp.errors import ConcentError
from concent_warp.fit.effects.observation import NumericalScatter, ObservedRecording, Window
from concent_warp.fit.effects.observe import has_touchable_free_body, keeps_close
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.fit.effects.scatter import with_scatter
from concent_warp.simulate.select import EngineName

REFITS = 5
"""Steps of a simulated refit."""
Readings = list[np.ndarray]
"""Predicted readings of a window, one (T, dim) for each channel."""


@dataclass(frozen=True)
class Forecast:
    """How well a motion distinguishes H hypotheses."""

    evidence: np.ndarray
    """Expected log likelihood ratio [nat] of the true hypothesis (row) to another one (column) that is refitted to old
    and new data, shape (H, H)."""
    separation: np.ndarray
    """What a refit leaves of the difference of the predictions, RMS over the noise in the channel where it is largest
    [-], shape (H, H)."""
    channels: tuple[tuple[str, ...], ...]
    """These channels, H by H names."""
    count: int
    """Readings of the motion."""

    def plain(self) -> list[Any]:
        """Return it in plain types."""
        return [self.evidence.tolist(), self.separation.tolist(), [list(row) for row in self.channels], self.count]

    @staticmethod
    def of(plain: Sequence[Any]) -> Forecast:
        """Return a forecast from what `plain` returned."""
        evidence, separation, channels, count = plain
        return Forecast(np.array(evidence), np.array(separation), tuple(map(tuple, channels)), int(count))

    def score(self, needed: float, clear: float) -> float:
        """Return what a search maximises: minus the log of the mean odds that hypotheses stay confused.

        Evidence of many readings by a small difference counts less: formulas are not exact, and their errors are as
        large as what they leave, however many readings there are.

        Args:
            needed: Evidence from which a hypothesis counts as excluded [nat].
            clear: Separation from which on evidence counts in full [-].
        """
        ratio = self.evidence / max(needed, 1e-9) * np.minimum(self.separation / clear, 1.0) ** 2
        return float(-np.log(np.mean(1 / (1 + ratio[~np.eye(len(ratio), dtype=bool)]))))

    def decides(self, needed: float, clear: float) -> bool:
        """Return whether all hypotheses are expected to be distinguished, by more than `clear`; see `score`."""
        between = ~np.eye(len(self.evidence), dtype=bool)
        return bool(((self.evidence >= needed) & (self.separation >= clear))[between].all())


@dataclass(frozen=True)
class Course:
    """The motion of the likeliest hypothesis and of all others, K + 1 steps."""

    time: np.ndarray
    """[s], shape (K + 1,)."""
    qpos: np.ndarray
    """Shape (H, K + 1, nq)."""
    qvel: np.ndarray
    """Shape (H, K + 1, nv)."""
    readings: tuple[Readings, ...] = ()
    """What each hypothesis predicts of the whole motion."""


def courses(
    hypotheses: Sequence[Hypothesis], recorded: RecordedRange, motions: Sequence[ProposedMotion], engine: EngineName
) -> list[Course | None]:
    """Return the simulated motions, one batch a hypothesis; None where one of them does not stay finite."""
    windows = [future_window(recorded, motion, motion.duration) for motion in motions]
    kept = [w for w in windows if w is not None]
    found, seen = [], []
    for hypothesis in hypotheses:
        prediction = Prediction(hypothesis.model, (), kept, engine=engine)
        requests = [SimulationRequest(w, prediction.start) for w in range(len(kept))]
        found.append(prediction.courses(requests))
        seen.append(_read(hypothesis, prediction, requests, [course.reader for course in found[-1]]))
    dt, result, row = recorded.m.opt.timestep, [], 0
    for window in windows:
        if window is None:
            result.append(None)
            continue
        own = [of_hypothesis[row] for of_hypothesis in found]
        readings = tuple(of_hypothesis[row] for of_hypothesis in seen)
        row += 1
        qpos, qvel = np.stack([c.qpos for c in own]), np.stack([c.qvel for c in own])
        finite = np.isfinite(qpos).all() and np.isfinite(qvel).all()
        result.append(Course(dt * np.arange(qpos.shape[1]), qpos, qvel, readings) if finite else None)
    return result


def forecasts(
    hypotheses: Sequence[Hypothesis],
    recorded: RecordedRange,
    candidates: Sequence[Sequence[tuple[ProposedMotion, Course]]],
    engine: EngineName,
    *,
    window: float,
    step: float,
    starts: bool = True,
    careful: bool = False,
    seed: int = 0,
) -> list[Forecast | None]:
    """Return forecasts of candidates, all simulated in one batch a hypothesis; None where one does not stay finite.

    Args:
        hypotheses: H hypotheses, the likeliest first.
        recorded: The present recording.
        candidates: Motions of each candidate with their courses.
        engine: Which engine simulates.
        window: Longest window where free bodies can be touched [s].
        step: Step of finite differences [standard deviations].
        starts: Whether initial states are estimated too, else they are known.
        careful: Whether windows end where errors of their initial states are no longer of proportional effect, the
            numerical scatter of contacts counts as noise, as in a diagnosis, and refits are simulated.
        seed: Seed of the disturbances that determine that.
    """
    windows, owner, whole = [], [], dict[int, tuple[Readings, ...]]()
    for k, motions in enumerate(candidates):
        for motion, course in motions:
            cut = _windows(recorded, motion, course, window, engine if careful else None, seed)
            if len(cut) == 1 and cut[0].end == motion.duration and course.readings:
                whole[len(windows)] = course.readings
            windows += cut
            owner += [k] * len(cut)
    try:
        base = [_predicted(h, windows, engine, {w: of[i] for w, of in whole.items()}) for i, h in enumerate(hypotheses)]
        slopes = [_parameter_slopes(h, windows, of_h, engine, step) for h, of_h in zip(hypotheses, base, strict=True)]
        of_starts = _start_slopes(hypotheses[0], windows, base[0], engine, step) if starts else None
        scatter = _scatter(hypotheses[0], recorded, windows, base[0], engine) if careful else [None] * len(windows)
    except (ConcentError, ValueError, mujoco.FatalError):
        return [None] * len(candidates)
    found: list[Forecast | None] = []
    for k in range(len(candidates)):
        rows = [w for w, of in enumerate(owner) if of == k]
        found.append(
            _forecast(hypotheses, rows, windows, base, slopes, of_starts, scatter, engine if careful else None)
            if rows
            else None
        )
    return found


def _windows(
    recorded: RecordedRange,
    motion: ProposedMotion,
    course: Course,
    longest: float,
    engine: EngineName | None,
    seed: int,
) -> list[Window]:
    """Return a motion as windows, as a diagnosis will cut it; with an engine, each ends where it is unpredictable."""
    found, start = [], 0.0
    length = longest if has_touchable_free_body(recorded.m) else motion.duration
    while start < motion.duration - 1e-6:
        span = min(length, motion.duration - start)
        row = min(round(start / recorded.m.opt.timestep), len(course.time) - 1)
        action = {name: replace(c, time=c.time - start) for name, c in motion.action.items()}
        rest = replace(motion, qpos=course.qpos[0, row], qvel=course.qvel[0, row], action=action, duration=span)
        made = future_window(recorded, rest, span)
        if made is not None and engine is not None:
            source = ObservedRecording(recorded.model, recorded.recording, recorded.noise, recorded.observation)
            made = future_window(recorded, rest, keeps_close(source, made.demonstration, 0.0, span, engine, seed))
        if made is not None:
            found.append(made)
        start += span
    return found


def _observed(hypothesis: Hypothesis, prediction: Prediction, requests: Sequence[SimulationRequest]) -> list[Readings]:
    """Return what instruments read in some simulations of a hypothesis."""
    return _read(hypothesis, prediction, requests, prediction.readers(requests))


def _read(
    hypothesis: Hypothesis,
    prediction: Prediction,
    requests: Sequence[SimulationRequest],
    readers: Sequence[Reader],
) -> list[Readings]:
    """Return what instruments read in some simulations of a hypothesis, from what those of its model read."""
    found = []
    for request, reader in zip(requests, readers, strict=True):
        read = reader
        for added, part in zip(hypothesis.model.effects, prediction.split, strict=True):
            if added.effect.measures:
                read = added.effect.measure(hypothesis.model.scene.model, read, request.values[part])
        found.append([read(r.channel, r.time) for r in prediction.windows[request.window].readings])
    return found


def _predicted(
    hypothesis: Hypothesis, windows: Sequence[Window], engine: EngineName, known: Mapping[int, Readings]
) -> list[Readings]:
    """Return what a hypothesis predicts in each window; what is known of some is not simulated again."""
    prediction = Prediction(hypothesis.model, (), windows, engine=engine)
    fresh = [w for w in range(len(windows)) if w not in known]
    seen = _observed(hypothesis, prediction, [SimulationRequest(w, prediction.start) for w in fresh])
    found = dict(known) | dict(zip(fresh, seen, strict=True))
    return [found[w] for w in range(len(windows))]


def _parameter_slopes(
    hypothesis: Hypothesis, windows: Sequence[Window], base: Sequence[Readings], engine: EngineName, step: float
) -> list[np.ndarray]:
    """Return the change of the readings per standard deviation of free parameters, (count, P) a window."""
    prediction = Prediction(hypothesis.model, (), windows, engine=engine)
    free = np.flatnonzero(hypothesis.std > 0)
    low, high = (np.array([getattr(p, name) for p in prediction.parameters]) for name in ("low", "high"))
    requests, steps = [], []
    for k in free:
        size = step * hypothesis.std[k]
        size = size if prediction.start[k] + size <= high[k] or prediction.start[k] - size < low[k] else -size
        moved = prediction.start.copy()
        moved[k] += size
        steps.append(size / hypothesis.std[k])
        requests += [SimulationRequest(w, moved) for w in range(len(windows))]
    seen, count = _observed(hypothesis, prediction, requests), len(windows)
    return [
        np.stack([difference_in_noise(w, seen[i * count + k], base[k]) / size for i, size in enumerate(steps)], axis=1)
        if steps
        else np.zeros((w.count, 0))
        for k, w in enumerate(windows)
    ]


def _start_slopes(
    hypothesis: Hypothesis, windows: Sequence[Window], base: Sequence[Readings], engine: EngineName, step: float
) -> list[np.ndarray]:
    """Return the change of the readings per standard deviation of the initial state, (count, 2 nv) a window."""
    prediction = Prediction(hypothesis.model, (), windows, engine=engine)
    requests = [
        SimulationRequest(w, prediction.start, offset)
        for w, window in enumerate(windows)
        for offset in step * np.diag(window.spread)
    ]
    seen, found, row = _observed(hypothesis, prediction, requests), [], 0
    for k, window in enumerate(windows):
        own = seen[row : row + len(window.spread)]
        row += len(window.spread)
        found.append(np.stack([difference_in_noise(window, one, base[k]) / step for one in own], axis=1))
    return found


def _scatter(
    hypothesis: Hypothesis,
    recorded: RecordedRange,
    windows: Sequence[Window],
    base: Sequence[Readings],
    engine: EngineName,
) -> list[NumericalScatter | None]:
    """Return the numerical scatter of a hypothesis's predictions in each window, None where nothing touches."""
    filled = [
        replace(w, readings=tuple(replace(r, value=v) for r, v in zip(w.readings, seen, strict=True)))
        for w, seen in zip(windows, base, strict=True)
    ]
    return [w.scatter for w in with_scatter(hypothesis.model, filled, engine, recorded.observation)]


def _whitened(scatter: NumericalScatter | None, value: np.ndarray) -> np.ndarray:
    """Return differences (count,) or (count, P) in units of noise and scatter together."""
    if scatter is None:
        return value
    if value.ndim == 1:
        return scatter.whitened(value)
    return np.stack([scatter.whitened(column) for column in value.T], axis=1) if value.size else value


def _forecast(
    hypotheses: Sequence[Hypothesis],
    rows: Sequence[int],
    windows: Sequence[Window],
    base: Sequence[Sequence[Readings]],
    slopes: Sequence[Sequence[np.ndarray]],
    starts: Sequence[np.ndarray] | None,
    scatter: Sequence[NumericalScatter | None],
    engine: EngineName | None,
) -> Forecast | None:
    """Return the forecast of the candidate that some of the windows belong to; with an engine, refits are simulated."""
    size, own = len(hypotheses), [windows[w] for w in rows]
    evidence, separation = np.zeros((size, size)), np.zeros((size, size))
    channels = [[""] * size for _ in range(size)]
    for j, hypothesis in enumerate(hypotheses):
        refit = _Refit(
            hypothesis,
            own,
            [_whitened(scatter[w], slopes[j][w]) for w in rows],
            None if starts is None else [_whitened(scatter[w], starts[w]) for w in rows],
            [scatter[w] for w in rows],
        )
        for i in range(size):
            if i == j:
                continue
            found = refit.to([base[i][w] for w in rows], [base[j][w] for w in rows], engine)
            if found is None:
                return None
            cost, left = found
            evidence[i, j] = 0.5 * cost
            squares, start = dict[str, list[np.ndarray]](), 0
            for window in own:
                for r in window.readings:
                    squares.setdefault(r.channel, []).append(left[start + r.rows.start : start + r.rows.stop])
                start += window.count
            ratios = {name: float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) for name, parts in squares.items()}
            channels[i][j] = max(ratios, key=lambda name: ratios[name])
            separation[i, j] = ratios[channels[i][j]]
    return Forecast(evidence, separation, tuple(map(tuple, channels)), sum(w.count for w in own))


@dataclass(frozen=True)
class _Refit:
    """Fits of a hypothesis to what others predict in W windows, from the data at hand as its prior."""

    hypothesis: Hypothesis
    windows: Sequence[Window]
    slopes: Sequence[np.ndarray]
    """Dependence of the readings on free parameters, in units of noise and standard deviations, (count, P) a window."""
    starts: Sequence[np.ndarray] | None
    """The same on initial states, (count, 2 nv) a window; None where these are known."""
    scatter: Sequence[NumericalScatter | None]

    @cached_property
    def jacobian(self) -> np.ndarray:
        """Dependence of all readings on the parameters, then on the initial states of each window."""
        slopes = np.concatenate(self.slopes)
        return slopes if self.starts is None else np.hstack([slopes, np.asarray(block_diag(*self.starts))])

    @cached_property
    def normal(self) -> np.ndarray:
        """Normal matrix of the fits with their prior."""
        return self.jacobian.T @ self.jacobian + np.eye(self.jacobian.shape[1])

    def to(
        self, target: Sequence[Readings], own: Sequence[Readings], engine: EngineName | None
    ) -> tuple[float, np.ndarray] | None:
        """Return squared error and prior of the best fit, and what it leaves (count,); None where one is not finite.

        Args:
            target: What the true hypothesis predicts, a window each.
            own: What this one predicts before the fit.
            engine: What simulates the fits (Gauss-Newton steps with the slopes as they are, the best one counts); None
                for the linear fit alone.
        """
        apart = self._apart(target, own)
        if not np.isfinite(apart).all() or not np.isfinite(self.normal).all():
            return None
        fitted = np.linalg.solve(self.normal, self.jacobian.T @ apart)
        left = apart - self.jacobian @ fitted
        if engine is None:
            return float(left @ left + fitted @ fitted), left
        best, at = (float(apart @ apart), apart), np.zeros(len(fitted))
        step = fitted
        for _ in range(REFITS):
            tried = at + step
            apart = self._apart(target, self._simulated(tried, engine))
            cost = float(apart @ apart + tried @ tried) if np.isfinite(apart).all() else np.inf
            if cost < best[0]:
                best, at = (cost, apart), tried
                step = np.linalg.solve(self.normal, self.jacobian.T @ apart - at)
            else:
                step = 0.5 * step
        return best

    def _apart(self, target: Sequence[Readings], own: Sequence[Readings]) -> np.ndarray:
        """Return the differences of readings in all windows, in units of noise, shape (count,)."""
        parts = zip(self.scatter, self.windows, target, own, strict=True)
        return np.concatenate([_whitened(one, difference_in_noise(w, a, b)) for one, w, a, b in parts])

    def _simulated(self, fitted: np.ndarray, engine: EngineName) -> list[Readings]:
        """Return what the hypothesis predicts in each window after a fit."""
        prediction = Prediction(self.hypothesis.model, (), self.windows, engine=engine)
        free = np.flatnonzero(self.hypothesis.std > 0)
        low, high = (np.array([getattr(p, name) for p in prediction.parameters]) for name in ("low", "high"))
        values = prediction.start.copy()
        values[free] += fitted[: len(free)] * self.hypothesis.std[free]
        values = np.clip(values, np.minimum(low, prediction.start), np.maximum(high, prediction.start))
        offsets = fitted[len(free) :].reshape(len(self.windows), -1)
        requests = [
            SimulationRequest(k, values, offset * w.spread if len(offset) else None)
            for k, (w, offset) in enumerate(zip(self.windows, offsets, strict=True))
        ]
        return _observed(self.hypothesis, prediction, requests)
