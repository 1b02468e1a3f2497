"""The recording that a command was given, with what its options say about it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from concent_warp.errors import RecordingError
from concent_warp.recording.load import load_recording
from concent_warp.recording.merge import merged
from concent_warp.recording.recording import Recording


def given_recording(
    path: Path | Sequence[Path], demonstrations: Sequence[str] = (), noise: Sequence[str] = ()
) -> Recording:
    """Return a recording, or several of the same scene as one.

    Args:
        path: File or folder, or several.
        demonstrations: Names of those to take; all where there are none.
        noise: Noise of channels, such as ``angle=0.001``.

    Raises:
        RecordingError: It cannot be read, there is no such demonstration or channel, the noise is no number, or
            recordings are of different scenes.
    """
    stated = {}
    for text in noise:
        channel, _, value = text.rpartition("=")
        try:
            stated[channel] = float(value)
        except ValueError:
            channel = ""
        if not channel:
            raise RecordingError("noise is not stated so", expected="--noise CHANNEL=NUMBER", found=repr(text[:80]))
    paths = [path] if isinstance(path, Path) else path
    if not paths:
        raise RecordingError("no recording is given", fix="name the file of at least one")
    return merged([load_recording(one) for one in paths]).only(demonstrations).with_noise(stated)
