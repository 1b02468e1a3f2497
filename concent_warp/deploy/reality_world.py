"""Reality as an environment: the observation and action of a policy on the physics of Reality."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from concent_warp.deploy.cfg import RealityWorldCfg
from concent_warp.errors import TrainError
from concent_warp.reality.fingers import pad_geoms
from concent_warp.reality.hidden.in_task import TaskWorld, parse_effects
from concent_warp.train.cfg import EnvironmentCfg
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.physics import Actor, MujocoPhysics
from concent_warp.train.resets.reset_states import ResetStates
from concent_warp.train.task.task import Task


def reality_world(task: Task, cfg: EnvironmentCfg, world: RealityWorldCfg) -> TaskWorld:
    """Return Reality with a task's scene."""
    return TaskWorld(
        task.model.scene,
        world.reality,
        task.compiled.body(task.objects[0]).name,
        cfg.action.gripper_actuators,
        parse_effects(world.hide),
    )


def reality_environment(
    task: Task, cfg: EnvironmentCfg, states: ResetStates, world: RealityWorldCfg | None = None, *, seed: int = 0
) -> Environment:
    """Return an environment whose physics is Reality's; success is the block at rest in the hole.

    Args:
        task: Task of the policy.
        cfg: Settings of the training environment.
        states: Initial states of the episodes.
        world: Hidden effects, sizes, physics and instruments of Reality.
        seed: Seed of what varies between the worlds.

    Raises:
        TrainError: Reality has other bodies than the model.
    """
    world = world or RealityWorldCfg()
    real = reality_world(task, cfg, world)
    model = real.compile()
    bodies = [task.compiled.body(i).name for i in range(task.compiled.nbody)]
    if [model.body(i).name for i in range(model.nbody)] != bodies or model.nq != task.compiled.nq:
        raise TrainError("Reality has other bodies than the model", where=task.model.scene.source)
    goal = task.model.scene.goal()
    if goal is None and task.model.scene.spec().modelname == "shape_sorter":
        goal = world.shapes.goal()
    if goal is not None and task.target_position is not None and task.stage == len(task.events.stages) - 1:
        task = replace(task, target_position=goal)
    steps = round(cfg.decimation * task.replay.timestep / world.reality.timestep)
    actors = [[Actor(one.effect.force, one.effect.command) for one in real.hidden()] for _ in range(cfg.worlds)]
    names = [task.compiled.body(i).name for i in task.objects]
    pads = pad_geoms(model, cfg.action.gripper_actuators)
    fields = world.variation.sample(model, names, pads, cfg.worlds, np.random.default_rng([seed, 3]))
    physics = MujocoPhysics(model, cfg.worlds, steps, actors=actors, fields=fields)
    physical = replace(cfg, collision="full", virtual=replace(cfg.virtual, points=0))
    return Environment(task, physical, physics, states, world.sensors)
