"""How far a recording is from the drawing of its scene: residuals over noise, starts refitted.

A start is told only roughly, so it is fitted first (Gauss-Newton with a prior of the error with which it is told): what
is left then is what no start can explain.
"""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco import rollout

from concent_warp.diagnose.residuals import rotation_between
from concent_warp.recording.recording import Demonstration, Recording
from concent_warp.scene.scene import Scene
from concent_warp.simulate.replay import commands, initial_state, interpolate, step_count

FREE = mujoco.mjtJoint.mjJNT_FREE
PRIOR = {"free": (3e-4, 3e-3, 5e-3, 3e-2), "joint": (3e-3, 3e-3)}
"""Spread of starts about what is told: position [m], orientation [rad], velocity, turning; joint and its speed."""
STEPS = (0.2, 0.2, 0.1, 0.05, 0.02)
"""Of the finite differences, as shares of the prior's spread: wide first, for impacts jump from step to step."""


def nominal_ratio(recording: Recording, *, refit: bool = True) -> dict[str, float]:
    """Return the root mean square of residual over noise of each channel, over all demonstrations."""
    model = Scene(recording.scene).model
    square: dict[str, list[np.ndarray]] = {}
    for demonstration in recording.demonstrations:
        for name, value in best_residuals(model, demonstration, refit).items():
            square.setdefault(name, []).append(value.ravel() ** 2)
    return {name: float(np.sqrt(np.mean(np.concatenate(parts)))) for name, parts in square.items()}


def best_residuals(m: mujoco.MjModel, demonstration: Demonstration, refit: bool) -> dict[str, np.ndarray]:
    """Return residuals over noise by channel, each (T, dim), from the start that explains most."""
    qpos, qvel = initial_state(m, demonstration)
    steps = step_count(demonstration, m.opt.timestep)
    ctrl = commands(m, demonstration, steps)
    scale = spread(m, qpos)
    data = mujoco.MjData(m)

    def run(offset: np.ndarray) -> list[dict[str, np.ndarray]]:
        start = np.repeat(qpos[None], len(offset), axis=0)
        for row, delta in zip(start, offset, strict=True):
            mujoco.mj_integratePos(m, row, delta[: m.nv] * scale[: m.nv], 1.0)
        rate = qvel + offset[:, m.nv :] * scale[m.nv :]
        zero = np.zeros((len(offset), 1))
        state = np.concatenate([zero, start, rate, np.zeros((len(offset), m.na))], axis=1)
        # One step more, for sensors are those before each step.
        control = np.concatenate([ctrl, ctrl[-1:]])
        _, sensordata = rollout.rollout(m, data, state, np.repeat(control[None], len(offset), axis=0))
        time = np.arange(len(control)) * m.opt.timestep
        return [scaled_residuals(m, time, seen, demonstration) for seen in np.asarray(sensordata)]

    best = np.zeros(2 * m.nv)
    residual = run(best[None])[0]
    if not refit:
        return residual
    cost = stacked(residual, best) @ stacked(residual, best)
    damping = 1e-3
    for step in STEPS:
        base = stacked(residual, best)
        varied = np.concatenate([best + step * np.eye(len(best)), best - step * np.eye(len(best))])
        seen = np.stack([stacked(r, x) for r, x in zip(run(varied), varied, strict=True)], axis=1)
        jacobian = (seen[:, : len(best)] - seen[:, len(best) :]) / (2 * step)
        normal = jacobian.T @ jacobian
        trials = [
            best - np.linalg.solve(normal + d * np.diag(np.diag(normal)), jacobian.T @ base)
            for d in (damping, 0.1, 10.0)
        ]
        found = run(np.array(trials))
        costs = [stacked(r, x) @ stacked(r, x) for r, x in zip(found, trials, strict=True)]
        k = int(np.argmin(costs))
        if costs[k] < cost:
            best, residual, cost = trials[k], found[k], costs[k]
    return residual


def spread(m: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Return the prior's spread of positions and velocities at the start, shape (2 nv,).

    A body in contact at the start rests: its height, roll and pitch are known.
    """
    position, velocity = np.zeros(m.nv), np.zeros(m.nv)
    data = mujoco.MjData(m)
    data.qpos[:] = qpos
    mujoco.mj_forward(m, data)
    resting = set(m.geom_bodyid[data.contact.geom].ravel().tolist())
    for j in range(m.njnt):
        v = m.jnt_dofadr[j]
        if m.jnt_type[j] == FREE:
            p, r, speed, turning = PRIOR["free"]
            position[v : v + 6], velocity[v : v + 6] = [p] * 3 + [r] * 3, [speed] * 3 + [turning] * 3
            if m.jnt_bodyid[j] in resting:
                position[v + 2 : v + 5] = velocity[v + 2 : v + 5] = 1e-9
        else:
            position[v], velocity[v] = PRIOR["joint"]
    return np.concatenate([position, velocity])


def scaled_residuals(
    m: mujoco.MjModel, time: np.ndarray, sensordata: np.ndarray, demonstration: Demonstration
) -> dict[str, np.ndarray]:
    """Return residuals over noise by channel, each (T, dim), given all sensors at times (K,) [s]."""
    found = {}
    for name, channel in demonstration.measured.items():
        row = m.sensor(name).id
        predicted = sensordata[:, m.sensor_adr[row] :][:, : m.sensor_dim[row]]
        if m.sensor_type[row] == mujoco.mjtSensor.mjSENS_FRAMEQUAT:
            flips = np.where((predicted[1:] * predicted[:-1]).sum(axis=1) < 0, -1.0, 1.0)
            predicted = predicted * np.concatenate([[1.0], np.cumprod(flips)])[:, None]
            value = rotation_between(interpolate(time, predicted, channel.time), channel.value)
        else:
            value = channel.value - interpolate(time, predicted, channel.time)
        assert channel.noise_std is not None
        found[name] = value / channel.noise_std
    return found


def stacked(residual: dict[str, np.ndarray], offset: np.ndarray) -> np.ndarray:
    """Return all residuals and the prior's, in one vector; wild ones are tamed so that one bounce does not rule."""
    every = np.concatenate([*(np.nan_to_num(r, nan=0, posinf=1e4, neginf=-1e4).ravel() for r in residual.values())])
    return np.concatenate([np.sign(every) * np.minimum(np.abs(every), 1e3), offset])
