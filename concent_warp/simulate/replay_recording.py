"""Replays of the demonstrations of a recording, and the files that they are saved to."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from concent_warp.files import all_or_none
from concent_warp.model import Model, check_inputs
from concent_warp.recording.recording import Recording
from concent_warp.simulate.engine import Rollout
from concent_warp.simulate.replay import replay as replay_demonstration
from concent_warp.simulate.rollout_file import save_rollout
from concent_warp.simulate.select import EngineName, make_engine


def replay(
    model: Model,
    recording: Recording,
    *,
    engine: EngineName = "mujoco",
    out: str | Path | None = None,
    progress: Callable[[float], None] | None = None,
) -> dict[str, Rollout]:
    """Replay the commands of each demonstration in a model, from its recorded initial state.

    Where there is none, a replay starts from the first readings, at rest where no velocity was read. The command
    ``concent replay`` fits the initial state first, as `compare` does.

    Args:
        model: The model.
        recording: What was commanded.
        engine: "mujoco", "warp", or "auto" for MuJoCo-Warp where there is a CUDA device; single replays are fastest in
            C MuJoCo.
        out: File (``.npz``) for states, sensors, body poses and contacts; of several demonstrations each has its own,
            ``<stem>_<demonstration>.npz``.
        progress: Called with the share done, 0..1.

    Returns:
        By demonstration, one variant each, NumPy arrays, contacts included.

    Raises:
        ModelError: The model is of another robot than the recording.
        RecordingError: The recording contradicts itself or its scene.
        EngineError: The model cannot be simulated.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> rollout = cw.replay(cw.Model.from_recording(recording), recording)["demo_0"]
        >>> rollout.qpos.shape[0], bool(rollout.diverged[0])
        (1, False)
    """
    check_inputs(model, recording)
    simulator = make_engine(engine, model)
    found = {}
    with all_or_none():
        for k, d in enumerate(recording.demonstrations):
            found[d.name] = replay_demonstration(model, d, simulator, contacts="all").numpy()
            if out is not None:
                save_rollout(found[d.name], simulator.compiled, rollout_path(Path(out), recording, d.name))
            if progress is not None:
                progress((k + 1) / len(recording.demonstrations))
    return found


def rollout_path(out: Path, recording: Recording, demonstration: str) -> Path:
    """Return the file of a demonstration's replay, see `replay`."""
    return out if len(recording.demonstrations) == 1 else out.with_name(f"{out.stem}_{demonstration}{out.suffix}")
