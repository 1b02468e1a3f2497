"""``concent train``: a policy from a model and the contact events of a demonstration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from concent_warp.checks import Count, Worlds
from concent_warp.cli.given_model import given_model
from concent_warp.cli.given_policy import check_policy, given_policy
from concent_warp.cli.options import DeviceOption, OptionalOutPath
from concent_warp.cli.terminal import quiet_warp, say, say_written, status_bar
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.recording.load import load_recording
from concent_warp.run_folder import check_run_folder, processes
from concent_warp.train.cfg import LAST, TrainCfg

if TYPE_CHECKING:
    from concent_warp.train.learning.ppo import Iteration
    from concent_warp.train.policy.load import Policy


@dataclass(frozen=True)
class Arguments:
    """Train a policy by reinforcement learning to bring about the contact events of a demonstration.

    Writes the policy with all it was made from to a run folder, and curves for TensorBoard. Ctrl-C loses nothing.
    On N GPUs: torchrun --nproc-per-node N -m concent_warp train ..., each with --worlds of its own.
    """

    recording: tyro.conf.Positional[Path]
    """Recording of the demonstration."""
    model: Path
    """Model (.toml), as concent fit writes it."""
    out: OptionalOutPath = None
    """Run folder; by default runs/train_<name of the recording>."""
    demonstration: str | None = None
    """Demonstration to train from; the first by default."""
    events: Path | None = None
    """Its contact events (.json); extracted where they are not given."""
    begin_with: Path | None = None
    """Policy to start from: a run folder of a training or its checkpoint file. By default weights are random."""
    device: DeviceOption = None
    resume: bool = False
    """Continue an interrupted training, as if it had not stopped."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""
    stage: str | None = None
    """Stage to train; last, the default, for the last one, all for the chain of all, for which some other options have
    other defaults; short for --environment.stage."""
    worlds: Worlds | None = None
    """Parallel environments; short for --environment.worlds."""
    reward: Literal["contact", "engineered"] | None = None
    """Reward; short for --environment.reward.kind."""
    collision: Literal["vcp", "full"] | None = None
    """Spheres in the physics; short for --environment.collision."""
    seeds: Count = 1
    """Policies to train, one after the other; the one that does best in the stress test is kept."""
    iterations: Count | None = None
    """Iterations of PPO; short for --ppo.iterations."""
    train: Annotated[TrainCfg, tyro.conf.arg(name="")] = field(default_factory=TrainCfg)

    @classmethod
    def default(cls, given: Sequence[str]) -> Arguments:
        """Return the defaults of the options, which depend on the stage that some of the given ones name."""
        return cls(recording=tyro.MISSING, model=tyro.MISSING, train=TrainCfg.for_stage(given_stage(given)))

    def cfg(self) -> TrainCfg:
        """Return the settings with the short forms put in their places."""
        environment = self.train.environment
        given = {"stage": self.stage, "worlds": self.worlds, "collision": self.collision}
        environment = replace(environment, **{name: value for name, value in given.items() if value is not None})
        if self.reward is not None:
            environment = replace(environment, reward=replace(environment.reward, kind=self.reward))
        ppo = self.train.ppo if self.iterations is None else replace(self.train.ppo, iterations=self.iterations)
        return replace(self.train, environment=environment, ppo=ppo)


def given_stage(options: Sequence[str]) -> str:
    """Return the stage that options name, the last one by default; ``--stage`` has precedence."""
    words = [part for option in options for part in option.split("=", 1)]
    named = {name: value for name, value in pairwise(words) if name in ("--stage", "--environment.stage")}
    return named.get("--stage", named.get("--environment.stage", LAST))


def status(this: Iteration, cfg: TrainCfg) -> str:
    """Return what the progress of a training says of an iteration, counted over all seeds."""
    finishing = (this.iteration - 1) % cfg.ppo.iterations >= cfg.finish_from
    return f"{'finish, ' * finishing}{this.steps:,} steps, success {this.log['success']:.1%}, {this.rate:,.0f} steps/s"


def run(arguments: Arguments) -> Policy:
    """Train and write the run folder, one of several processes where torchrun started them."""
    folder = arguments.out or Path("runs") / f"train_{arguments.recording.stem}"
    if processes()[1] > 1:
        from concent_warp.train.learning.distributed import DistributedProcess

        DistributedProcess.from_environment().device(arguments.device)  # more processes than GPUs are refused here
    else:
        check_run_folder(folder, overwrite=arguments.overwrite, resume=arguments.resume)
    if arguments.begin_with is not None:
        check_policy(arguments.begin_with, None)
    recording = load_recording(arguments.recording)
    model = given_model(arguments.model, recording)
    events = None if arguments.events is None else ContactEventSequence.load(arguments.events)
    quiet_warp()
    from concent_warp.train.learning.ppo import CHECKPOINT
    from concent_warp.train.several_seeds import SEEDS_FILE
    from concent_warp.train.train import train

    begin_with = None if arguments.begin_with is None else given_policy(arguments.begin_with, None)
    cfg = arguments.cfg()
    last: Iteration | None = None
    total = arguments.seeds * cfg.ppo.iterations
    with status_bar("training") as update:

        def progress(this: Iteration) -> None:
            nonlocal last
            last = this
            update(this.iteration / total, status(this, cfg), this.seconds / this.iteration * (total - this.iteration))

        policy = train(
            model,
            recording,
            cfg,
            seeds=arguments.seeds,
            events=events,
            demonstration=arguments.demonstration,
            begin_with=begin_with,
            device=arguments.device,
            out=folder,
            resume=arguments.resume,
            overwrite=arguments.overwrite,
            progress=progress,
        )
    if last is None:
        say(f"nothing is left to train: {total} iterations are done")
    else:
        say(f"{last.steps:,} steps in {last.seconds:.0f} s, success while exploring {last.log['success']:.1%}")
    if policy.stress is not None:
        successes, episodes = policy.stress
        say(f"stress test: {successes} of {episodes} succeed under the best policy, which is the one that is kept")
        if arguments.seeds > 1:
            say(f"its seed is {policy.run.cfg.seed}; {SEEDS_FILE} has the results of all")
    say_written(folder / CHECKPOINT)
    return policy
