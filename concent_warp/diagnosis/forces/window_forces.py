"""Unexplained forces by window: the model's simulation from the measured state against the readings.

From the smoothed state at the start of a short window the model is simulated to its end. The departure of the readings
from that is, to first order, the response of the model's dynamics to an error of the start and to an unexplained
acceleration a (see `window_solver`). Least squares over the window separates the two, and M a is the residual
generalised force: the momentum that the model lacks, over the window. This holds through impacts and sliding, where an
inverse dynamics at the measured state would depend on penetrations smaller than the noise. The force is an average over
the window with the weight 30 u^2 (1 - u)^2, u = 0..1 from start to end.

The window is also simulated from further states, sampled from the error of the smoothed one; the scatter of a among
them (an impact inside the window or outside) adds to its error, and so does a misfit beyond the noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from concent_warp.diagnosis.forces.cfg import LocateForcesCfg
from concent_warp.diagnosis.forces.window_solver import Simulated, WindowSolver
from concent_warp.errors import RecordingError
from concent_warp.simulate.engine import ContactLog, Engine, Variants

if TYPE_CHECKING:
    from concent_warp.estimation.state_estimator import StateEstimator

INSTANTS = (np.arange(5) + 0.5) / 5
"""Instants within a window, as shares of its length, at which what forces depend on is taken."""
INSTANT_WEIGHTS = 30 * INSTANTS**2 * (1 - INSTANTS) ** 2 / np.sum(30 * INSTANTS**2 * (1 - INSTANTS) ** 2)
"""Their weights: those with which forces are averaged, shape (5,)."""


@dataclass(frozen=True)
class Windows:
    """Unexplained forces of one demonstration; K windows, each overlapping the next by half."""

    demonstration: str
    start: np.ndarray
    """[s], shape (K,)."""
    length: float
    """[s]."""
    qpos: np.ndarray
    """Smoothed state in the middle, shape (K, nq)."""
    qvel: np.ndarray
    """Shape (K, nv)."""
    edge_qvel: np.ndarray
    """Smoothed velocities at start and end, shape (2, K, nv)."""
    force: np.ndarray
    """Residual generalised force [N, N m], shape (K, nv); NaN where it cannot be estimated."""
    covariance: np.ndarray
    """Of the force, shape (K, nv, nv); 0 rows where it cannot be estimated."""
    contacts: ContactLog
    """Contacts of the model in each window; `variant` is the window, `step` counts from its start."""
    path: np.ndarray
    """Simulated positions from the smoothed start, shape (K, S + 1, nq)."""

    @property
    def time(self) -> np.ndarray:
        """Middles of the windows [s], shape (K,)."""
        return self.start + self.length / 2

    @property
    def std(self) -> np.ndarray:
        """Standard deviation of the force, shape (K, nv)."""
        return np.sqrt(np.einsum("kii->ki", self.covariance))


def window_length(motion: StateEstimator) -> float:
    """Return the default length of a window for what was measured [s]."""
    return float(min(max(0.12 if motion.bodies else 0.1, 8 * motion.period), 0.3))


def window_forces(name: str, engine: Engine, motion: StateEstimator, cfg: LocateForcesCfg) -> Windows:
    """Simulate all windows of a demonstration, by its name, and return the unexplained forces.

    Raises:
        RecordingError: The demonstration is shorter than a window.
    """
    m = engine.compiled
    begin, end = motion.span
    length = window_length(motion) if cfg.length is None else cfg.length
    half = max(round(length / engine.timestep / 2), 2)
    steps, length = 2 * half, 2 * half * engine.timestep
    if end - begin < 1.5 * length:
        raise RecordingError(
            "all that moves was measured for too short a time",
            where=name,
            expected=f"at least {1.5 * length:.3g} s",
            found=f"{max(end - begin, 0.0):.3g} s",
        )
    first, last = int(np.ceil(begin / engine.timestep - 1e-9)), int((end - length) / engine.timestep + 1e-9)
    step = np.arange(first, last + 1, half)
    start = step * engine.timestep
    ctrl = motion.ctrl[np.minimum(step[:, None] + np.arange(steps), len(motion.ctrl) - 1)]
    rng = np.random.default_rng(cfg.seed)
    qpos, qvel = motion.sample_states(start, cfg.extra_starts, rng)
    first_run = Variants(len(start), qpos=qpos[0], qvel=qvel[0])
    nominal = engine.run(first_run, ctrl, bodies=(), contacts="all").numpy()
    assert nominal.contacts is not None
    path = np.asarray(nominal.qpos, dtype=float)[None]
    if cfg.extra_starts:
        count = cfg.extra_starts * len(start)
        further = Variants(count, qpos=qpos[1:].reshape(count, m.nq), qvel=qvel[1:].reshape(count, m.nv))
        extra = engine.run(further, ctrl, bodies=()).numpy()
        path = np.concatenate([path, np.asarray(extra.qpos, dtype=float).reshape(cfg.extra_starts, *path.shape[1:])])
    speed = np.asarray(nominal.qvel, dtype=float)
    middle = start + length / 2
    mid = motion.states(middle)
    edges = np.stack([motion.states(start).qvel, motion.states(start + length).qvel])
    force = np.full((len(start), m.nv), np.nan)
    covariance = np.zeros((len(start), m.nv, m.nv))
    solver = WindowSolver(motion, engine, length, cfg.solver)
    log = nominal.contacts
    edge = np.searchsorted(log.variant, np.arange(len(start) + 1))
    for k in range(len(start)):
        rows = {name: value[edge[k] : edge[k + 1]] for name, value in vars(log).items()}
        simulated = Simulated(start[k], path[:, k], speed[k], mid.qpos[k], mid.qvel[k], ctrl[k], ContactLog(**rows))
        force[k], covariance[k] = solver.solve(simulated)
    return Windows(name, start, length, mid.qpos, mid.qvel, edges, force, covariance, log, path[0])
