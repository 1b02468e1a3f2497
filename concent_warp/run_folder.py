"""Run folders: output is overwritten only on request, and settings are stored beside the results."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
import tomllib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, is_dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from concent_warp.errors import ConcentError, TrainError
from concent_warp.files import write_text
from concent_warp.version import __version__

SETTINGS = "settings.toml"
"""File of the resolved settings; a folder that holds one is a run folder."""
CHECKPOINT = "checkpoint.npz"
"""File of the state of a fit."""
CHECKPOINTS = "checkpoint.*"
"""Files of the state of a fit or a training."""
FREE = ("out", "resume", "overwrite", "engine", "recording", "model", "scene")
"""Settings that may differ when a run is continued: paths, and those without influence on the result."""
INVOCATION: ContextVar[tuple[str, ...]] = ContextVar("INVOCATION", default=())
"""The command that is running and its arguments."""
PACKAGES = ("mujoco", "mujoco-warp", "warp-lang", "numpy", "scipy")


def claim_file(path: Path, *, overwrite: bool) -> None:
    """Check that a file may be written.

    Raises:
        ConcentError: It exists and `overwrite` was not asked for.
    """
    if path.is_dir():
        raise ConcentError("this is a folder", where=path, expected="the name of a file to write")
    if path.exists() and not overwrite:
        raise ConcentError("the file exists", where=path, fix="choose another name or pass --overwrite")


def check_training(path: Path) -> None:
    """Check that a training exists, without importing the training package.

    Raises:
        TrainError: There is neither a run folder nor a checkpoint file.
    """
    if not path.exists():
        raise TrainError("no such training", where=path, expected="its run folder, or a checkpoint file in one")


@contextmanager
def run_folder(folder: Path, *, overwrite: bool, resume: bool = False) -> Iterator[None]:
    """Make the folder of a run and empty it of an earlier run's results where that was asked.

    A folder made here is removed when the run ends with a `ConcentError` before its first checkpoint.

    Raises:
        ConcentError: It holds a run and neither `overwrite` nor `resume` was asked for, or holds other things.
    """
    new = not folder.exists()
    _claim_folder(folder, overwrite=overwrite, resume=resume)
    try:
        yield
    except ConcentError:
        if new and not any(folder.glob(CHECKPOINTS)):
            shutil.rmtree(folder)
        raise


def _claim_folder(folder: Path, *, overwrite: bool, resume: bool) -> None:
    """Check that a run may write to a folder, make it, and empty it where that was asked, see `run_folder`."""
    if folder.exists() and not folder.is_dir():
        raise ConcentError("this is a file", where=folder, expected="a folder for the results")
    unfinished = f".{SETTINGS}.partial"  # all that a run leaves that is killed before anything else is written
    if folder.is_dir() and any(path.name != unfinished for path in folder.iterdir()):
        if not (folder / SETTINGS).is_file():
            raise ConcentError(
                "the folder holds other things than a run", where=folder, fix="choose another folder with --out"
            )
        if not overwrite and not resume:
            raise ConcentError(
                "the folder holds a run", where=folder, fix="choose another folder, or pass --overwrite or --resume"
            )
        if not resume:
            for path in folder.iterdir():
                if path.is_file():
                    path.unlink()
    make_folder(folder)


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, if they are not there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConcentError("the folder cannot be made", where=folder, found=error.strerror) from None


def write_settings(folder: Path, settings: Any) -> dict[str, Any]:
    """Write the resolved settings, the command and the versions to the run folder, and return them.

    Raises:
        ConcentError: The folder holds an interrupted run with other settings; nothing in the folder is changed.
    """
    import tomli_w

    document = {"command": command_line(), "versions": versions(), "settings": plain(settings)}
    if (folder / CHECKPOINT).exists():
        check_unchanged(folder / SETTINGS, document["settings"])
    write_text(folder / SETTINGS, tomli_w.dumps(document))
    return document


def check_unchanged(path: Path, settings: Mapping[str, Any], free: Collection[str] = FREE) -> None:
    """Raise an error where settings other than those in `free` differ from a settings file."""
    try:
        stored = tomllib.loads(path.read_text())
    except (OSError, ValueError):
        return
    before, now = _flat(stored.get("settings", {})), _flat(settings)
    differing = [n for n in sorted(before | now) if n.split(".")[0] not in free and before.get(n) != now.get(n)]
    if differing:
        raise ConcentError(
            "this run was begun with other settings",
            where=path.parent,
            expected=", ".join(f"{name} {before.get(name)}" for name in differing),
            found=", ".join(f"{name} {now.get(name)}" for name in differing),
            fix=f"continue with `{_resuming(shlex.split(stored.get('command', '')))}`, or start anew with --overwrite",
        )


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings by their dotted names."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        found |= _flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return found


def command_line() -> str:
    """Return the current command line."""
    return shlex.join([*_program(), *INVOCATION.get()])


def resuming_command() -> str:
    """Return the command that continues the current run."""
    return _resuming([*_program(), *INVOCATION.get()])


def _program() -> list[str]:
    """Return what comes before a command's name: "concent", or what starts it in several processes."""
    if (count := processes()[1]) == 1:
        return ["concent"]
    return ["torchrun", "--nproc-per-node", str(count), "-m", "concent_warp"]


def _resuming(command: Sequence[str]) -> str:
    """Return a command with ``--resume``, which continues its run."""
    return shlex.join([*(part for part in command if part not in ("--overwrite", "--resume")), "--resume"])


def versions() -> dict[str, str]:
    """Return the versions of this package, of Python and of the packages that results depend on."""
    found = {"concent-warp": __version__, "python": sys.version.split()[0]}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def plain(value: Any) -> Any:
    """Return nested settings as TOML values: tables, lists, numbers, text; None is left out."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items() if item is not None}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value if item is not None]
    return value if isinstance(value, bool | int | float | str) else str(value)


def processes() -> tuple[int, int]:
    """Return the rank of this process on this host and the number of processes that torchrun started there.

    Only rank 0 prints.
    """
    if "TORCHELASTIC_RUN_ID" not in os.environ:
        return 0, 1
    return int(os.environ["LOCAL_RANK"]), int(os.environ["LOCAL_WORLD_SIZE"])
