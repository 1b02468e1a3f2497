"""``concent play``: a trained policy at work, live in the browser."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from concent_warp.checks import Count
from concent_warp.cli.given_policy import Pretrained, given_policy
from concent_warp.cli.terminal import say
from concent_warp.deploy.cfg import PlayCfg, WorldName


@dataclass(frozen=True)
class Arguments:
    """Show a trained policy at work, live in the browser.

    Serves a page with robot, objects and the model's contact spheres, those coloured that touch something, and the
    points that the policy is to bring together. It can be paused, stepped, slowed down and restarted. Ctrl-C ends it.
    """

    checkpoint: Path | None = None
    """Run folder of a training, or its checkpoint file."""
    pretrained: Pretrained = None
    """Show a policy that comes with the package, shape_sorter where no name is given."""
    world: WorldName = "simulation"
    """Where the policy acts: in the model that it was trained in, or in Reality."""
    episodes: Count | None = None
    """Episodes after which to end; by default when interrupted."""
    seed: int = 0
    """Seed of the initial states."""
    device: str = "cpu"
    """Where networks and the world are computed: "cpu", which is fastest for one world, or "cuda:0"."""
    cfg: Annotated[PlayCfg, tyro.conf.arg(name="")] = field(default_factory=PlayCfg)


def run(arguments: Arguments) -> list[str]:
    """Serve until the last episode or an interruption, and return the outcomes."""
    policy = given_policy(arguments.checkpoint, arguments.pretrained)
    from concent_warp.deploy.play import outcome_counts_text, play

    ended = play(
        policy,
        arguments.cfg,
        world=arguments.world,
        episodes=arguments.episodes,
        seed=arguments.seed,
        device=arguments.device,
        serving=lambda address: say(f"{address} shows it; Ctrl-C ends it"),
    )
    say(f"\n{outcome_counts_text(ended)}")
    return ended
