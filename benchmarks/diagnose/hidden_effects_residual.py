"""How far a recording is from a model: residuals over noise, starts refitted.

An initial state is measured only roughly, so it is fitted first (Gauss-Newton with a prior wider than its measurement
error): the residual is then what no initial state can explain.
"""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.estimation.rotations import rotation_between
from concent_warp.model import Model
from concent_warp.recording.recording import Demonstration, Recording
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.replay import commands, initial_state, interpolate, step_count

FREE = mujoco.mjtJoint.mjJNT_FREE
PRIOR = {"free": (3e-4, 3e-3, 5e-3, 3e-2), "joint": (3e-3, 3e-3)}
"""Spread of initial states: position [m], orientation [rad], velocity, turning; joint and its speed."""
STEPS = (0.2, 0.2, 0.1, 0.05, 0.02)
"""Of the finite differences, as shares of the prior's spread: wide first, for impacts jump from step to step."""
Residuals = dict[str, np.ndarray]


def ratios(model: Model, recording: Recording) -> dict[str, float]:
    """Return the root mean square of residual over noise of each channel, over all demonstrations.

    Starts are refitted where bodies move at the start; what rests or is driven forgets its start.
    """
    engine = MujocoEngine(model, threads=1)
    square: dict[str, list[np.ndarray]] = {}
    for demonstration in recording.demonstrations:
        for name, value in best_residuals(engine, demonstration).items():
            square.setdefault(name, []).append(value.ravel() ** 2)
    return {name: float(np.sqrt(np.mean(np.concatenate(parts)))) for name, parts in square.items()}


def best_residuals(engine: MujocoEngine, demonstration: Demonstration) -> Residuals:
    """Return residuals over noise by channel, each (T, dim), from the start that explains most."""
    m, nv = engine.compiled, engine.compiled.nv
    qpos, qvel = initial_state(engine.model.scene.model, demonstration)
    ctrl = commands(m, demonstration, step_count(demonstration, engine.timestep))
    for added in engine.model.effects:
        ctrl = added.effect.command(m, ctrl, added.array)
    scale = spread(m, qpos)

    def run(offset: np.ndarray) -> list[Residuals]:
        start = np.repeat(qpos[None], len(offset), axis=0)
        for row, delta in zip(start, offset, strict=True):
            mujoco.mj_integratePos(m, row, delta[:nv] * scale[:nv], 1.0)
        rate = qvel + offset[:, nv:] * scale[nv:]
        rollout = engine.run(Variants(len(offset), qpos=start, qvel=rate), ctrl, bodies=[])
        return [scaled_residuals(engine, rollout.time, seen, demonstration) for seen in rollout.sensordata]

    best = np.zeros(2 * nv)
    residual = run(best[None])[0]
    cost = np.sum(stacked(residual, best) ** 2)
    for step in STEPS if qvel.any() else ():
        base = stacked(residual, best)
        varied = np.concatenate([best + step * np.eye(2 * nv), best - step * np.eye(2 * nv)])
        seen = np.stack([stacked(r, x) for r, x in zip(run(varied), varied, strict=True)], axis=1)
        jacobian = (seen[:, : 2 * nv] - seen[:, 2 * nv :]) / (2 * step)
        normal = jacobian.T @ jacobian
        trials = [
            best - np.linalg.solve(normal + d * np.diag(np.diag(normal)), jacobian.T @ base) for d in (1e-3, 0.1, 10.0)
        ]
        found = run(np.array(trials))
        costs = [np.sum(stacked(r, x) ** 2) for r, x in zip(found, trials, strict=True)]
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
    engine: MujocoEngine, time: np.ndarray, sensordata: np.ndarray, demonstration: Demonstration
) -> Residuals:
    """Return residuals over noise by channel, each (T, dim), given all sensors at times (K,) [s]."""
    m = engine.compiled

    def read(sensor: str, at: np.ndarray) -> np.ndarray:
        row = m.sensor(sensor).id
        value = sensordata[:, m.sensor_adr[row] :][:, : m.sensor_dim[row]]
        if m.sensor_type[row] == mujoco.mjtSensor.mjSENS_FRAMEQUAT:
            flips = np.where((value[1:] * value[:-1]).sum(axis=1) < 0, -1.0, 1.0)
            value = value * np.concatenate([[1.0], np.cumprod(flips)])[:, None]
        return interpolate(time, value, at)

    reader = read
    for added in engine.model.effects:
        reader = added.effect.measure(m, reader, added.array)
    found = {}
    for name, channel in demonstration.measured.items():
        predicted = reader(name, channel.time)
        turned = m.sensor_type[m.sensor(name).id] == mujoco.mjtSensor.mjSENS_FRAMEQUAT
        value = rotation_between(predicted, channel.value) if turned else channel.value - predicted
        assert channel.noise_std is not None
        found[name] = value / channel.noise_std
    return found


def stacked(residual: Residuals, offset: np.ndarray) -> np.ndarray:
    """Return all residuals and the prior's, in one vector; wild ones are tamed so that one bounce does not rule."""
    every = np.nan_to_num(np.concatenate([r.ravel() for r in residual.values()]), nan=1e3, posinf=1e3, neginf=-1e3)
    return np.concatenate([np.clip(every, -1e3, 1e3), offset])
