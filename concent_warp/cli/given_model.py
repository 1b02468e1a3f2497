"""The model that a command was given, refused where it is of another robot than the recording."""

from __future__ import annotations

from pathlib import Path

from concent_warp.errors import ModelError
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from concent_warp.scene.scene import Scene


def given_model(path: Path | None, recording: Recording) -> Model:
    """Return the model in a file, that of the recording's own scene where none is named.

    Raises:
        ModelError: The file cannot be read, or the recording cannot be of this model: other actuators were commanded
            than it has, or its initial state has another number of positions.
    """
    if path is None:
        return Model(Scene(recording.scene, source=recording.source))
    model = Model.load(path)
    check_fits(model, recording, path)
    return model


def check_fits(model: Model, recording: Recording, path: Path) -> None:
    """Refuse a model of another robot than the one that was recorded."""
    compiled = model.scene.model
    actuators = [compiled.actuator(i).name for i in range(compiled.nu)]
    for demonstration in recording.demonstrations:
        commanded = list(demonstration.action)
        if set(commanded) != set(actuators):
            raise refusal(path, recording, f"actuators {sorted(commanded)}", sorted(actuators))
        if demonstration.qpos is not None and len(demonstration.qpos) != compiled.nq:
            raise refusal(path, recording, f"{len(demonstration.qpos)} positions in the state", compiled.nq)


def refusal(path: Path, recording: Recording, expected: str, found: object) -> ModelError:
    """Return the error that says how model and recording differ."""
    return ModelError(
        f"the model is of another robot or scene than the recording {recording.source}",
        where=path,
        expected=expected,
        found=found,
        fix="give a model made from this recording's scene",
    )
