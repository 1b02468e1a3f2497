"""The model that a command was given."""

from __future__ import annotations

from pathlib import Path

from concent_warp.model import Model
from concent_warp.recording.recording import Recording


def given_model(path: Path | None, recording: Recording) -> Model:
    """Return the model in a file, that of the recording's own scene where none is named.

    Raises:
        ModelError: The file cannot be read, or the recording cannot be of this model.
    """
    if path is None:
        return Model.from_recording(recording)
    model = Model.load(path)
    model.check_recording(recording)
    return model
