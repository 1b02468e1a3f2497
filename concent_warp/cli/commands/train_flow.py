"""``concent train-flow``: a policy from cameras and an instruction to actions, from a LeRobot data set."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from concent_warp.cli.options import DeviceOption, OutPath
from concent_warp.cli.terminal import say, say_written, status_bar
from concent_warp.run_folder import check_run_folder
from concent_warp.train.flow.cfg import Backbone, TrainFlowCfg, check_train_cfg

if TYPE_CHECKING:
    from concent_warp.train.flow.policy import FlowPolicy
    from concent_warp.train.flow.train_flow import FlowProgress


@dataclass(frozen=True)
class Arguments:
    """Train a policy from images, proprioception and text to chunks of actions, on a LeRobot v3 data set.

    Cameras, state, actions and instructions are found in the data set; concent render and concent export write one.
    Writes the policy to a run folder, with curves for TensorBoard. Ctrl-C loses nothing.
    """

    dataset: tyro.conf.Positional[tuple[Path, ...]]
    """Folder of the data set, or folders of several."""
    out: OutPath = Path("runs/flow")
    """Run folder."""
    cameras: tuple[str, ...] = ()
    """Cameras to learn from; all of the data set by default."""
    backbone: Backbone | None = None
    """Encoder of images and text: small, the default, starts from random weights; florence2 needs --weights. Short for
    --policy.backbone."""
    weights: Path | None = None
    """Folder with Florence-2 in the format of transformers; short for --policy.weights."""
    device: DeviceOption = None
    resume: bool = False
    """Continue an interrupted training, as if it had not stopped."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""
    train: Annotated[TrainFlowCfg, tyro.conf.arg(name="")] = field(default_factory=TrainFlowCfg)

    def cfg(self) -> TrainFlowCfg:
        """Return the settings with the short forms put in their places."""
        train, policy = self.train, self.train.policy
        if self.backbone is not None:
            policy = replace(policy, backbone=self.backbone)
        if self.weights is not None:
            policy = replace(policy, weights=self.weights)
        data = replace(train.data, cameras=self.cameras) if self.cameras else train.data
        return replace(train, policy=policy, data=data)


def run(arguments: Arguments) -> FlowPolicy:
    """Train and write the run folder."""
    check_run_folder(arguments.out, overwrite=arguments.overwrite, resume=arguments.resume)
    cfg = arguments.cfg()
    check_train_cfg(cfg)
    from concent_warp.train.flow.policy import POLICY
    from concent_warp.train.flow.train_flow import train_flow

    last: FlowProgress | None = None
    with ExitStack() as bars:
        shown: dict[str, Callable[[float, str, float | None], None]] = {}

        def progress(this: FlowProgress) -> None:
            nonlocal last
            last = this
            if this.work not in shown:
                bars.close()
                shown[this.work] = bars.enter_context(status_bar(this.work))
            step = this.step
            if step is None:
                shown[this.work](this.share, "", None)
                return
            text = f"{step.done:,} steps, loss {step.loss:.4f}"
            text += "" if step.validation is None else f", validation {step.validation:.4f}"
            shown[this.work](this.share, text, step.left)

        policy = train_flow(
            arguments.dataset,
            cfg,
            device=arguments.device,
            out=arguments.out,
            resume=arguments.resume,
            overwrite=arguments.overwrite,
            progress=progress,
        )
    found = policy.features
    say(f"cameras {', '.join(found.cameras)}; {len(found.state)} numbers of state, {len(found.action)} of action")
    say(f"instructions: {len(found.tasks)}; {found.rate:g} actions a second")
    if last is None or last.step is None:
        say(f"nothing is left to train: {cfg.steps} steps are done")
    elif last.step.validation is not None:
        say(f"loss {last.step.loss:.4f}, in episodes kept for validation {last.step.validation:.4f}")
    say_written(arguments.out / POLICY)
    return policy
