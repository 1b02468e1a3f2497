"""``concent events``: the contact event sequence of a recording, replayed in a model."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from concent_warp.cli.given_model import given_model
from concent_warp.cli.options import EngineOption, OutPath
from concent_warp.cli.summary import say_events
from concent_warp.cli.terminal import say_written
from concent_warp.events.cfg import StagingCfg
from concent_warp.events.extract_events import event_paths, extract_events, save_events
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.recording.load import load_recording
from concent_warp.run_folder import claim_file, make_folder


@dataclass(frozen=True)
class Arguments:
    """Replay a recording in a model and extract the contact event sequence: events.json and schedule.png."""

    recording: tyro.conf.Positional[Path]
    """Recording."""
    model: Path
    """Model (.toml) or MJCF (.xml)."""
    out: OutPath = Path()
    """Folder to write to."""
    demonstrations: tuple[str, ...] = ()
    """Demonstrations; all by default. Of several, the files are called events_<demonstration>.json and so on."""
    engine: EngineOption = "mujoco"
    overwrite: bool = False
    """Replace files that are there."""
    staging: StagingCfg = field(default_factory=StagingCfg)


def run(arguments: Arguments) -> dict[str, ContactEventSequence]:
    """Extract and write the files."""
    recording = load_recording(arguments.recording).only(arguments.demonstrations)
    model = given_model(arguments.model, recording)
    for paths in event_paths([d.name for d in recording.demonstrations], arguments.out):
        for path in paths:
            claim_file(path, overwrite=arguments.overwrite)
    found = extract_events(model, recording, arguments.staging, engine=arguments.engine)
    make_folder(arguments.out)
    written = save_events(found, arguments.out)
    say_events(found)
    say_written(*written)
    return found
