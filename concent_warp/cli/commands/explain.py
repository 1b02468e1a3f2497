"""``concent explain``: why trials of a policy failed: perception, physics, or the policy itself."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.markup import escape

from concent_warp.cli.fitted_effects import work_progress
from concent_warp.cli.options import OptionalOutPath
from concent_warp.cli.terminal import quiet_warp, say, say_written
from concent_warp.deploy.explain.cfg import ExplainCfg
from concent_warp.errors import RecordingError
from concent_warp.recording.load import load_recording
from concent_warp.run_folder import check_folder, claim_file, command_line, make_folder, plain, versions

if TYPE_CHECKING:
    from concent_warp.deploy.explain.result import Explanation
    from concent_warp.recording.recording import Recording
    from concent_warp.train.policy.load import Policy

TRIALS = "trials.h5"
"""The recording in a folder of concent evaluate --record."""


@dataclass(frozen=True)
class Arguments:
    """Find why trials of a policy failed: the objects were not where the tracker shows them (perception), the world
    moved otherwise than the model (physics, with the missing effect), or the policy fails in its own simulation too.
    """

    policy: tyro.conf.Positional[str]
    """Run folder of a training, a checkpoint file in it, or the name of a pretrained policy, such as shape_sorter."""
    trials: tyro.conf.Positional[tuple[Path, ...]]
    """Recordings of trials, or folders of concent evaluate --record. Trials not marked successful count as failed."""
    html: Path | None = None
    """Write a page with causes, evidence and the replay of each trial to this file."""
    json: bool = False
    """Print one JSON object, docs/explain.md, and nothing else."""
    out: OptionalOutPath = None
    """Folder for the result and for finished parts, from which the same command continues after an interruption."""
    action_scale: float = 1.0
    """Size of command steps relative to training in the trials, as in concent evaluate."""
    setpoint_lead_scale: float = 1.0
    """Largest difference of command and joint position relative to training, as in concent evaluate."""
    overwrite: bool = False
    """Replace what --html names if it is there."""
    cfg: Annotated[ExplainCfg, tyro.conf.arg(name="")] = field(default_factory=ExplainCfg)


def run(arguments: Arguments) -> Explanation:
    """Explain, and print or write what was asked for."""
    if not arguments.trials:
        raise RecordingError("no trials are given", expected="recordings, or folders of concent evaluate --record")
    if arguments.out is not None:
        check_folder(arguments.out)
    if arguments.html is not None:
        claim_file(arguments.html, overwrite=arguments.overwrite)
    recordings = [load_recording(path / TRIALS if (path / TRIALS).is_file() else path) for path in arguments.trials]
    quiet_warp()
    from concent_warp.train.policy.load import load_policy

    policy = load_policy(arguments.policy).scaled(arguments.action_scale, arguments.setpoint_lead_scale)
    found = _explained(arguments, policy, recordings)
    if arguments.json:
        print(json.dumps(found.to_json(), indent=1, allow_nan=False))
    else:
        _say(found)
    if arguments.html is not None:
        from concent_warp.deploy.explain.page import write_explanation

        make_folder(arguments.html.parent)
        settings = {"command": command_line(), "versions": versions(), "settings": plain(arguments)}
        write_explanation(arguments.html, policy, recordings, found, settings=settings)
        if not arguments.json:
            say_written(arguments.html)
    return found


def _explained(arguments: Arguments, policy: Policy, recordings: list[Recording]) -> Explanation:
    """Return the explanation; an interruption says how to continue."""
    from concent_warp.deploy.explain.explain import explain

    try:
        with work_progress("explaining", None) as progress:
            return explain(policy, recordings, arguments.cfg, out=arguments.out, progress=progress)
    except KeyboardInterrupt:
        advice = f"Finished parts are kept; continue with: {command_line()}"
        if arguments.out is None:
            advice = "With --out FOLDER the same command would continue the search for an effect from here."
        raise KeyboardInterrupt(advice) from None


def _say(found: Explanation) -> None:
    """Write the cause, its evidence, the trials, and what mends it."""
    say(f"[bold]{escape(found.headline[0].upper() + found.headline[1:])}[/bold]")
    for sentence in found.sentences():
        say(escape(sentence))
    say("\n[bold]Trial by trial[/bold]")
    for trial in found.trials:
        say(escape(f"{trial.name}: {trial.sentence}"))
    say("\n[bold]What mends it[/bold]")
    for line in found.remedy:
        say(escape(line))
