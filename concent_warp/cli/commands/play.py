"""``concent play``: a trained policy at work, live in the browser."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from concent_warp.cli.commands import evaluate
from concent_warp.cli.given_policy import Pretrained, given_checkpoint
from concent_warp.cli.terminal import quiet_warp, say
from concent_warp.reality.hidden.in_task import wanted
from concent_warp.reality.world import WorldCfg
from concent_warp.scene.shape_sorter import ShapeSorterCfg
from concent_warp.train.cfg import TrainError

if TYPE_CHECKING:
    import mujoco

    from concent_warp.report.live import LiveView
    from concent_warp.train.policy.play import Moment, Player

PAUSE = 1.0
"""How long the last moment of an episode stays, at normal speed [s]."""
IDLE = 0.2
"""Time between looks at the controls while nothing moves [s]."""
AWAY = (0.3, -0.42, 0.36)
"""Where the objects are seen from, relative to them [m]."""


@dataclass(frozen=True)
class Arguments:
    """Show a trained policy at work, live in the browser.

    Serves a page with robot, objects and the model's contact spheres, those coloured that touch something, and the
    points that the policy is to bring together. It can be paused, stepped, slowed down and begun anew. Ctrl-C ends it.
    """

    checkpoint: Path | None = None
    """Run folder of a training, or its checkpoint file."""
    pretrained: Pretrained = None
    """Show a policy that comes with the package, shape_sorter where no name is given."""
    world: Literal["simulation", "reality"] = "simulation"
    """Where the policy acts: in the model that it was trained in, or in the stand-in world."""
    hide: tuple[str, ...] = ()
    """Effects to hide in the stand-in world, as for concent evaluate."""
    pace: float = 1.0
    """Share of the robot's pace in training, as for concent evaluate."""
    force: float = 1.0
    """Share of the force that the policy may exert, as for concent evaluate."""
    port: int = 8080
    """Port of the page; the next free one where it is taken."""
    host: str = "127.0.0.1"
    """Address to serve the page on; 0.0.0.0 lets others open it, whom nothing keeps from using the controls."""
    speed: float = 1.0
    """Speed to begin with, relative to the time in the world."""
    episodes: int | None = None
    """Episodes after which to end; by default when interrupted."""
    states: int = 32
    """Initial states, that episodes begin from in turn."""
    seed: int = 0
    """Seed of the initial states."""
    device: str = "cpu"
    """Warp's name of the device; one world is fastest on the CPU."""
    shapes: ShapeSorterCfg = field(default_factory=ShapeSorterCfg)
    reality: WorldCfg = field(default_factory=WorldCfg)


def run(arguments: Arguments) -> list[str]:
    """Serve until the last episode or an interruption, and return the outcomes."""
    quiet_warp()
    if arguments.states < 1:
        raise TrainError("the number of states is not right", expected="at least 1", found=arguments.states)
    player, drawn = prepared(arguments)
    task = player.environment.task
    from concent_warp.report.live import LiveView

    assert task.model.geometry is not None
    where = {"host": arguments.host, "port": arguments.port}
    view = LiveView(drawn, task.model.geometry, task.collidable, **where, speed=arguments.speed)
    try:
        objects = player.moment().position[list(task.objects)]
        view.look_at(objects.mean(axis=0), AWAY)
        say(f"{view.address} shows it; Ctrl-C ends it")
        try:
            watch(player, view, arguments.episodes)
        except KeyboardInterrupt:
            say("")
    finally:
        view.stop()
    say(counted(player.ended))
    return player.ended


def prepared(arguments: Arguments) -> tuple[Player, mujoco.MjModel]:
    """Return the policy in its world, and the model to draw."""
    import torch

    from concent_warp.train.environment.worlds import make_environment
    from concent_warp.train.learning.ppo import Trainer, load_checkpoint
    from concent_warp.train.policy.play import Player
    from concent_warp.train.run import Run

    if wanted(arguments.hide) and arguments.world == "simulation":
        raise TrainError("effects are hidden in the stand-in world alone", fix="add --world reality")
    path = given_checkpoint(arguments.checkpoint, arguments.pretrained)
    made = evaluate.restrained(Run.load(path.parent), arguments.pace, arguments.force)
    task = made.task()
    states = made.evaluation_states(task, arguments.states, arguments.seed)
    torch.manual_seed(arguments.seed)
    cfg = replace(made.cfg.environment, worlds=1)
    if arguments.world == "reality":
        asked = evaluate.Arguments(hide=arguments.hide, shapes=arguments.shapes, reality=arguments.reality)
        environment = evaluate.real_environment(task, cfg, states, asked)
        drawn = environment.physics.model
    else:
        environment = make_environment(task, cfg, states, device=arguments.device)
        drawn = task.model.scene.model
    trainer = Trainer(environment, made.cfg)
    trainer.algorithm.load(load_checkpoint(path, str(environment.device)), {"actor": True}, True)
    return Player(environment, trainer.policy(), arguments.states), drawn


def watch(player: Player, view: LiveView, episodes: int | None) -> None:
    """Show the policy as the page's controls have it, until so many episodes have ended."""
    wishes, period = view.wishes, player.environment.control_step
    due = time.monotonic()
    show(player, view, player.moment())
    while episodes is None or len(player.ended) < episodes:
        if wishes.reset:
            wishes.reset = False
            player.begin()
            show(player, view, player.moment())
        if not (wishes.running or wishes.step):
            view.changed.wait(IDLE)
            view.changed.clear()
            due = time.monotonic()
            continue
        wishes.step = False
        outcome = player.step()
        if outcome is not None:
            tell(player, view, outcome)
            due += PAUSE / wishes.speed
        due = max(due + period / wishes.speed, time.monotonic())
        wait_until(due, view)
        show(player, view, player.moment())


def wait_until(due: float, view: LiveView) -> None:
    """Wait until a time, or until a control is used."""
    while (left := due - time.monotonic()) > 0:
        if view.changed.wait(left):
            view.changed.clear()
            return


def show(player: Player, view: LiveView, moment: Moment) -> None:
    """Draw a moment and say what it is."""
    view.show(moment.position, moment.quaternion, moment.touching, moment.pairs)
    touching = int(moment.touching.sum())
    view.tell(
        f"**Stage {moment.stage}**, {moment.time:.2f} s  \n"
        f"{touching} of {len(moment.touching)} spheres touch  \n"
        f"{counted(player.ended)}"
    )


def tell(player: Player, view: LiveView, outcome: str) -> None:
    """Say how an episode ended."""
    view.tell(f"**{outcome}**  \n{counted(player.ended)}")


def counted(outcomes: list[str]) -> str:
    """Return how many episodes ended and how, in words."""
    each = ", ".join(f"{count} {name}" for name, count in Counter(outcomes).most_common())
    return f"{len(outcomes)} episode{'s' * (len(outcomes) != 1)}{': ' * bool(outcomes)}{each}"
