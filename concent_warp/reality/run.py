"""Simulation of Reality under recorded commands, logged without sensor noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from concent_warp.reality.sensors.sensing import SensingCfg, are_visible, visible_points
from concent_warp.reality.world import HiddenEffect
from concent_warp.scene.scene import Scene


@dataclass
class WorldLog:
    """Noise-free readings, one list entry per step or per camera frame."""

    time: list[float] = field(default_factory=list)
    qpos: list[np.ndarray] = field(default_factory=list)
    sensordata: list[np.ndarray] = field(default_factory=list)
    pairs: list[dict[tuple[str, str], np.ndarray]] = field(default_factory=list)
    frames: list[float] = field(default_factory=list)
    points: dict[str, list[np.ndarray]] = field(default_factory=dict)
    visible: dict[str, list[np.ndarray]] = field(default_factory=dict)


def simulate_to_rest(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    ctrl: np.ndarray,
    effects: tuple[HiddenEffect, ...] = (),
    duration: float = 0.3,
) -> None:
    """Simulate until objects and arm are at rest, before the recording starts, with the forces of the effects.

    Args:
        model: Reality.
        data: Its state, changed in place; time is 0 afterwards.
        ctrl: Commands, shape (nu,).
        effects: Hidden effects.
        duration: Simulated time [s].
    """
    data.ctrl[:] = ctrl
    for _ in range(round(duration / model.opt.timestep)):
        _act(model, data, effects)
        mujoco.mj_step(model, data)
    data.time = 0.0


def _act(model: mujoco.MjModel, data: mujoco.MjData, effects: tuple[HiddenEffect, ...]) -> None:
    """Set the applied forces of the next step to those of the effects."""
    data.qfrc_applied[:] = 0
    data.xfrc_applied[:] = 0
    for effect in effects:
        if effect.force is not None:
            effect.force(model, data)


def simulate(
    sensing: SensingCfg,
    scene: Scene,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    time: np.ndarray,
    action: np.ndarray,
    effects: tuple[HiddenEffect, ...],
    rng: np.random.Generator,
    progress: Callable[[float], None] | None,
) -> WorldLog:
    """Step the world along the commands and log every step and every camera frame."""
    log = WorldLog()
    track = {body: visible_points(scene, model, data, body, sensing, rng) for body in scene.objects()}
    log.points, log.visible = {body: [] for body in track}, {body: [] for body in track}
    steps = round(time[-1] / model.opt.timestep)
    wander = np.zeros(model.nu)
    keep = np.exp(-model.opt.timestep / sensing.tracking_time)
    kick = sensing.tracking_std * np.sqrt(1 - keep**2)
    next_frame = 0.0
    bodies = [model.body(body).name for body in model.geom_bodyid]
    for k in range(steps + 1):
        now = k * model.opt.timestep
        ctrl = action[np.searchsorted(time, now + 1e-9, side="right") - 1]
        for effect in effects:
            if effect.command is not None:
                ctrl = effect.command(now, ctrl)
        wander = keep * wander + kick * rng.normal(size=model.nu)
        data.ctrl[:] = ctrl + wander
        _act(model, data, effects)
        qpos = data.qpos.copy()
        mujoco.mj_step(model, data)  # sensors, poses and contacts are those of the state before the step
        log.time.append(now)
        log.qpos.append(qpos)
        log.sensordata.append(data.sensordata.copy())
        log.pairs.append(_touching(model, data, bodies))
        if now >= next_frame - 1e-9:
            next_frame += 1 / sensing.point_rate
            log.frames.append(now)
            for body, local in track.items():
                place = data.body(body)
                points = place.xpos + local @ place.xmat.reshape(3, 3).T
                log.visible[body].append(are_visible(sensing, model, data, points, sensing.visibility_slack))
                noisy = points + rng.normal(0, sensing.point_std, points.shape)
                log.points[body].append(np.where(log.visible[body][-1][:, None], noisy, np.nan))
        if progress is not None and k % 200 == 0:
            progress(k / steps)
    return log


def _touching(model: mujoco.MjModel, data: mujoco.MjData, bodies: Sequence[str]) -> dict[tuple[str, str], np.ndarray]:
    """Return the body pairs in contact, in alphabetical order, with the force on the second [N], world frame.

    Args:
        model: Reality.
        data: Its state.
        bodies: Name of the body of each geom.
    """
    pairs: dict[tuple[str, str], np.ndarray] = {}
    force = np.zeros(6)
    geoms, frames = data.contact.geom, data.contact.frame.reshape(-1, 3, 3)
    for i in np.flatnonzero(data.contact.efc_address >= 0):
        first, second = (bodies[int(geom)] for geom in geoms[i])
        mujoco.mj_contactForce(model, data, i, force)
        vector = frames[i].T @ force[:3]
        pair, vector = ((first, second), vector) if first <= second else ((second, first), -vector)
        pairs[pair] = pairs.get(pair, np.zeros(3)) + vector
    return pairs
