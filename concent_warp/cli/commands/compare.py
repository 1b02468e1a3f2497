"""``concent compare``: how far a model is off, or what a change of it has gained."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.markup import escape

from concent_warp.cli.given_model import given_model
from concent_warp.cli.given_recording import given_recording
from concent_warp.cli.options import EngineOption, NoiseOption
from concent_warp.cli.summary import say_diverged
from concent_warp.cli.terminal import say, say_written, table_width
from concent_warp.comparison.compare import CompareCfg, compare
from concent_warp.comparison.result import Comparison
from concent_warp.comparison.table import markdown_table, rich_table
from concent_warp.comparison.worst_spans import span_kind
from concent_warp.estimation.noise import WORDS
from concent_warp.run_folder import claim_file, command_line, make_folder, plain, versions


@dataclass(frozen=True)
class Arguments:
    """Compare what a model predicts with what was measured: by channel and phase, against the measurement noise, and
    where it fails worst; with a baseline, say what has changed. Where the recording does not state the initial state,
    a replay starts from one that is fitted to the first readings.
    """

    recording: tyro.conf.Positional[Path]
    """Recording."""
    model: Path | None = None
    """Model (.toml) or MJCF (.xml); the scene in the recording by default."""
    baseline: Path | None = None
    """Model to compare it with."""
    demonstrations: tuple[str, ...] = ()
    """Demonstrations; all by default."""
    noise: NoiseOption = ()
    engine: EngineOption = "mujoco"
    json: bool = False
    """Print one JSON object with all figures in SI units instead of the table."""
    markdown: bool = False
    """Print the table as Markdown."""
    every_phase: bool = False
    """Show phases for joints and other sensors too, not only for bodies."""
    html: Path | None = None
    """Write a report with charts, replay and 3D views to this file."""
    phases: Literal["auto", "motion", "none"] = "auto"
    """How time is divided: auto takes the contact stages of a task found in the replay of the model and, without any,
    phases of motion."""
    places: int = 5
    """How many of the worst spans to name."""
    overwrite: bool = False
    """Replace the report if it is there."""


def run(arguments: Arguments) -> Comparison:
    """Compare, and print or write what was asked for."""
    recording = given_recording(arguments.recording, arguments.demonstrations, arguments.noise)
    models = {} if arguments.baseline is None else {"baseline": given_model(arguments.baseline, recording)}
    models["model"] = given_model(arguments.model, recording)
    if arguments.html is not None:
        claim_file(arguments.html, overwrite=arguments.overwrite)
    found = compare(models, recording, CompareCfg(arguments.phases), engine=arguments.engine)
    for remark in found.remarks:
        say(escape(remark))
    if arguments.json:
        print(json.dumps(found.to_json(), indent=1, allow_nan=False))
    elif arguments.markdown:
        print(markdown_table(found, every_phase=arguments.every_phase), end="")
        print("".join(f"\n{sentence}" for sentence in found.tolerance_sentences()))
        print("".join(f"\n{i + 1}. {text}" for i, text in enumerate(_place_lines(found, arguments.places))))
    else:
        say(rich_table(found, every_phase=arguments.every_phase, width=table_width()))
        _say_noise(found)
        for sentence in found.tolerance_sentences():
            say(escape(sentence))
        _say_places(found, arguments.places)
        say_diverged(found)
    if arguments.html is not None:
        from concent_warp.report.report import write_report

        settings = {"command": command_line(), "versions": versions(), "settings": plain(arguments)}
        make_folder(arguments.html.parent)
        write_report(arguments.html, recording, found, settings=settings)
        if not arguments.json:
            say_written(arguments.html)
    return found


def _say_noise(comparison: Comparison) -> None:
    """Write where the noise floors are from."""
    found: dict[str, list[str]] = {}
    for channel in comparison.channels:
        found.setdefault(WORDS[comparison.summarise(comparison.after, channel).source], []).append(channel)
    (most, _), *others = sorted(found.items(), key=lambda item: -len(item[1]))
    lines = [f"noise: {most}", *(f"noise of {', '.join(channels)}: {words}" for words, channels in others)]
    say(escape("\n".join(lines)))


def _say_places(comparison: Comparison, most: int) -> None:
    """Write where the last model fails worst."""
    lines = _place_lines(comparison, most)
    if most > 0:
        say("\n[bold]Worst spans[/bold]" if lines else f"\nNowhere above {comparison.span_cfg.min_ratio:g} x noise.")
    for i, line in enumerate(lines):
        say(escape(f"{i + 1}. {line}"))


def _place_lines(comparison: Comparison, most: int) -> list[str]:
    """Return the worst spans in words, one for each that recurs in several demonstrations."""
    several = len(comparison.demonstrations) > 1
    lines, seen = [], set()
    for place in comparison.worst_spans:
        if span_kind(place) not in seen and len(lines) < most:
            seen.add(span_kind(place))
            line = place.sentence(demonstration=several)
            lines.append(line + (f" [{place.recurs} demonstrations alike]" if place.recurs > 1 else ""))
    return lines
