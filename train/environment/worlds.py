"""Environment from settings: simulator, buffers, and the values that differ between worlds."""

from __future__ import annotations

import copy
import os

import mujoco
import warp as wp

from concent_warp.errors import TrainError
from concent_warp.train.cfg import EnvironmentCfg
from concent_warp.train.environment.command_dynamics import CommandDynamics
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.physics import MujocoPhysics, Physics, WarpPhysics
from concent_warp.train.environment.randomisation import sample_command_dynamics, sample_model_fields
from concent_warp.train.environment.world_effects import sample_world_effects
from concent_warp.train.resets.sample import ResetStates
from concent_warp.train.task.task import Task

JACOBIANS = {
    "dense": mujoco.mjtJacobian.mjJAC_DENSE,
    "sparse": mujoco.mjtJacobian.mjJAC_SPARSE,
}
CONES = {
    "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC,
    "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL,
}


def make_environment(
    task: Task,
    cfg: EnvironmentCfg,
    states: ResetStates,
    *,
    device: str | None = None,
    seed: int = 0,
    refine: int = 1,
    time_constant: float | None = None,
) -> Environment:
    """Return the environment of a task.

    Args:
        task: The task.
        cfg: Settings.
        states: Initial states of the episodes.
        device: Warp's name of the device; the first CUDA device by default, the CPU without one.
        seed: Seed of the values that are sampled for each world.
        refine: Simulation steps in place of each one of the settings, for finer physics.
        time_constant: Time constant of all contacts [s]; by default that of the model's geoms.

    Raises:
        TrainError: The worlds do not fit the memory.
    """
    check_worlds(task, cfg, device)
    physics = _make_physics(task, cfg, device=device, seed=seed, refine=refine, time_constant=time_constant)
    return Environment(task, cfg, physics, states)


def check_worlds(task: Task, cfg: EnvironmentCfg, device: str | None = None) -> None:
    """Check that the worlds of an environment fit the memory, by the size of one.

    Raises:
        TrainError: They need more than the device has.
    """
    from concent_warp.simulate.warp_engine import preferred_device

    device = preferred_device() if device is None else device
    m, (contacts, constraints) = task.compiled, buffer_sizes(task, cfg)
    if cfg.engine == "mujoco" or (cfg.engine == "auto" and not device.startswith("cuda")):
        data = mujoco.MjData(m)
        size = int(data.nbuffer) + (1 << 16)  # of the arena, which is large, only what is used is taken
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 1 << 40
    else:
        from concent_warp.simulate.warp_program import Buffers, world_bytes

        size = world_bytes(m, Buffers(contacts, constraints))
        memory = int(wp.get_device(device).total_memory) if device.startswith("cuda") else 1 << 40
    if size * cfg.worlds > memory:
        raise TrainError(
            "so many worlds do not fit the memory",
            where=device,
            expected=f"at most {memory // size:,} of {size / 1e3:,.0f} kB each",
            found=f"{cfg.worlds:,}",
            fix="lower --worlds",
        )


def _make_physics(
    task: Task,
    cfg: EnvironmentCfg,
    *,
    device: str | None = None,
    seed: int = 0,
    refine: int = 1,
    time_constant: float | None = None,
) -> Physics:
    """Return the simulated worlds of a task."""
    from concent_warp.simulate.warp_engine import preferred_device

    device = preferred_device() if device is None else device
    m = _with_solver_settings(task.compiled, cfg)
    m.opt.timestep /= refine
    if time_constant is not None:
        m.geom_solref[:, 0] = time_constant
    steps = simulation_steps(task.compiled, cfg) * refine
    on_cpu = not device.startswith("cuda")
    in_c = cfg.engine == "mujoco" or (cfg.engine == "auto" and on_cpu)
    if in_c:
        variable = None
    else:
        from concent_warp.simulate.warp_model import batchable as variable
    effects = sample_world_effects(task, cfg.worlds, seed, sample=cfg.randomise_effects, variable=variable)
    fields = sample_model_fields(task, cfg.worlds, cfg.randomisation, seed, effects.fields)
    command_dynamics = CommandDynamics.combined(
        [*effects.command_dynamics, sample_command_dynamics(task, cfg.worlds, cfg.randomisation, seed)]
    )
    if in_c:
        return MujocoPhysics(
            m, cfg.worlds, steps, effects.force_models, fields=fields, command_dynamics=command_dynamics
        )
    contacts, constraints = buffer_sizes(task, cfg)
    return WarpPhysics(
        m,
        cfg.worlds,
        steps,
        effects.force_models,
        device=device,
        nconmax=contacts,
        njmax=constraints,
        fields=fields,
        command_dynamics=command_dynamics,
        capture=cfg.capture != "none",
    )


def _with_solver_settings(m: mujoco.MjModel, cfg: EnvironmentCfg) -> mujoco.MjModel:
    """Return a copy of a model with the settings' solver, friction cones and time step."""
    limited = copy.copy(m)
    limited.opt.timestep *= cfg.decimation // simulation_steps(m, cfg)
    if cfg.cone != "auto":
        limited.opt.cone = CONES[cfg.cone]
    if cfg.cone == "pyramidal":
        limited.opt.impratio = 1.0  # an edge of a pyramid is normal and tangential at once
    limited.opt.jacobian = m.opt.jacobian if cfg.jacobian == "auto" else JACOBIANS[cfg.jacobian]
    limited.opt.iterations = m.opt.iterations if cfg.solver_iterations is None else cfg.solver_iterations
    limited.opt.ls_iterations = m.opt.ls_iterations if cfg.ls_iterations is None else cfg.ls_iterations
    return limited


def simulation_steps(m: mujoco.MjModel, cfg: EnvironmentCfg) -> int:
    """Return the simulation steps per action; see `EnvironmentCfg.stride`."""
    if cfg.stride is not None:
        return cfg.decimation // cfg.stride
    constants = m.geom_solref[(m.geom_contype != 0) | (m.geom_conaffinity != 0), 0]
    constants = constants[constants > 0]  # others are stiffness and damping, from which no step follows
    longest = constants.min() / 2 if len(constants) else m.opt.timestep
    strides = [k for k in range(1, cfg.decimation + 1) if cfg.decimation % k == 0]
    fitting = [k for k in strides if k * m.opt.timestep <= longest * (1 + 1e-9)]
    return cfg.decimation // max(fitting, default=1)


def buffer_sizes(task: Task, cfg: EnvironmentCfg) -> tuple[int, int]:
    """Return the capacities of a world: contacts and constraint rows."""
    contacts = int(cfg.buffer_factor * task.replay.contacts) + cfg.buffer_spare if cfg.nconmax is None else cfg.nconmax
    constraints = (
        int(cfg.buffer_factor * task.replay.constraints) + 4 * cfg.buffer_spare if cfg.njmax is None else cfg.njmax
    )
    return contacts, constraints
