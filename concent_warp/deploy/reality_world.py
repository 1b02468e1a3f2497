"""Reality as a training environment sees it: the policy's senses and commands on physics that it has never met."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from concent_warp.deploy.cfg import RealityWorldCfg
from concent_warp.errors import TrainError
from concent_warp.reality.hidden.in_task import TaskWorld, wanted
from concent_warp.train.cfg import EnvironmentCfg
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.physics import Actor, MujocoPhysics
from concent_warp.train.resets.reset_states import ResetStates
from concent_warp.train.task.task import Task


def reality_world(task: Task, cfg: EnvironmentCfg, world: RealityWorldCfg) -> TaskWorld:
    """Return Reality around a task's scene."""
    return TaskWorld(
        task.model.scene,
        world.reality,
        task.compiled.body(task.objects[0]).name,
        cfg.action.gripper_actuators,
        wanted(world.hide),
    )


def reality_environment(
    task: Task, cfg: EnvironmentCfg, states: ResetStates, world: RealityWorldCfg | None = None
) -> Environment:
    """Return an environment whose physics is Reality's; success is the block at rest in the hole.

    Args:
        task: What the policy was trained for.
        cfg: Settings of the environment that the policy was trained in.
        states: Initial states, of which each episode takes one.
        world: Reality.

    Raises:
        TrainError: Reality has other bodies than the model.
    """
    world = world or RealityWorldCfg()
    real = reality_world(task, cfg, world)
    model = real.compile()
    bodies = [task.compiled.body(i).name for i in range(task.compiled.nbody)]
    if [model.body(i).name for i in range(model.nbody)] != bodies or model.nq != task.compiled.nq:
        raise TrainError("Reality has other bodies than the model", where=task.model.scene.source)
    if task.place is not None:
        task = replace(task, place=np.array([0.0, 0.0, world.shapes.floor + world.shapes.block_size / 2]))
    steps = round(cfg.decimation * task.replay.timestep / world.reality.timestep)
    actors = [[Actor(one.effect.force, one.effect.command) for one in real.hidden()] for _ in range(cfg.worlds)]
    physics = MujocoPhysics(model, cfg.worlds, steps, actors=actors)
    return Environment(task, replace(cfg, collision="full"), physics, states)
