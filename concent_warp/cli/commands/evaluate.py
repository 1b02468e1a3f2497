"""``concent evaluate``: how often a trained policy succeeds, in simulation and in the stand-in world."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from concent_warp.cli.given_policy import Pretrained, given_checkpoint
from concent_warp.cli.run_folder import claim_file, make_folder
from concent_warp.cli.terminal import progress_bar, quiet_warp, say, say_written
from concent_warp.reality.hidden.in_task import TaskWorld, wanted
from concent_warp.reality.world import WorldCfg
from concent_warp.scene.shape_sorter import ShapeSorterCfg
from concent_warp.train.cfg import EnvironmentCfg, TrainError

if TYPE_CHECKING:
    from concent_warp.train.environment.environment import Environment
    from concent_warp.train.policy.evaluate import Evaluation
    from concent_warp.train.resets.sample import InitialStates
    from concent_warp.train.run import Run as TrainedRun
    from concent_warp.train.task.task import Task


@dataclass(frozen=True)
class Arguments:
    """Run a trained policy from many initial states that it was not trained from, and count successes.

    In the stand-in world shapes are exact, friction cones elliptic and steps fine; the policy has seen none of it.
    """

    checkpoint: Path | None = None
    """Run folder of a training, or its checkpoint file."""
    pretrained: Pretrained = None
    """Run a policy that comes with the package, shape_sorter where no name is given."""
    world: Literal["simulation", "reality", "both"] = "both"
    """Where to run the policy."""
    episodes: int = 200
    """Initial states, of which each is run once in each world."""
    seed: int = 0
    """Seed of the initial states."""
    hide: tuple[str, ...] = ()
    """Effects to hide in the stand-in world, each as name=value in the unit of its main parameter, as in
    joint_friction=1.2; an unknown name lists those that there are."""
    pace: float = 1.0
    """How large the steps of the robot's commands are, as a share of those that the policy was trained with: below 1 it
    moves more slowly, for as long an episode."""
    force: float = 1.0
    """How far commands may lead the joints, as a share of what the policy was trained with: with the stiffness of the
    drives, the largest force that it exerts."""
    videos: int = 0
    """How many of the first episodes in the stand-in world to film, as MP4."""
    out: Path | None = None
    """Folder for the videos; by default the folder videos in the run folder, of a pretrained policy here."""
    overwrite: bool = False
    """Replace videos that are there."""
    json: bool = False
    """Print one JSON object with the outcome of every episode instead of sentences."""
    device: str | None = None
    """Warp's name of the device for the simulation."""
    shapes: ShapeSorterCfg = field(default_factory=ShapeSorterCfg)
    reality: WorldCfg = field(default_factory=WorldCfg)


def run(arguments: Arguments) -> dict[str, Evaluation]:
    """Evaluate and print."""
    quiet_warp()
    import torch

    from concent_warp.train.environment.worlds import make_environment
    from concent_warp.train.learning.ppo import Trainer, load_checkpoint
    from concent_warp.train.policy.evaluate import evaluate
    from concent_warp.train.run import Run

    if arguments.episodes < 1:
        raise TrainError("the number of episodes is not right", expected="at least 1", found=arguments.episodes)
    hidden = wanted(arguments.hide)
    if hidden and arguments.world == "simulation":
        raise TrainError("effects are hidden in the stand-in world alone", fix="add --world reality")
    if arguments.videos and arguments.world == "simulation":
        raise TrainError("videos are of the stand-in world", fix="add --world reality")
    path = given_checkpoint(arguments.checkpoint, arguments.pretrained)
    films = video_files(arguments, Path() if arguments.checkpoint is None else path.parent)
    made = restrained(Run.load(path.parent), arguments.pace, arguments.force)
    task = made.task()
    states = made.evaluation_states(task, arguments.episodes, arguments.seed)
    torch.manual_seed(arguments.seed)
    found: dict[str, Evaluation] = {}
    for world in ("simulation", "reality") if arguments.world == "both" else (arguments.world,):
        cfg = replace(made.cfg.environment, worlds=min(arguments.episodes, made.cfg.environment.worlds))
        if world == "reality":
            environment = real_environment(task, cfg, states, arguments)
        else:
            environment = make_environment(task, cfg, states, device=arguments.device)
        trainer = Trainer(environment, made.cfg)
        weights = load_checkpoint(path, str(environment.device))
        trainer.algorithm.load(weights, {"actor": True}, True)
        with progress_bar(world) as progress:
            reel = Reel(len(films)) if world == "reality" else None
            found[world] = evaluate(environment, trainer.policy(), states, progress=progress, watch=reel)
        if not arguments.json:
            with_ = f" with {', '.join(arguments.hide)} hidden in it" if hidden and world == "reality" else ""
            say(f"{world}{with_}: {found[world].sentence()}")
        if reel is not None and films:
            film_all(films, reel, task_world(task, cfg, arguments), task, states, environment.control_step)
            if not arguments.json:
                say_written(*films)
    if arguments.json:
        named = str(path) if arguments.pretrained is None else f"pretrained {arguments.pretrained}"
        document: dict[str, Any] = {"checkpoint": named, "seed": arguments.seed, "hidden": dict(hidden)}
        document |= {"pace": arguments.pace, "force": arguments.force}
        document["worlds"] = {name: evaluation.to_json() for name, evaluation in found.items()}
        print(json.dumps(document, indent=1, allow_nan=False))
    return found


