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

from concent_warp.errors import RecordingError
from concent_warp.fit.effects.impacts import impact_deviations
from concent_warp.fit.effects.observation import NumericalScatter, Window
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.replay import commands
from concent_warp.simulate.select import EngineName, make_engine

if TYPE_CHECKING:
    from concent_warp.model import Model


CHATTER_DIFFERENCES = 5
"""Consecutive second differences of which at least half must be rough [-]: an impact bends two of them."""
BODIES = (int(mujoco.mjtObj.mjOBJ_BODY), int(mujoco.mjtObj.mjOBJ_XBODY))
FREE_DOFS = 6
"""Degrees of freedom of a body that moves freely."""


def with_scatter(
    model: Model,
    windows: Sequence[Window],
    engine: EngineName = "mujoco",
    cfg: ObservationCfg | None = None,
    offsets: Sequence[np.ndarray] | None = None,
) -> list[Window]:
    """Return windows with the numerical scatter of a model's predictions from their initial states.

    Windows in which nothing touches anything have none, nor have those without the commands to simulate them.

    Args:
        model: The model, with its effects at their values.
        windows: The windows.
        engine: Which engine simulates.
        cfg: Settings.
        offsets: Errors of the initial states, each (2 nv,); none by default.
    """
    cfg = cfg or ObservationCfg()
    if not cfg.scatter_samples:
        return list(windows)
    prediction = Prediction(model, (), [replace(w, scatter=None) for w in windows], engine=engine)
    rough = [k for k, w in enumerate(windows) if not w.smooth and touches(model, w, engine)]
    starts = [None] * len(windows) if offsets is None else list(offsets)
    trials = {k: _shifted(prediction, k, cfg, starts[k]) for k in rough}
    courses = iter(prediction.courses([trial for k in rough for trial in trials[k]]))
    found = [w if w.common is None else replace(w, scatter=NumericalScatter(w.common)) for w in windows]
    for k in rough:
        seen = np.array([prediction.observed(k, next(courses).reader, trial.values) for trial in trials[k]])
        by_impacts = impact_deviations(prediction, k, cfg, starts[k])
        found[k] = replace(found[k], scatter=_scatter(seen, by_impacts, prediction, cfg, windows[k]))
    return found


def touches(model: Model, w: Window, engine: EngineName) -> bool | None:
    """Return whether something touches something in a model's motion from the estimated state of a window on.

    None where the recording has no commands to simulate it; who simulates it says so.
    """
    steps = max(int(np.ceil((w.end - w.start) / model.scene.model.opt.timestep - 1e-9)), 1)
    start = Variants(1, qpos=w.qpos[None], qvel=w.qvel[None])
    try:
        ctrl = commands(model.compile(), w.demonstration, steps, w.start)
    except RecordingError:
        return None
    simulator = make_engine(engine, model.with_payloads(w.demonstration.payloads))
    rollout = simulator.run(start, ctrl, record=[0], bodies=[], contacts="touched").numpy()
    return bool(rollout.diverged.any() or rollout.touched.any())


def _shifted(
    prediction: Prediction, window: int, cfg: ObservationCfg, begun: np.ndarray | None
) -> list[SimulationRequest]:
    """Return simulations of a window that begin within a time step before it, on the way to its initial state."""
    w, values, count = prediction.windows[window], prediction.start, cfg.scatter_samples
    m = prediction.compiled
    step = m.opt.timestep
    (course,) = prediction.courses([SimulationRequest(window, values, begun)], 2 * step)
    acceleration = np.nan_to_num((course.qvel[1] - course.qvel[0]) / step, posinf=0.0, neginf=0.0)
    # What presses bodies apart that overlap at the start, by an error of their measured poses, says nothing about them.
    acceleration[_touching_dofs(m, course.qpos[0])] = 0.0
    rng, found = np.random.default_rng(0), []
    for k in range(count):
        early = k / count * step
        offset = cfg.scatter_offset * w.spread * rng.normal(size=2 * m.nv)
        offset -= early * np.concatenate([course.qvel[0], acceleration])
        offset += 0.0 if begun is None else begun
        found.append(SimulationRequest(window, values, offset, early))
    return found


