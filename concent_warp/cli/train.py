"""``concent train``: a policy from a model and the contact events of a demonstration."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from concent_warp.cli.given_model import given_model
from concent_warp.cli.run_folder import resuming_command, run_folder, write_settings
from concent_warp.cli.terminal import quiet_warp, say, say_written, status_bar
from concent_warp.recording.load import load_recording
from concent_warp.train.cfg import TrainCfg

if TYPE_CHECKING:
    from concent_warp.train.ppo import Round


@dataclass(frozen=True)
class Arguments:
    """Train a policy by reinforcement learning to bring about the contact events of a demonstration.

    Writes the policy with all it was made from to a run folder, and curves for TensorBoard. Ctrl-C loses nothing.
    """

    recording: tyro.conf.Positional[Path]
    """Recording of the demonstration."""
    model: Path
    """Model (.toml), as concent fit writes it."""
    out: Path | None = None
    """Run folder; by default runs/train_<name of the recording>."""
    demonstration: str | None = None
    """Demonstration to train from; the first by default."""
    events: Path | None = None
    """Its contact events (.json); extracted where they are not given."""
    device: str | None = None
    """Warp's name of the device; the first CUDA device by default where there is one."""
    resume: bool = False
    """Go on with an interrupted training, as if it had not stopped."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""
    stage: str | None = None
    """Stage to train; short for --environment.stage."""
    worlds: int | None = None
    """Environments side by side; short for --environment.worlds."""
    reward: Literal["contact", "engineered"] | None = None
    """Reward; short for --environment.reward.kind."""
    collision: Literal["vcp", "full"] | None = None
    """Spheres in the physics; short for --environment.collision."""
    iterations: int | None = None
    """Rounds of training; short for --ppo.iterations."""
    train: Annotated[TrainCfg, tyro.conf.arg(name="")] = field(default_factory=TrainCfg)

    def cfg(self) -> TrainCfg:
        """Return the settings with the short forms put in their places."""
        environment = self.train.environment
        given = {"stage": self.stage, "worlds": self.worlds, "collision": self.collision}
        environment = replace(environment, **{name: value for name, value in given.items() if value is not None})
        if self.reward is not None:
            environment = replace(environment, reward=replace(environment.reward, kind=self.reward))
        ppo = self.train.ppo if self.iterations is None else replace(self.train.ppo, iterations=self.iterations)
        return replace(self.train, environment=environment, ppo=ppo)


def run(arguments: Arguments) -> Round | None:
    """Train and write the run folder."""
    quiet_warp()
    from concent_warp.events.sequence import ContactEventSequence
    from concent_warp.train.run import CHECKPOINT, Run, train

    recording = load_recording(arguments.recording)
    model = given_model(arguments.model, recording)
    folder = arguments.out or Path("runs") / f"train_{arguments.recording.stem}"
    cfg = arguments.cfg()
    events = None if arguments.events is None else ContactEventSequence.load(arguments.events)
    with run_folder(folder, overwrite=arguments.overwrite, resume=arguments.resume):
        write_settings(folder, arguments)
        made = Run.new(model, recording, cfg, demonstration=arguments.demonstration, events=events)
        try:
            with status_bar("training") as update:

                def show(this: Round) -> None:
                    rate = cfg.ppo.steps * cfg.environment.worlds / (this.collecting + this.updating)
                    text = f"{this.steps:,} steps, success {this.log['success']:.1%}, {rate:,.0f} steps/s"
                    left = this.seconds / this.iteration * (cfg.ppo.iterations - this.iteration)
                    update(this.iteration / cfg.ppo.iterations, text, left)

                _, last = train(made, folder, device=arguments.device, resume=arguments.resume, report=show)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"The state is saved; go on with: {resuming_command()}") from None
    if last is None:
        say(f"nothing is left to train: {cfg.ppo.iterations} rounds are done")
    else:
        say(f"{last.steps:,} steps in {last.seconds:.0f} s, success while exploring {last.log['success']:.1%}")
    say_written(folder / CHECKPOINT)
    return last
