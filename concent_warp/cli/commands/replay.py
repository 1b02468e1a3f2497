"""``concent replay``: what a model predicts for the commands of a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from concent_warp.cli.given_model import given_model
from concent_warp.cli.options import EngineOption, OutPath
from concent_warp.cli.terminal import say, say_written
from concent_warp.comparison.initial_states import with_initial_states
from concent_warp.recording.load import load_recording
from concent_warp.run_folder import claim_file, make_folder
from concent_warp.simulate.replay_recording import replay, rollout_path


@dataclass(frozen=True)
class Arguments:
    """Replay the commands of a recording in a model and save states, sensors, body poses and contacts. Where the
    recording does not state the initial state, a replay starts from one that is fitted to the first readings, that of
    `concent compare`.
    """

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
    """Replay, each demonstration from the state that `concent compare` starts from, and write a file for each."""
    recording = load_recording(arguments.recording).only(arguments.demonstrations)
    model = given_model(arguments.model, recording)
    paths = {d.name: rollout_path(arguments.out, recording, d.name) for d in recording.demonstrations}
    for path in paths.values():
        claim_file(path, overwrite=arguments.overwrite)
    model.check_recording(recording)
    started = with_initial_states(model, recording, arguments.engine)
    pairs = zip(recording.demonstrations, started.demonstrations, strict=True)
    fitted = [b.name for a, b in pairs if (a.qpos is None, a.qvel is None) != (b.qpos is None, b.qvel is None)]
    if fitted:
        say(f"initial state fitted to the first readings: {', '.join(fitted)}")
    make_folder(arguments.out.parent)
    for name, rollout in replay(model, started, engine=arguments.engine, out=arguments.out).items():
        contacts = 0 if rollout.contacts is None else len(rollout.contacts.step)
        end = ", diverged" if rollout.diverged[0] else ""
        say(f"{name}: {rollout.time[-1]:.2f} s, {len(rollout.time)} states, {contacts} contacts{end}")
        say_written(paths[name])
    return list(paths.values())