def _touching_dofs(m: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Return which degrees of freedom are those of a mechanism or body that touches something, shape (nv,) bool."""
    d = mujoco.MjData(m)
    d.qpos[:] = qpos
    mujoco.mj_fwdPosition(m, d)
    touching = m.body_rootid[m.geom_bodyid[d.contact.geom[d.contact.dist <= 0].ravel()]]
    return np.isin(m.body_rootid[m.dof_bodyid], touching)


def _scatter(
    residuals: np.ndarray, by_impacts: np.ndarray, prediction: Prediction, cfg: ObservationCfg, w: Window
) -> NumericalScatter | None:
    """Return the scatter of a window's residuals; None where there is little.

    Args:
        residuals: Those of simulations that should agree, shape (K, count).
        by_impacts: See `impact_deviations`.
        prediction: What simulated them.
        cfg: Settings.
        w: The window.
    """
    most = prediction.cfg.max_residual
    valid = residuals[(np.abs(residuals) < most).all(axis=1)]
    deviations, own = by_impacts, None
    if len(valid) >= max(cfg.scatter_samples / 2, 2):
        away = (valid - valid.mean(axis=0)).T / np.sqrt(len(valid) - 1)
        deviations = np.hstack([away, by_impacts])
        alone = _of_single_bodies(prediction.model(prediction.start).scene.model, w, len(away))
        own = cfg.chatter * chatter(away, w) * alone
        own = own if own.max(initial=0.0) > cfg.min_scatter else None
    directions, size, _ = np.linalg.svd(deviations, full_matrices=False)
    kept = size > cfg.min_scatter
    if w.common is None:
        return NumericalScatter(directions[:, kept] * size[kept], own) if kept.any() else None
    return NumericalScatter(np.hstack([directions[:, kept] * size[kept], w.common]), own)


def _of_single_bodies(m: mujoco.MjModel, w: Window, count: int) -> np.ndarray:
    """Return which residuals are of poses of bodies that move freely and alone, shape (count,) bool.

    Hops of what drives and joints move, as of a leg, are motion: their size says how soft its contact is.
    """
    found = np.zeros(count, dtype=bool)
    for r in w.readings:
        sensor = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SENSOR, r.channel)
        if sensor < 0 or m.sensor_objtype[sensor] not in BODIES:
            continue
        body = int(m.sensor_objid[sensor])
        dofs = m.body_rootid[m.dof_bodyid] == m.body_rootid[body]
        joint = m.body_jntadr[m.body_rootid[body]]
        is_free = joint >= 0 and m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
        found[r.rows] = is_free and dofs.sum() == FREE_DOFS
    return found


def chatter(deviations: np.ndarray, w: Window) -> np.ndarray:
    """Return the standard deviation of what changes without order from reading to reading, shape (count,).

    It is that of the second differences of three consecutive readings of a component, over sqrt(6), which is theirs for
    independent readings: what moves steadily apart, as after an impact, has none. Of those nearby it is the median:
    a single impact is no chatter.

    Args:
        deviations: Deviations of the residuals whose squares add up to their variances, shape (count, K).
        w: The window; channels with missing components have none.
    """
    found = np.zeros(len(deviations))
    for r in w.readings:
        count = len(r.time)
        if r.known is not None or count < 3:
            continue
        course = deviations[r.rows].reshape(count, -1, deviations.shape[1])
        bend = course[2:] - 2 * course[1:-1] + course[:-2]
        square = (bend**2).sum(axis=2) / 6
        half = CHATTER_DIFFERENCES // 2
        padded = np.pad(square, ((half + 1, half + 1), (0, 0)), mode="symmetric" if count > half + 3 else "edge")
        near = np.lib.stride_tricks.sliding_window_view(padded, CHATTER_DIFFERENCES, axis=0)
        found[r.rows] = np.sqrt(np.median(near, axis=2)).ravel()
    return found
