"""Numerical scatter: what the phase of the time grid changes in the predictions of motion with contacts.

A simulation notices a contact at the first step in which bodies overlap, up to one step after they meet. From nearly
equal initial states, bodies leave an impact with velocities that differ by jumps, so that the cost of a fit is a
sawtooth of the initial state, with a local minimum in each tooth. The scatter of a few simulations whose time grids are
shifted against each other is the covariance of this error; residuals are whitened by it (generalised least squares:
Aitken, Proc. R. Soc. Edinburgh 55, 1935), which leaves jumps of about one unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.fit.effects.observation import NumericalScatter, ObservationCfg, Window
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.simulate.select import EngineName

if TYPE_CHECKING:
    from concent_warp.model import Model


def with_scatter(
    model: Model, windows: Sequence[Window], engine: EngineName = "mujoco", cfg: ObservationCfg | None = None
) -> list[Window]:
    """Return windows with the numerical scatter of a model's predictions from their initial states.

    Windows in which nothing touches anything have none.

    Args:
        model: The model, with its effects at their values.
        windows: The windows.
        engine: Which engine simulates.
        cfg: Settings.
    """
    cfg = cfg or ObservationCfg()
    if not cfg.scatter_samples:
        return list(windows)
    prediction = Prediction(model, (), [replace(w, scatter=None) for w in windows], engine=engine)
    rough = [k for k, w in enumerate(windows) if not w.smooth]
    trials = {k: _shifted(prediction, k, cfg) for k in rough}
    courses = iter(prediction.courses([trial for k in rough for trial in trials[k]]))
    found = list(windows)
    for k in rough:
        seen = np.array([prediction.observed(k, next(courses).reader, trial.values) for trial in trials[k]])
        found[k] = replace(found[k], scatter=_scatter(seen, prediction, cfg))
    return found


def _shifted(prediction: Prediction, window: int, cfg: ObservationCfg) -> list[SimulationRequest]:
    """Return simulations of a window that begin within a time step before it, on the way to its initial state."""
    w, values, count = prediction.windows[window], prediction.start, cfg.scatter_samples
    m = prediction.compiled
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = prediction.first_state(w, values)
    mujoco.mj_forward(m, d)
    # What presses bodies apart that overlap at the start, by an error of their measured poses, says nothing about them.
    acceleration = np.zeros(m.nv) if d.ncon else d.qacc
    rng, found = np.random.default_rng(0), []
    for k in range(count):
        early = k / count * m.opt.timestep
        offset = cfg.scatter_offset * w.spread * rng.normal(size=2 * m.nv)
        offset -= early * np.concatenate([d.qvel, acceleration])
        found.append(SimulationRequest(window, values, offset, early))
    return found


def _scatter(residuals: np.ndarray, prediction: Prediction, cfg: ObservationCfg) -> NumericalScatter | None:
    """Return the scatter of the residuals (K, count) of simulations that should agree; None where there is little."""
    most = prediction.cfg.max_residual
    valid = residuals[(np.abs(residuals) < most).all(axis=1)]
    if len(valid) < max(cfg.scatter_samples / 2, 2):
        return None
    deviations = (valid - valid.mean(axis=0)).T / np.sqrt(len(valid) - 1)
    directions, size, _ = np.linalg.svd(deviations, full_matrices=False)
    kept = size > cfg.min_scatter
    return NumericalScatter(directions[:, kept] * size[kept]) if kept.any() else None
