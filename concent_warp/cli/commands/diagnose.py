"""``concent diagnose``: which physical effect a model lacks, how sure that is, or why none can be named."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape

from concent_warp.checks import Bounds, PositiveDuration, WindowLength
from concent_warp.cli.fitted_effects import value_and_interval, work_progress
from concent_warp.cli.given_model import given_model
from concent_warp.cli.given_recording import given_recording
from concent_warp.cli.options import EngineOption, NoiseOption, OptionalOutPath
from concent_warp.cli.terminal import say, say_written
from concent_warp.comparison.compare import compare_replays
from concent_warp.diagnosis.candidates.candidates import candidates
from concent_warp.diagnosis.candidates.screening import FIRST_RANKING
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import EXPERIMENT_FILE, diagnose
from concent_warp.diagnosis.result import Diagnosis, Finding
from concent_warp.errors import ModelError
from concent_warp.files import all_or_none
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from concent_warp.run_folder import claim_file, command_line, make_folder, plain, versions

MOST_PARAMETERS = 2
"""Parameters of an effect that the table shows, those that exclude no change first."""
MOST_PLACES = 3
"""Places that are named below the verdict."""


@dataclass(frozen=True)
class Arguments:
    """Find which physical effect a model lacks to follow a recording: screen all effects of the library, fit the most
    promising ones, judge them on held-out data against what chance makes of the whole search, add the best, repeat.
    """

    recording: tyro.conf.Positional[tuple[Path, ...]]
    """Recording; several of the same scene are taken together."""
    model: Path | None = None
    """Model (.toml) or MJCF (.xml); the scene in the recording by default."""
    demonstrations: tuple[str, ...] = ()
    """Demonstrations; all by default."""
    noise: NoiseOption = ()
    effects: tuple[str, ...] = ()
    """Effects to consider; all by default. "concent add --list" lists them."""
    json: bool = False
    """Print one JSON object, docs/diagnose.md, and nothing else."""
    html: Path | None = None
    """Write a report with the diagnosis, charts, replay and 3D views to this file."""
    apply: Path | None = None
    """Save the model with all accepted effects, fitted together with intervals, to this file (.toml)."""
    window: WindowLength | None = None
    """Length of the windows that are simulated in one go [s]; by default as long as the motion allows."""
    additions: Annotated[int, Bounds(1, 1000)] = 3
    """Most effects that are added."""
    gradient: bool = False
    """Let fits of friction, mass and contact stiffness start from where gradients through Newton lead, where that is
    better; needs contact geometry and observed objects."""
    engine: EngineOption = "mujoco"
    jobs: Annotated[int, Bounds(-1, 4096, excluded=0)] = -1
    """Processes at a time; -1: one a CPU."""
    seconds: PositiveDuration | None = None
    """Time after which the best answer so far is given with what is not settled [s]; by default as long as it takes."""
    seed: int = 0
    """Seed of all random numbers."""
    out: OptionalOutPath = None
    """Folder for finished parts, from which the same command continues after an interruption, for the diagnosis
    (diagnosis.json), and for the motion of the suggested experiment."""
    overwrite: bool = False
    """Replace what --html and --apply name if it is there."""


def run(arguments: Arguments) -> Diagnosis:
    """Diagnose, and print or write what was asked for."""
    recording = given_recording(arguments.recording, arguments.demonstrations, arguments.noise)
    model = given_model(arguments.model, recording)
    _check_effects(model, recording, arguments.effects)
    for path in (arguments.html, arguments.apply):
        if path is not None:
            claim_file(path, overwrite=arguments.overwrite)
    found = _diagnosed(arguments, model, recording)
    if arguments.json:
        print(json.dumps(found.to_json(), indent=1, allow_nan=False))
    else:
        _say_diagnosis(found)
    if arguments.out is not None and found.next_experiment is not None and not arguments.json:
        say_written(arguments.out / EXPERIMENT_FILE)
    with all_or_none():
        _save_accepted(arguments, found)
        _write_report(arguments, found, recording)
    if not arguments.json:
        for path in (arguments.apply if found.changes_model else None, arguments.html):
            if path is not None:
                say_written(path)
    return found


def _check_effects(model: Model, recording: Recording, names: Sequence[str]) -> None:
    """Check that each of the effects asked for could be missing.

    Raises:
        ModelError: There is no such effect, the model has it, or it has nothing to act on.
    """
    channels = {c for d in recording.demonstrations for c in d.measured}
    for name in names:
        if not candidates(model, channels, [name]):
            raise ModelError(
                f"{name} cannot be missing: the model has it, or nothing in model and recording that it acts on",
                where=model.scene.source,
                fix="leave it out of --effects",
            )


def _diagnosed(arguments: Arguments, model: Model, recording: Recording) -> Diagnosis:
    """Return the diagnosis; an interruption says how to continue."""
    cfg = DiagnoseCfg(
        effects=arguments.effects,
        window=arguments.window,
        max_additions=arguments.additions,
        gradient=arguments.gradient,
        jobs=arguments.jobs,
        seconds=arguments.seconds,
        seed=arguments.seed,
    )
    try:
        with work_progress("diagnosing", arguments.seconds) as progress:

            def show(share: float, text: str) -> None:
                progress(share, f"{text}\n" if text.startswith(FIRST_RANKING) else text)

            return diagnose(model, recording, cfg, engine=arguments.engine, out=arguments.out, progress=show)
    except KeyboardInterrupt:
        advice = f"Finished parts are kept; continue with: {command_line()}"
        if arguments.out is None:
            advice = "With --out FOLDER the same command would continue from here."
        raise KeyboardInterrupt(advice) from None


def _say_diagnosis(found: Diagnosis) -> None:
    """Write the verdict in sentences, where the model fails, and the table of effects."""
    say(f"[bold]{escape(found.headline.capitalize())}[/bold]")
    for sentence in found.sentences():
        say(escape(sentence))
    places = [str(place["sentence"]) for place in found.where if place.get("sentence")]
    if places:
        say("\n[bold]Where the model as given fails[/bold]")
        for k, sentence in enumerate(places[:MOST_PLACES]):
            say(escape(f"{k + 1}. {sentence}"))
    if found.effects:
        _say_effects(found.effects, "best so far" if found.verdict == "unsettled" else "accepted")


def _say_effects(effects: Sequence[Finding], accepted: str) -> None:
    """Write the table of all effects that were fitted, addition by addition, the best first.

    Args:
        effects: The effects.
        accepted: What is said of those that were accepted.
    """
    from rich.table import Table

    table = Table(header_style="bold")
    for name in ("", "effect and its parameters [95 %]", "held-out gain", "p"):
        table.add_column(name, justify="right" if name in ("held-out gain", "p") else "left")
    ranked = sorted(effects, key=lambda f: (f.step, not f.accepted, -f.gain))
    for k, f in enumerate(ranked):
        last = k + 1 == len(ranked) or ranked[k + 1].step != f.step
        first = k == 0 or ranked[k - 1].step != f.step
        verdict = accepted if f.accepted else f.reason
        shown = sorted(f.parameters, key=lambda p: not p.excludes_null)[:MOST_PARAMETERS]
        several = len(f.parameters) > 1
        lines = [f"{f.name}: {verdict}", *(f"  {value_and_interval(p, owner=several)}" for p in shown)]
        if len(f.parameters) > len(shown):
            lines.append(f"  {len(f.parameters) - len(shown)} more")
        cells = [
            str(f.step + 1) if first else "",
            "\n".join(lines),
            f"{100 * f.gain:.0f} % [{100 * f.low:.0f}, {100 * f.high:.0f}]",
            f.p_text.removeprefix("p ").removeprefix("= "),
        ]
        table.add_row(*map(escape, cells), end_section=last, style="bold" if f.accepted else None)
    say(table)


def _save_accepted(arguments: Arguments, found: Diagnosis) -> None:
    """Save the model with all accepted effects; say so where none was accepted, or those explain too little."""
    path = arguments.apply
    if path is None:
        return
    if not found.changes_model:
        if not arguments.json:
            why = "The accepted effects explain too little" if found.accepted else "No effect was accepted"
            why = "What was fitted makes a replay no better" if found.farther else why
            say(escape(f"{why}: {path} was not written."))
        return
    make_folder(path.parent)
    found.model.save(path)


def _write_report(arguments: Arguments, found: Diagnosis, recording: Recording) -> None:
    """Write the report that is asked for."""
    if arguments.html is None:
        return
    from concent_warp.report.report import write_report

    models = {"model": found.models[0]}
    if found.changes_model:
        models = {"before": found.models[0], "after": found.model}
    comparison = compare_replays(models, recording, arguments.engine, seed=arguments.seed)
    settings = {"command": command_line(), "versions": versions(), "settings": plain(arguments)}
    make_folder(arguments.html.parent)
    write_report(arguments.html, recording, comparison, settings=settings, diagnosis=found.to_json())
