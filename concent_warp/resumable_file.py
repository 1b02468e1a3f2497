"""Commands that write one file and keep their state beside it, so that they can be continued after an interruption."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from concent_warp.errors import ConcentError
from concent_warp.run_folder import claim_file, resuming_command


def claim_resumable(path: Path, state: Path, *, overwrite: bool, resume: bool) -> None:
    """Check that a file may be written, and keep it for the running command.

    Args:
        path: The file.
        state: File of the state of an interrupted command that was to write it.
        overwrite: Replace the file, and forget the state.
        resume: Continue from the state; the file is replaced then, too, as the interrupted command was to.

    Raises:
        ConcentError: The file exists, or a state of an interrupted command, and neither was asked for; another command
            is writing the file; or its folder is a file.
    """
    claim_file(path, overwrite=overwrite or (resume and state.is_file()))
    if state.is_file() and not overwrite and not resume:
        raise ConcentError(
            "a command that was to write this file was interrupted",
            where=path,
            fix="continue it with --resume, or start anew with --overwrite",
        )


@contextmanager
def say_how_to_resume(state: Path) -> Iterator[None]:
    """Say after an interruption within the context whether there is a state, and how to go on."""
    try:
        yield
    except KeyboardInterrupt:
        said = f"The state is saved; continue with: {resuming_command()}" if state.is_file() else ""
        raise KeyboardInterrupt(said or "Nothing was saved yet.") from None
