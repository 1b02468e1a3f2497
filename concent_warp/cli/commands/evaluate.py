"""``concent evaluate``: how often a trained policy succeeds, in simulation and in Reality."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from concent_warp.checks import Bounds
from concent_warp.cli.given_policy import Pretrained, check_flow_policy, given_flow_policy, given_policy_or_student
from concent_warp.cli.options import DeviceOption, OptionalOutPath
from concent_warp.cli.terminal import progress_bar, say, say_written
from concent_warp.deploy.cfg import EvaluateCfg, TrialName, check_evaluation
from concent_warp.errors import TrainError
from concent_warp.reality.hidden.in_task import parse_effects
from concent_warp.run_folder import check_folder, make_folder

if TYPE_CHECKING:
    from concent_warp.train.trials.evaluate import Evaluation


@dataclass(frozen=True)
class Arguments:
    """Run a trained policy from many initial states that it was not trained from, and count successes.

    In Reality shapes are exact, friction cones elliptic and time steps fine; the policy has encountered none of it.
    """

    checkpoint: Path | None = None
    """Run folder of a training, of a student that sees or of a flow policy, or its checkpoint file."""
    pretrained: Pretrained = None
    """Run a policy that comes with the package, shape_sorter where no name is given."""
    task_of: str | None = None
    """Policy whose task a flow policy is to do: a run folder of concent train, or one that comes with the package."""
    instruction: str | None = None
    """What a flow policy is told; the demonstration's task by default."""
    world: Literal["simulation", "stress", "reality", "both", "all"] = "both"
    """Where to run the policy: simulation as in training, the same under worse conditions (stress), Reality, both
    simulation and Reality, or all three."""
    episodes: Annotated[int, Bounds(1, 1_000_000)] = 200
    """Initial states, of which each is run once in each world."""
    seed: int = 0
    """Seed of the initial states."""
    out: OptionalOutPath = None
    """Folder for the videos; by default the folder videos in the run folder, of a pretrained policy here."""
    record: Path | None = None
    """Folder for a recording of the trials in Reality, as instruments and tracker show them, for concent explain."""
    overwrite: bool = False
    """Replace videos and recordings that are there."""
    json: bool = False
    """Print one JSON object with the outcome of every episode instead of sentences."""
    device: DeviceOption = None
    cfg: Annotated[EvaluateCfg, tyro.conf.arg(name="")] = field(default_factory=EvaluateCfg)


def run(arguments: Arguments) -> dict[str, Evaluation]:
    """Evaluate and print."""
    cfg = arguments.cfg
    several: dict[str, tuple[TrialName, ...]] = {
        "both": ("simulation", "reality"),
        "all": ("simulation", "stress", "reality"),
    }
    worlds = several[arguments.world] if arguments.world in ("both", "all") else (arguments.world,)
    check_evaluation(cfg, worlds[-1], arguments.episodes, record=arguments.record is not None)
    for folder in (arguments.out, arguments.record):
        if folder is not None:
            check_folder(folder)
    if arguments.instruction is not None and arguments.task_of is None:
        raise TrainError("an instruction is for flow policies", expected="--task-of", found=arguments.instruction)
    if check_flow_policy(arguments.checkpoint, arguments.task_of):
        assert arguments.checkpoint is not None
        assert arguments.task_of is not None
        policy = given_flow_policy(arguments.checkpoint, arguments.task_of, arguments.instruction, arguments.device)
    else:
        policy = given_policy_or_student(arguments.checkpoint, arguments.pretrained)
    if arguments.out is not None and cfg.videos:
        make_folder(arguments.out)
    from concent_warp.deploy.evaluate import evaluate, without_reality

    found: dict[str, Evaluation] = {}
    for world in worlds:
        with progress_bar(world) as progress:
            found[world] = evaluate(
                policy,
                cfg if world == "reality" else without_reality(cfg),
                world=world,
                episodes=arguments.episodes,
                seed=arguments.seed,
                device=arguments.device,
                out=arguments.out,
                record=arguments.record if world == "reality" else None,
                overwrite=arguments.overwrite,
                progress=progress,
            )
        if not arguments.json:
            hidden = f" with {', '.join(cfg.hide)} hidden in it" if cfg.hide and world == "reality" else ""
            say(f"{world}{hidden}: {found[world].sentence()}")
            if found[world].videos:
                say_written(*found[world].videos)
            if (recorded := found[world].recorded) is not None:
                say_written(recorded)
    if arguments.json:
        named = str(arguments.checkpoint) if arguments.pretrained is None else f"pretrained {arguments.pretrained}"
        document: dict[str, Any] = {
            "checkpoint": named,
            "seed": arguments.seed,
            "hidden": dict(parse_effects(cfg.hide)),
        }
        document |= {"action_scale": cfg.action_scale, "setpoint_lead_scale": cfg.setpoint_lead_scale}
        document["worlds"] = {name: evaluation.to_json() for name, evaluation in found.items()}
        print(json.dumps(document, indent=1, allow_nan=False))
    return found
