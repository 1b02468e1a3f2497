"""``concent suggest``: the motion to record next, so that a diagnosis can decide what it leaves open."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape

from concent_warp.checks import Bounds, Count, Positive, PositiveDuration
from concent_warp.cli.boundary import NOTHING_FOUND
from concent_warp.cli.fitted_effects import work_progress
from concent_warp.cli.given_model import given_model
from concent_warp.cli.given_recording import given_recording
from concent_warp.cli.options import EngineOption, NoiseOption, OutPath
from concent_warp.cli.terminal import say, say_written
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.suggestion.cfg import Method, MotionLimitsCfg, SuggestCfg, TrajectoryCfg
from concent_warp.diagnosis.suggestion.suggest import EVALUATIONS_FILE, suggest, suggestion_json
from concent_warp.diagnosis.suggestion.suggestion import Suggestion, motion_files
from concent_warp.errors import ConcentError
from concent_warp.files import all_or_none, write_text
from concent_warp.report.suggestion.page import write_motion_page
from concent_warp.resumable_file import claim_resumable, say_how_to_resume
from concent_warp.run_folder import claim_file, command_line, lock_folder, make_folder


@dataclass(frozen=True)
class Arguments:
    """Find the motion whose recording decides what a diagnosis leaves open: the effects of a group, or an interval
    that is too wide. It is written as commands that run, within the limits of the recording, with an animation.

    Exit status 3: nothing is open, or no motion within the limits decides it; no file is written.
    """

    recording: tyro.conf.Positional[tuple[Path, ...]]
    """Recording; several of the same scene are taken together."""
    out: OutPath = Path("motion.h5")
    """Motion file to write (.h5), for concent record --motion and concent replay; beside it the commands (.csv) and a
    page with the animation (.html)."""
    model: Path | None = None
    """Model (.toml) or MJCF (.xml); the scene in the recording by default."""
    diagnosis: Path | None = None
    """Diagnosis of this model with this recording: the folder of concent diagnose --out, what its --json printed
    (.json), or the model of its --apply (.toml); without, the model is diagnosed first."""
    demonstrations: tuple[str, ...] = ()
    """Demonstrations; all by default."""
    noise: NoiseOption = ()
    method: Method = SuggestCfg.method
    """Where the motion is looked for: menu (sweeps, reversals, chirps, holds, repetitions, pushes, drops), optimised
    (trajectories whose parameters are searched), best of both, or random (one trajectory, for comparison)."""
    duration: PositiveDuration = SuggestCfg.duration
    """Longest motion [s]."""
    evaluations: Count = SuggestCfg.evaluations
    """Trajectories that are simulated in the search of each kind."""
    population: Annotated[int, Bounds(4, 4096)] = SuggestCfg.population
    """Trajectories in one batch of simulations."""
    max_interval: Positive = SuggestCfg.max_interval
    """Half the 95 % interval of a parameter over its distance from the null value, above which an effect is not known
    well enough [-]."""
    payloads: bool = SuggestCfg.payloads
    """Whether a known weight may be asked for, where no motion without one decides everything."""
    limits: MotionLimitsCfg = field(default_factory=MotionLimitsCfg)
    trajectory: TrajectoryCfg = field(default_factory=TrajectoryCfg)
    engine: EngineOption = "mujoco"
    jobs: Annotated[int, Bounds(-1, 4096, excluded=0)] = -1
    """Processes of the diagnosis at a time; -1: one a CPU."""
    seed: int = 0
    """Seed of all random numbers."""
    json: bool = False
    """Print one JSON object, docs/suggest.md, and nothing else."""
    resume: bool = False
    """Continue an interrupted search; the result is the same as without the interruption."""
    overwrite: bool = False
    """Replace files that are there."""


def run(arguments: Arguments) -> Suggestion:
    """Search, write, and say what was found.

    Raises:
        SystemExit: Nothing is suggested, with the exit status for that.
    """
    if arguments.out.suffix not in (".h5", ".hdf5"):
        raise ConcentError("the motion file has another suffix", where=arguments.out, expected=".h5 or .hdf5")
    folder = arguments.out.with_name(f".{arguments.out.name}.state")
    marker = folder / "command.txt"
    claim_resumable(arguments.out, marker, overwrite=arguments.overwrite, resume=arguments.resume)
    page = arguments.out.with_suffix(".html")
    continued = arguments.resume and marker.is_file()
    for path in (page, *motion_files(arguments.out, 1)[1:]):
        claim_file(path, overwrite=arguments.overwrite or continued)
    recording = given_recording(arguments.recording, arguments.demonstrations, arguments.noise)
    model = given_model(arguments.model, recording)
    cfg = SuggestCfg(
        method=arguments.method,
        duration=arguments.duration,
        evaluations=arguments.evaluations,
        population=arguments.population,
        max_interval=arguments.max_interval,
        payloads=arguments.payloads,
        seed=arguments.seed,
        limits=arguments.limits,
        trajectory=arguments.trajectory,
    )
    if arguments.overwrite and marker.is_file():
        shutil.rmtree(folder)
    make_folder(folder)
    with lock_folder(folder), _discarded_if_empty(folder):
        write_text(marker, f"{command_line()}\n")
        with work_progress("searching") as progress, say_how_to_resume(marker):
            found = suggest(
                model,
                recording,
                cfg,
                diagnosis=arguments.diagnosis,
                diagnose_cfg=DiagnoseCfg(jobs=arguments.jobs, seed=arguments.seed),
                engine=arguments.engine,
                state=folder,
                progress=progress,
            )
        written = []
        if found.found:
            with all_or_none():
                written = [*found.save(arguments.out), page]
                write_motion_page(page, found)
    shutil.rmtree(folder, ignore_errors=True)
    if arguments.json:
        print(suggestion_json(found))
    else:
        _say_suggestion(found)
        for path in written:
            say_written(path)
    if not found.found:
        raise SystemExit(NOTHING_FOUND)
    return found


@contextmanager
def _discarded_if_empty(folder: Path) -> Iterator[None]:
    """Remove the folder of a state after an error within the context, if nothing was saved in it."""
    try:
        yield
    except ConcentError:
        if not (folder / EVALUATIONS_FILE).is_file() and not any((folder / "diagnosis").glob("*.npz")):
            shutil.rmtree(folder, ignore_errors=True)
        raise


def _say_suggestion(found: Suggestion) -> None:
    """Write what is open, what to do, and a table of the evidence between hypotheses."""
    if found.question != found.sentence:
        say(escape(found.question))
    say(f"[bold]{escape(found.sentence)}[/bold]")
    if not found.pairs:
        return
    from rich.table import Table

    table = Table(header_style="bold")
    for name in ("if true", "against", "evidence [nat]", "x noise", ""):
        right = name in ("evidence [nat]", "x noise")
        table.add_column(name, justify="right" if right else "left", overflow="fold")
    for pair in found.pairs:
        cells = [
            pair.true,
            pair.other,
            f"{pair.evidence:.3g}",
            f"{pair.separation:.2g}",
            "decided" if pair.resolved else "open",
        ]
        table.add_row(*map(escape, cells))
    say(table)
    if found.used:
        used = ", ".join(f"{100 * share:.0f} % of the {name}" for name, share in found.used.items())
        say(escape(f"Of its limits it uses {used}."))
