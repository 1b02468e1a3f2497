"""Domain randomisation: factors on the physics of each world, and delays and lags of its commands.

A policy trained over ranges of friction, mass, stiffness and delay does not depend on their exact values. All values
are sampled once for each world.
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np

from concent_warp.train.cfg import RandomisationCfg
from concent_warp.train.environment.command_dynamics import CommandDynamics
from concent_warp.train.task.task import Task

UNCHANGED, ZERO = (1.0, 1.0), (0.0, 0.0)
"""Ranges of a factor, and of a friction or a time, that change nothing."""


def sample_model_fields(
    task: Task,
    worlds: int,
    cfg: RandomisationCfg,
    seed: int,
    fields: Mapping[str, np.ndarray] | None = None,
) -> dict[str, np.ndarray]:
    """Return sampled values of the model fields that differ between worlds, by name, shape (N, ...) each.

    Args:
        task: The task.
        worlds: N.
        cfg: Ranges of the factors.
        seed: Seed.
        fields: Values that differ already, to which the factors are applied.
    """
    m = task.compiled
    rng = np.random.default_rng([seed, 2])
    found = dict(fields or {})

    def drawn(extent: tuple[float, float], shape: int | tuple[int, ...] = worlds) -> np.ndarray:
        return rng.choice(extent, shape) if cfg.extremes else rng.uniform(*extent, shape)

    def scaled(name: str, factor: np.ndarray, *, rows: np.ndarray | slice = slice(None), column: int | None = None):
        given, value = found.get(name), getattr(m, name)
        values = np.tile(value, (worlds, *[1] * value.ndim)) if given is None else given.copy()
        where = (slice(None), rows) if column is None else (slice(None), rows, column)
        values[where] *= factor.reshape(worlds, *[1] * (values[where].ndim - 1))
        found[name] = values

    robot = np.isin(m.geom_bodyid, _moved_by_robot(task))
    for extent, rows in ((cfg.friction, np.flatnonzero(~robot)), (cfg.grip, np.flatnonzero(robot))):
        if extent != UNCHANGED:
            scaled("geom_friction", drawn(extent), rows=rows, column=0)
    if cfg.stiffness != UNCHANGED:
        factor = drawn(cfg.stiffness)
        scaled("actuator_gainprm", factor, column=0)
        scaled("actuator_biasprm", factor, column=1)
    if cfg.damping != UNCHANGED:
        scaled("dof_damping", drawn(cfg.damping))
    if cfg.joint_friction != ZERO:
        actuator, dof = task.robot.actuator, task.robot.dof
        strongest = np.where(m.actuator_forcelimited[actuator], m.actuator_forcerange[actuator, 1], np.inf)
        share = np.ones(len(dof)) if np.isinf(strongest).any() else strongest / strongest.max()
        loss = found.get("dof_frictionloss", np.tile(m.dof_frictionloss, (worlds, 1))).copy()
        loss[:, dof] += drawn(cfg.joint_friction, (worlds, 1)) * share
        found["dof_frictionloss"] = loss
    if cfg.mass != UNCHANGED:
        factor, bodies = drawn(cfg.mass), np.array(task.objects)
        scaled("body_mass", factor, rows=bodies)
        scaled("body_inertia", factor, rows=bodies)
    return found


def sample_command_dynamics(task: Task, worlds: int, cfg: RandomisationCfg, seed: int) -> CommandDynamics:
    """Return the sampled delay and lag of the arm's commands in N worlds."""
    rng = np.random.default_rng([seed, 4])
    times = []
    for extent in (cfg.delay, cfg.lag):
        values = np.zeros((worlds, task.compiled.nu))
        if extent != ZERO:
            values[:, task.robot.actuator] = rng.uniform(*extent, (worlds, 1))
        times.append(values)
    return CommandDynamics(times[0], (times[1],))


def _moved_by_robot(task: Task) -> list[int]:
    """Return the ids of the bodies that the robot's joints move."""
    m: mujoco.MjModel = task.compiled
    moved = {int(i) for i in m.jnt_bodyid[task.robot.joint]}
    for body in range(m.nbody):  # parents come before their children
        if int(m.body_parentid[body]) in moved:
            moved.add(body)
    return sorted(moved)
