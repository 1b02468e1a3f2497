"""``concent replay``: what a model predicts for the commands of a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from concent_warp.cli.given_model import given_model
from concent_warp.cli.terminal import say, say_written
from concent_warp.recording.load import load_recording
from concent_warp.run_folder import claim_file, make_folder
from concent_warp.simulate.replay import replay
from concent_warp.simulate.rollout_file import save_rollout
from concent_warp.simulate.select import EngineName, make_engine


@dataclass(frozen=True)
class Arguments:
    """Replay the commands of a recording in a model and save states, sensors, body poses and contacts."""

    recording: tyro.conf.Positional[Path]
    """Recording."""
    model: Path
    """Model (.toml) or MJCF (.xml)."""
    out: Path = Path("rollout.npz")
    """File to write; of several demonstrations, rollout_<demonstration>.npz."""
    demonstrations: tuple[str, ...] = ()
    """Demonstrations to replay; all by default."""
    engine: EngineName = "mujoco"
    """Engine."""
    overwrite: bool = False
    """Replace files that are there."""


def run(arguments: Arguments) -> list[Path]:
    """Replay and write a file for each demonstration."""
    recording = load_recording(arguments.recording).only(arguments.demonstrations)
    model = given_model(arguments.model, recording)
    out = arguments.out
    paths = {
        d.name: out if len(recording.demonstrations) == 1 else out.with_name(f"{out.stem}_{d.name}{out.suffix}")
        for d in recording.demonstrations
    }
    for path in paths.values():
        claim_file(path, overwrite=arguments.overwrite)
    engine = make_engine(arguments.engine, model)
    make_folder(out.parent)
    for d in recording.demonstrations:
        rollout = replay(model, d, engine, contacts="all").numpy()
        save_rollout(rollout, engine.compiled, paths[d.name])
        contacts = 0 if rollout.contacts is None else len(rollout.contacts.step)
        end = ", diverged" if rollout.diverged[0] else ""
        say(f"{d.name}: {rollout.time[-1]:.2f} s, {len(rollout.time)} states, {contacts} contacts{end}")
        say_written(paths[d.name])
    return list(paths.values())
