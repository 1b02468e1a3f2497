"""``concent replay``: what a model predicts for the commands of a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from concent_warp.cli.given_model import given_model
from concent_warp.cli.options import EngineOption, OutPath
from concent_warp.cli.terminal import say, say_written
from concent_warp.recording.load import load_recording
from concent_warp.run_folder import claim_file, make_folder
from concent_warp.simulate.replay_recording import replay, rollout_path


@dataclass(frozen=True)
class Arguments:
    """Replay the commands of a recording in a model and save states, sensors, body poses and contacts."""

    recording: tyro.conf.Positional[Path]
    """Recording."""
    model: Path
    """Model (.toml) or MJCF (.xml)."""
    out: OutPath = Path("rollout.npz")
    """File to write; of several demonstrations, rollout_<demonstration>.npz."""
    demonstrations: tuple[str, ...] = ()
    """Demonstrations to replay; all by default."""
    engine: EngineOption = "mujoco"
    overwrite: bool = False
    """Replace files that are there."""


def run(arguments: Arguments) -> list[Path]:
    """Replay and write a file for each demonstration."""
    recording = load_recording(arguments.recording).only(arguments.demonstrations)
    model = given_model(arguments.model, recording)
    paths = {d.name: rollout_path(arguments.out, recording, d.name) for d in recording.demonstrations}
    for path in paths.values():
        claim_file(path, overwrite=arguments.overwrite)
    make_folder(arguments.out.parent)
    for name, rollout in replay(model, recording, engine=arguments.engine, out=arguments.out).items():
        contacts = 0 if rollout.contacts is None else len(rollout.contacts.step)
        end = ", diverged" if rollout.diverged[0] else ""
        say(f"{name}: {rollout.time[-1]:.2f} s, {len(rollout.time)} states, {contacts} contacts{end}")
        say_written(paths[name])
    return list(paths.values())