def restrained(run: TrainedRun, pace: float, force: float) -> TrainedRun:
    """Return a run whose actions take smaller steps, and whose commands lead the joints by less.

    Raises:
        TrainError: One of the shares is not above 0 and at most 1.
    """
    for name, share in (("pace", pace), ("share of the force", force)):
        if not 0 < share <= 1:
            raise TrainError(f"the {name} is not right", expected="more than 0, at most 1", found=share)
    environment = run.cfg.environment
    action = environment.action
    action = replace(action, turn=pace * action.turn, slide=pace * action.slide, gripper=pace * action.gripper)
    action = replace(action, turn_lead=force * action.turn_lead, slide_lead=force * action.slide_lead)
    return replace(run, cfg=replace(run.cfg, environment=replace(environment, action=action)))


class Reel:
    """States of the first episodes of an evaluation."""

    def __init__(self, count: int) -> None:
        self.states: list[list[np.ndarray]] = [[] for _ in range(count)]

    def __call__(self, episodes: np.ndarray, qpos: np.ndarray) -> None:
        """Keep the states of those that are wanted; ids (R,) and positions (R, nq)."""
        for episode, state in zip(episodes, qpos, strict=True):
            if episode < len(self.states):
                self.states[episode].append(state.copy())


def video_files(arguments: Arguments, folder: Path) -> list[Path]:
    """Return the files of the videos that were asked for, none of which is there yet."""
    if not 0 <= arguments.videos <= arguments.episodes:
        raise TrainError(
            "the number of videos is not right", expected=f"0 to {arguments.episodes}", found=arguments.videos
        )
    place = arguments.out or folder / "videos"
    hidden = "".join(f"_{one}" for one in arguments.hide)
    films = [place / f"reality{hidden}_{k:03d}.mp4" for k in range(arguments.videos)]
    for film in films:
        claim_file(film, overwrite=arguments.overwrite)
    return films


def film_all(films: list[Path], reel: Reel, world: TaskWorld, task: Task, starts: InitialStates, period: float) -> None:
    """Film the episodes of a reel, which began with `starts`; their states are a period apart [s]."""
    from concent_warp.reality.sensors.video import filmed, write_video

    bodies = tuple(task.compiled.body(i).name for i in task.objects)
    with progress_bar("videos") as progress:
        for k, (path, states) in enumerate(zip(films, reel.states, strict=True)):
            make_folder(path.parent)
            spec = world.spec()
            for body in task.objects:
                mocap = int(task.compiled.body_mocapid[body])
                if mocap >= 0:
                    placed = spec.body(task.compiled.body(body).name)
                    placed.pos, placed.quat = starts.mocap[k, mocap, :3], starts.mocap[k, mocap, 3:]
            write_video(path, filmed(spec, bodies, np.array(states), period), 1 / period)
            progress((k + 1) / len(films))


def real_environment(task: Task, cfg: EnvironmentCfg, states: InitialStates, arguments: Arguments) -> Environment:
    """Return the stand-in world with the policy's senses and commands, its block to come to rest in the hole."""
    from concent_warp.train.environment.environment import Environment
    from concent_warp.train.environment.physics import Actor, MujocoPhysics

    world = task_world(task, cfg, arguments)
    model = world.compile()
    bodies = [task.compiled.body(i).name for i in range(task.compiled.nbody)]
    if [model.body(i).name for i in range(model.nbody)] != bodies or model.nq != task.compiled.nq:
        raise TrainError("the stand-in world has other bodies than the model", where=task.model.scene.source)
    shapes = arguments.shapes
    if task.place is not None:
        task = replace(task, place=np.array([0.0, 0.0, shapes.floor + shapes.block_size / 2]))
    steps = round(cfg.decimation * task.replay.timestep / arguments.reality.timestep)
    actors = [[Actor(one.effect.force, one.effect.command) for one in world.hidden()] for _ in range(cfg.worlds)]
    physics = MujocoPhysics(model, cfg.worlds, steps, actors=actors)
    return Environment(task, replace(cfg, collision="full"), physics, states)


def task_world(task: Task, cfg: EnvironmentCfg, arguments: Arguments) -> TaskWorld:
    """Return the stand-in world that was asked for."""
    return TaskWorld(
        task.model.scene,
        arguments.reality,
        task.compiled.body(task.objects[0]).name,
        cfg.action.gripper_actuators,
        wanted(arguments.hide),
    )
