"""``concent locate``: where a model lacks forces, by joint and on the objects."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.markup import escape

from concent_warp.checks import WindowLength
from concent_warp.cli.given_model import given_model
from concent_warp.cli.options import EngineOption
from concent_warp.cli.terminal import say, say_written
from concent_warp.diagnosis.forces.cfg import LocateForcesCfg
from concent_warp.diagnosis.forces.locate import locate_forces
from concent_warp.diagnosis.forces.result import UnexplainedForces
from concent_warp.errors import ConcentError
from concent_warp.files import all_or_none
from concent_warp.recording.load import load_recording
from concent_warp.run_folder import claim_file, command_line, make_folder, plain, versions

PICTURES = (".png", ".pdf", ".svg", ".jpg", ".jpeg")
"""Suffixes of the pictures that --png writes."""


@dataclass(frozen=True)
class Arguments:
    """Find where a model lacks forces: by joint, with what they depend on, and on the objects, with the place."""

    recording: tyro.conf.Positional[Path]
    """Recording."""
    model: Path | None = None
    """Model (.toml) or MJCF (.xml); the scene in the recording by default."""
    demonstrations: tuple[str, ...] = ()
    """Demonstrations; all by default."""
    engine: EngineOption = "mujoco"
    window: WindowLength | None = None
    """Time over which forces are averaged [s]; 0.1 s for joints, 0.12 s with objects, more where readings are rare, by
    default."""
    json: bool = False
    """Print one JSON object with all figures in SI units instead of sentences."""
    html: Path | None = None
    """Write a report with the objects and the forces on them in 3D to this file."""
    png: Path | None = None
    """Write a picture of the objects and the forces to this file."""
    overwrite: bool = False
    """Replace files that are there."""


def run(arguments: Arguments) -> UnexplainedForces:
    """Locate, and print or write what was asked for."""
    recording = load_recording(arguments.recording).only(arguments.demonstrations)
    model = given_model(arguments.model, recording)
    if arguments.png is not None and arguments.png.suffix not in PICTURES:
        expected = f"one of {', '.join(PICTURES)}"
        raise ConcentError("unknown kind of picture", where=arguments.png, expected=expected, fix="change its suffix")
    for path in (arguments.html, arguments.png):
        if path is not None:
            claim_file(path, overwrite=arguments.overwrite)
    found = locate_forces(model, recording, LocateForcesCfg(arguments.window), engine=arguments.engine)
    if arguments.json:
        print(json.dumps(found.to_json(), indent=1, allow_nan=False))
    else:
        for sentence in found.sentences():
            say(escape(sentence))
    written = []
    with all_or_none():
        if arguments.png is not None:
            from concent_warp.diagnosis.forces.plot import plot_location

            make_folder(arguments.png.parent)
            plot_location(found, model, arguments.png)
            written.append(arguments.png)
        if arguments.html is not None:
            from concent_warp.comparison.compare import compare_replays
            from concent_warp.report.report import write_report

            models = {"model": model}
            settings = {"command": command_line(), "versions": versions(), "settings": plain(arguments)}
            make_folder(arguments.html.parent)
            compared = compare_replays(models, recording, arguments.engine)
            write_report(arguments.html, recording, compared, settings=settings, location=found.to_json())
            written.append(arguments.html)
    if written and not arguments.json:
        say_written(*written)
    return found
