"""From settings to worlds: which simulator, with which buffers, and what differs between the worlds."""

from __future__ import annotations

import mujoco
import numpy as np
from concent_warp.train.cfg import EnvironmentCfg, RandomisationCfg, Range
from concent_warp.train.environment import Environment
from concent_warp.train.physics import MujocoPhysics, Physics, WarpPhysics
from concent_warp.train.resets import InitialStates
from concent_warp.train.task import Task

ROOM = 2.0
"""Contacts and constraint rows to make room for, relative to the most of the demonstration."""
SPARE = 16
"""Contacts beyond that."""


def make_environment(
    task: Task, cfg: EnvironmentCfg, states: InitialStates, *, device: str | None = None, seed: int = 0
) -> Environment:
    """Return the environment of a task on a device, the first CUDA device by default where there is one."""
    return Environment(task, cfg, make_physics(task, cfg, device=device, seed=seed), states)


def make_physics(task: Task, cfg: EnvironmentCfg, *, device: str | None = None, seed: int = 0) -> Physics:
    """Return the worlds of a task."""
    from concent_warp.simulate.warp_engine import preferred_device

    device = preferred_device() if device is None else device
    m = task.compiled
    found = [(added.effect.law(m), added.array) for added in task.model.effects]
    laws = [(law, values) for law, values in found if law is not None]
    on_cpu = not device.startswith("cuda")
    if cfg.engine == "mujoco" or (cfg.engine == "auto" and on_cpu):
        return MujocoPhysics(m, cfg.worlds, cfg.decimation, laws)
    contacts = int(ROOM * task.replay.contacts) + SPARE if cfg.nconmax is None else cfg.nconmax
    constraints = int(ROOM * task.replay.constraints) + 4 * SPARE if cfg.njmax is None else cfg.njmax
    return WarpPhysics(
        m,
        cfg.worlds,
        cfg.decimation,
        laws,
        device=device,
        nconmax=contacts,
        njmax=constraints,
        factors=drawn_fields(m, cfg.worlds, cfg.randomisation, seed),
        capture=cfg.capture != "none",
    )


def drawn_fields(m: mujoco.MjModel, worlds: int, cfg: RandomisationCfg, seed: int) -> dict[str, np.ndarray]:
    """Return the values of the model fields that differ between worlds, shape (N, ...) each."""
    rng = np.random.default_rng([seed, 2])
    fields: dict[str, np.ndarray] = {}

    def factors(range_: Range, *trailing: int) -> np.ndarray:
        return rng.uniform(*range_, worlds).reshape(worlds, *[1] * len(trailing))

    if cfg.friction[0] != cfg.friction[1]:
        fields["geom_friction"] = np.tile(m.geom_friction, (worlds, 1, 1))
        fields["geom_friction"][..., 0] *= factors(cfg.friction, 1)
    if cfg.stiffness[0] != cfg.stiffness[1]:
        scale = factors(cfg.stiffness, 1)
        gain, bias = np.tile(m.actuator_gainprm, (worlds, 1, 1)), np.tile(m.actuator_biasprm, (worlds, 1, 1))
        gain[..., 0] *= scale
        bias[..., 1] *= scale
        fields |= {"actuator_gainprm": gain, "actuator_biasprm": bias}
    if cfg.damping[0] != cfg.damping[1]:
        fields["dof_damping"] = np.tile(m.dof_damping, (worlds, 1)) * factors(cfg.damping, 1)
    return fields
