"""Errors of an initial state that fade: only the time until then is simulated.

Drives pull joints back to their setpoints, and a body at rest returns to rest: after some time a simulation from a
slightly different state coincides with the reference. Where it does, the rest of a long window is taken from the
reference. What does not fade is simulated to the end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.checks import Duration, PositiveDuration, Share
from concent_warp.fit.effects.prediction import Course, Prediction, SimulationRequest


@dataclass(frozen=True)
class FadingCfg:
    """When errors of an initial state count as faded."""

    time: PositiveDuration = 1.0
    """Time after which an error has to have faded [s]: several time constants of position-controlled joints."""
    min_window: Duration = 3.0
    """Length of a window above which fading is tested [s]: the test itself simulates `time`."""
    max_share: float = 1e-3
    """Share of an error that may be left, in units of the state's spread [-]: far below the noise."""
    checks: tuple[Share, ...] = (0.75, 0.85, 0.95, 1.0)
    """Instants at which that is tested, as shares of `time` [-]: several, since an oscillation passes through zero."""


@dataclass(frozen=True)
class ReferenceSimulation:
    """A simulation that others are close to."""

    trial: SimulationRequest
    residual: np.ndarray
    """Its residuals, shape (count,)."""


def is_long(prediction: Prediction, window: int, cfg: FadingCfg | None = None) -> bool:
    """Return whether a window is long enough for errors to fade in it."""
    w = prediction.windows[window]
    return w.end - w.start >= (cfg or FadingCfg()).min_window


def residuals_near(
    prediction: Prediction,
    known: Mapping[int, ReferenceSimulation],
    trials: Sequence[SimulationRequest],
    may_fade: Sequence[bool],
    cfg: FadingCfg | None = None,
) -> tuple[list[np.ndarray], list[bool]]:
    """Return the residuals of trials that differ from known ones of their windows by the initial state only.

    Args:
        prediction: What simulates.
        known: The known ones, by window.
        trials: The trials.
        may_fade: For which of them it is tested whether the difference fades.
        cfg: Settings.

    Returns:
        The residuals, and for which trials the difference has faded.
    """
    cfg = cfg or FadingCfg()
    found: list[np.ndarray | None] = [None] * len(trials)
    short = [i for i, test in enumerate(may_fade) if test]
    windows = sorted({trials[i].window for i in short})
    courses = prediction.courses([*(known[w].trial for w in windows), *(trials[i] for i in short)], cfg.time)
    first = dict(zip(windows, courses, strict=False))
    begun = {w: prediction.observed(w, first[w].reader, known[w].trial.values) for w in windows}
    for i, course in zip(short, courses[len(windows) :], strict=True):
        w, trial = trials[i].window, trials[i]
        if _has_faded(prediction, trial, known[w].trial, course, first[w], cfg):
            window = prediction.windows[w]
            change = prediction.observed(w, course.reader, trial.values) - begun[w]
            found[i] = known[w].residual + np.where(window.clock - window.start <= cfg.time, change, 0.0)
    rest = [i for i, residual in enumerate(found) if residual is None]
    for i, residual in zip(rest, prediction.residuals([trials[i] for i in rest]), strict=True):
        found[i] = residual
    return [r for r in found if r is not None], [i not in set(rest) for i in range(len(trials))]


def _has_faded(
    prediction: Prediction,
    trial: SimulationRequest,
    other: SimulationRequest,
    course: Course,
    first: Course,
    cfg: FadingCfg | None = None,
) -> bool:
    """Return whether a simulation coincides with another one in the end."""
    cfg = cfg or FadingCfg()
    m, spread = prediction.compiled, prediction.windows[trial.window].spread
    none = np.zeros_like(spread)
    away = (none if trial.offset is None else trial.offset) - (none if other.offset is None else other.offset)
    allowed = cfg.max_share * float(np.abs(away / spread).max())
    position = np.empty(m.nv)
    for share in cfg.checks:
        k = round(share * (len(course.qpos) - 1))
        mujoco.mj_differentiatePos(m, position, 1.0, first.qpos[k], course.qpos[k])
        off = np.concatenate([position, course.qvel[k] - first.qvel[k]]) / spread
        if not np.abs(off).max() <= allowed:  # so that NaN has not
            return False
    return True
