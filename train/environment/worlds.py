"""From settings to worlds: which simulator, with which buffers, and what differs between the worlds."""

from __future__ import annotations

import copy

import mujoco

from concent_warp.train.cfg import EnvironmentCfg
from concent_warp.train.environment.command_dynamics import CommandDynamics
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.physics import MujocoPhysics, Physics, WarpPhysics
from concent_warp.train.environment.randomisation import sample_command_dynamics, sample_model_fields
from concent_warp.train.environment.world_effects import sample_world_effects
from concent_warp.train.resets.sample import ResetStates
from concent_warp.train.task.task import Task

ROOM = 2.0
"""Contacts and constraint rows to make room for, relative to the most of the demonstration."""
SPARE = 16
"""Contacts beyond that."""
JACOBIANS = {
    "dense": mujoco.mjtJacobian.mjJAC_DENSE,
    "sparse": mujoco.mjtJacobian.mjJAC_SPARSE,
}
CONES = {
    "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC,
    "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL,
}


def make_environment(
    task: Task, cfg: EnvironmentCfg, states: ResetStates, *, device: str | None = None, seed: int = 0
) -> Environment:
    """Return the environment of a task on a device, the first CUDA device by default where there is one."""
    return Environment(task, cfg, _make_physics(task, cfg, device=device, seed=seed), states)


def _make_physics(task: Task, cfg: EnvironmentCfg, *, device: str | None = None, seed: int = 0) -> Physics:
    """Return the worlds of a task."""
    from concent_warp.simulate.warp_engine import preferred_device

    device = preferred_device() if device is None else device
    m = _solver_chosen(task.compiled, cfg)
    on_cpu = not device.startswith("cuda")
    plain = cfg.engine == "mujoco" or (cfg.engine == "auto" and on_cpu)
    if plain:
        variable = None
    else:
        from concent_warp.simulate.warp_model import batchable as variable
    effects = sample_world_effects(task, cfg.worlds, seed, draw=cfg.randomise_effects, variable=variable)
    fields = sample_model_fields(task, cfg.worlds, cfg.randomisation, seed, effects.fields)
    following = CommandDynamics.of([*effects.late, sample_command_dynamics(task, cfg.worlds, cfg.randomisation, seed)])
    if plain:
        return MujocoPhysics(m, cfg.worlds, cfg.simulation_steps, effects.laws, fields=fields, following=following)
    contacts, constraints = buffers(task, cfg)
    return WarpPhysics(
        m,
        cfg.worlds,
        cfg.simulation_steps,
        effects.laws,
        device=device,
        nconmax=contacts,
        njmax=constraints,
        fields=fields,
        following=following,
        capture=cfg.capture != "none",
    )


def _solver_chosen(m: mujoco.MjModel, cfg: EnvironmentCfg) -> mujoco.MjModel:
    """Return a model with the solver, friction cones and time step that the settings ask for."""
    limited = copy.copy(m)
    limited.opt.timestep *= cfg.stride
    if cfg.cone != "auto":
        limited.opt.cone = CONES[cfg.cone]
    if cfg.cone == "pyramidal":
        limited.opt.impratio = 1.0  # an edge of a pyramid is normal and tangential at once
    limited.opt.jacobian = m.opt.jacobian if cfg.jacobian == "auto" else JACOBIANS[cfg.jacobian]
    limited.opt.iterations = m.opt.iterations if cfg.solver_iterations is None else cfg.solver_iterations
    limited.opt.ls_iterations = m.opt.ls_iterations if cfg.ls_iterations is None else cfg.ls_iterations
    return limited


def buffers(task: Task, cfg: EnvironmentCfg) -> tuple[int, int]:
    """Return for how many contacts and constraint rows a world is to have room."""
    contacts = int(ROOM * task.replay.contacts) + SPARE if cfg.nconmax is None else cfg.nconmax
    constraints = int(ROOM * task.replay.constraints) + 4 * SPARE if cfg.njmax is None else cfg.njmax
    return contacts, constraints
