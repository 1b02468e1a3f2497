"""Run folders: an earlier run is replaced only on request and by a run that succeeds; settings are stored beside it."""

from __future__ import annotations

import errno
import os
import shlex
import shutil
import sys
import tomllib
import zipfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import asdict, dataclass, is_dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from concent_warp.errors import ConcentError, TrainError
from concent_warp.files import NotWrittenError, claim, not_written, write_text
from concent_warp.version import __version__

SETTINGS = "settings.toml"
"""File of the resolved settings; a folder that holds one is a run folder."""
UNFINISHED = ".unfinished"
"""Empty file in the folder of a run that has not ended."""
CHECKPOINT = "checkpoint.npz"
"""File of the state of a fit."""
TRAIN_CHECKPOINT = "checkpoint.pt"
"""File of the state of a training."""
TRAIN_SETTINGS = "train.toml"
"""File of the settings of a training; a folder that holds one is the run folder of a training."""
EPISODES = ".staging"
"""Folder of the episodes of a data set that are not packed yet, each named by six digits."""
STATES = (
    "checkpoint.*",
    f"seed_*/{TRAIN_CHECKPOINT}",
    f"{EPISODES}/{6 * '[0-9]'}",
    f"{EPISODES}/dropped-*",
    "meta/info.json",
    "dataset.hdf5",
)
"""Patterns of the files from which a run is resumed: of fits, trainings with one seed and several, and data sets."""
FREE = ("out", "resume", "overwrite", "engine", "recording", "model", "scene")
"""Settings that may differ when a run is continued: paths, and those without influence on the result."""
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of the system where a disk, the share of a user, or a file is full."""
INVOCATION: ContextVar[tuple[str, ...]] = ContextVar("INVOCATION", default=())
"""The command that is running and its arguments."""
PACKAGES = ("mujoco", "mujoco-warp", "warp-lang", "numpy", "scipy")


def claim_file(path: Path, *, overwrite: bool) -> None:
    """Check that a file may be written, and keep it for the running command.

    Raises:
        ConcentError: It exists and `overwrite` was not asked for, another command is writing it, or its folder is a
            file.
    """
    _check_writable(path, overwrite=overwrite)
    claim(path)
    _check_writable(path, overwrite=overwrite)  # another command may just have written it


def _check_writable(path: Path, *, overwrite: bool) -> None:
    """Raise an error where a file must not be written, see `claim_file`."""
    check_folder(path.parent)
    if path.is_dir():
        raise ConcentError("this is a folder", where=path, expected="the name of a file to write")
    if path.exists() and not path.is_file():
        raise ConcentError("not a file", where=path, expected="the name of a file to write")
    if path.exists() and not overwrite:
        raise ConcentError("the file exists", where=path, fix="choose another name or pass --overwrite")


def check_folder(path: Path) -> None:
    """Check that a folder is there or may be made.

    Raises:
        ConcentError: It, or one that it is to be in, is a file.
    """
    there = next((p for p in (path, *path.parents) if p.exists()), path)
    if there.exists() and not there.is_dir():
        raise ConcentError("this is a file", where=there, expected="a folder for the results")


def check_training(path: Path) -> None:
    """Check that a training exists, without importing the training package.

    Raises:
        TrainError: There is neither a run folder nor a checkpoint file.
    """
    if not path.exists():
        raise TrainError("no such training", where=path, expected="its run folder, or a checkpoint file in one")
    folder = path if path.is_dir() else path.parent
    checkpoint = path / TRAIN_CHECKPOINT if path.is_dir() else path
    if checkpoint.exists() and not (checkpoint.is_file() and zipfile.is_zipfile(checkpoint)):
        raise TrainError("not a checkpoint", where=checkpoint, expected="an archive of torch.save")
    if not (folder / TRAIN_SETTINGS).is_file():
        raise TrainError("the folder holds no training", where=folder, expected=f"a {TRAIN_SETTINGS}")
    if not checkpoint.exists():
        expected = f"a {TRAIN_CHECKPOINT} that concent train wrote"
        raise TrainError("no such checkpoint", where=checkpoint, expected=expected)


@dataclass
class RunFolder:
    """A folder that a run writes to; no other run writes to it meanwhile."""

    folder: Path
    """Folder that was asked for."""
    path: Path
    """Folder to write to: `folder`, or one beside it while `folder` holds an earlier run that is to be replaced."""
    keep_folders: bool
    """Whether folders within an earlier run are kept when it is replaced."""
    before: str
    """What `path` held before: "nothing", or an "unfinished" or "finished" run that is resumed."""
    was_made: bool
    """Whether `path` was made for it."""
    locks: list[int]
    """Descriptors of the locked folders."""

    def commit(self) -> Path:
        """Put the run in the place of an earlier one, if there is one, and return the folder to write to from now on.

        Raises:
            ConcentError: The system refuses to rename the folders.
        """
        if self.path != self.folder:
            _replace_folder(self.folder, self.path, self.keep_folders)
            self.path = self.folder
        return self.path

    def can_be_resumed(self) -> bool:
        """Return whether there is a state to resume from."""
        return _has_state(self.path)

    def _end(self, error: BaseException | None) -> None:
        """Finish the run, or remove what it has made if it failed before there was anything to resume from."""
        if error is None:
            self.commit()
            (self.path / UNFINISHED).unlink(missing_ok=True)
        elif self.before == "finished" and isinstance(error, ConcentError):
            (self.path / UNFINISHED).unlink(missing_ok=True)
        elif self.before == "nothing" and not self.can_be_resumed():
            _remove_files(self.path)
            if self.was_made:
                shutil.rmtree(self.path, ignore_errors=True)
        if isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt(self._interrupted()) from None
        if isinstance(error, OSError) and error.errno in FULL:
            error = not_written(Path(error.filename or self.path), error)
            if not self.can_be_resumed():
                raise error from None
        if isinstance(error, NotWrittenError) and self.can_be_resumed():
            said = f"{str(error).rstrip('.')}; the state is saved, continue with `{resuming_command()}`"
            raise NotWrittenError(said) from None

    def _interrupted(self) -> str:
        """Return what an interruption has left and how to go on."""
        if not self.can_be_resumed():
            return "Nothing was saved yet."
        earlier = "" if self.path == self.folder else f"Until it has ended, {self.folder} is the earlier run. "
        return f"{earlier}The state is saved; continue with: {resuming_command()}"


@contextmanager
def run_folder(
    folder: Path, *, overwrite: bool, resume: bool = False, keep_folders: bool = True
) -> Iterator[RunFolder]:
    """Yield the folder to which a run writes, and put the run in the place of an earlier one when it has succeeded.

    An earlier run stays as it is until `RunFolder.commit` or the end of the context, where the new run replaces it by
    one renaming. A run that ends early is removed if it has nothing to be resumed from; otherwise it is kept, beside an
    earlier one if there is one, for `resume`. The folder is locked: no second run can write to it.

    Args:
        folder: The folder.
        overwrite: Replace an earlier run.
        resume: Continue an unfinished run, or a finished one with more to do; a new one if there is none.
        keep_folders: Keep folders within an earlier run, such as videos, when it is replaced.

    Raises:
        ConcentError: It holds a run and neither `overwrite` nor `resume` was asked for, it holds other things, or
            another process writes to it.
    """
    run = _claim_folder(folder, overwrite=overwrite, resume=resume, keep_folders=keep_folders)
    try:
        try:
            (run.path / UNFINISHED).touch()
            yield run
        except BaseException as error:
            run._end(error)
            raise
        run._end(None)
    finally:
        for lock in run.locks:
            os.close(lock)


def _claim_folder(folder: Path, *, overwrite: bool, resume: bool, keep_folders: bool = True) -> RunFolder:
    """Lock a folder, check that a run may write to it, and return where it is to write, see `run_folder`."""
    if folder.exists() and not folder.is_dir():
        raise ConcentError("this is a file", where=folder, expected="a folder for the results")
    before, after = _beside(folder, "old"), _beside(folder, "new")
    if before.is_dir() and not folder.exists():  # killed between two renamings
        before.rename(folder)
    was_made = not folder.exists()
    make_folder(folder)
    locks = [_locked(folder)]
    try:
        holds, waiting = _check_content(folder, overwrite=overwrite, resume=resume)
        if resume and waiting:
            return RunFolder(folder, after, keep_folders, "unfinished", False, [*locks, _locked(after)])
        shutil.rmtree(before, ignore_errors=True)
        if after.exists():
            locks.append(_locked(after))
            shutil.rmtree(after)
        if holds == "nothing":
            _remove_files(folder)
            return RunFolder(folder, folder, keep_folders, "nothing", was_made, locks)
        if resume:
            return RunFolder(folder, folder, keep_folders, holds, False, locks)
        _check_replaceable(folder)
        make_folder(after)
        return RunFolder(folder, after, keep_folders, "nothing", True, [*locks, _locked(after)])
    except BaseException:
        for lock in locks:
            os.close(lock)
        raise


def check_run_folder(folder: Path, *, overwrite: bool, resume: bool = False) -> None:
    """Check that a run may write to a folder, as `run_folder` does, but change nothing.

    Raises:
        ConcentError: It holds a run and neither `overwrite` nor `resume` was asked for, it holds other things, or
            another process writes to it.
    """
    if folder.is_dir():
        os.close(_locked(folder))
        _check_content(folder, overwrite=overwrite, resume=resume)
    elif folder.exists():
        raise ConcentError("this is a file", where=folder, expected="a folder for the results")


def _check_content(folder: Path, *, overwrite: bool, resume: bool) -> tuple[str, bool]:
    """Return what a folder holds, see `_content`, and whether an unfinished run that is to replace it is beside it.

    Raises:
        ConcentError: It holds what may not be replaced.
    """
    after = _beside(folder, "new")
    holds, waiting = _content(folder), _content(after) == "unfinished"
    if holds == "other":
        raise ConcentError(
            "the folder holds other things than a run", where=folder, fix="choose another folder with --out"
        )
    if not overwrite and not resume and (waiting or holds != "nothing"):
        raise _existing_run_error(folder, after if waiting else folder, unfinished=waiting or holds == "unfinished")
    return holds, waiting


def _beside(folder: Path, kind: str) -> Path:
    """Return the hidden folder beside a folder, with the run that replaces it ("new") or that was replaced ("old")."""
    folder = folder.resolve()
    return folder.with_name(f".{folder.name}.{kind}")


def _remove_files(folder: Path) -> None:
    """Remove the files of a folder, but not the folders in it."""
    for path in folder.iterdir():
        if path.is_file():
            path.unlink()


def _has_state(folder: Path) -> bool:
    """Return whether a folder holds files from which a run can be resumed."""
    return any(True for pattern in STATES for _ in folder.glob(pattern))


def _content(folder: Path) -> str:
    """Return what a folder holds: "nothing" worth keeping, an "unfinished" or a "finished" run, or "other" things."""
    if not folder.is_dir():
        return "nothing"
    begun = (folder / UNFINISHED).is_file()
    if begun:
        return "unfinished" if _has_state(folder) else "nothing"
    # All that earlier versions leave that are killed before anything else is written.
    ignored = {f".{SETTINGS}.partial"}
    if all(path.name in ignored for path in folder.iterdir()):
        return "nothing"
    return "finished" if (folder / SETTINGS).is_file() else "other"


def _existing_run_error(folder: Path, path: Path, *, unfinished: bool) -> ConcentError:
    """Return the error that a folder holds a run, with the command that continues it."""
    if not unfinished:
        fix = "choose another folder, or pass --overwrite or --resume"
        return ConcentError("the folder holds a run", where=folder, fix=fix)
    with suppress(OSError, ValueError, RecursionError):
        command = str(tomllib.loads((path / SETTINGS).read_text()).get("command", ""))
        fix = f"continue it with `{_resuming(shlex.split(command))}`, or start anew with --overwrite or elsewhere"
        return ConcentError("the folder holds a run that was interrupted", where=folder, fix=fix)
    fix = "continue it with --resume, or start anew with --overwrite or elsewhere"
    return ConcentError("the folder holds a run that was interrupted", where=folder, fix=fix)


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Make a folder and keep it for this process within the context.

    Raises:
        ConcentError: It cannot be made, or another process writes to it.
    """
    make_folder(folder)
    lock = _locked(folder)
    try:
        yield
    finally:
        os.close(lock)


def _locked(folder: Path) -> int:
    """Return the descriptor of a folder, locked for this process until it is closed or the process ends.

    Raises:
        ConcentError: Another process has locked it.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        return os.open(os.devnull, os.O_RDONLY)
    while True:
        lock = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
            fix = "wait until it has ended, or choose another folder with --out"
            raise ConcentError("another command is writing to this folder", where=folder, fix=fix) from None
        except OSError:  # some network disks have no locks
            return lock
        make_folder(folder)
        if os.path.samestat(os.fstat(lock), folder.stat()):  # another process may have replaced it meanwhile
            return lock
        os.close(lock)


def _check_replaceable(folder: Path) -> None:
    """Check that a folder can be renamed.

    Raises:
        ConcentError: It is the working directory or holds it, or a disk is mounted there.
    """
    if Path.cwd().is_relative_to(folder.resolve()):
        fix = "start the command from another place, or choose another folder"
        raise ConcentError("the working directory is in the folder that is to be replaced", where=folder, fix=fix)
    if os.path.ismount(folder.resolve()):
        raise ConcentError(
            "a disk is mounted here, which cannot be replaced", where=folder, fix="choose a folder in it"
        )


def _replace_folder(folder: Path, new: Path, keep_folders: bool) -> None:
    """Put a folder in the place of another one, which is removed."""
    old, folder = _beside(folder, "old"), folder.resolve()
    try:
        (folder / UNFINISHED).unlink(missing_ok=True)
        if exchange(folder, new):
            new.rename(old)
        else:
            folder.rename(old)
            new.rename(folder)
        if keep_folders:
            for path in old.iterdir():
                if path.is_dir() and not path.is_symlink() and not (folder / path.name).exists():
                    path.rename(folder / path.name)
    except OSError as error:
        raise ConcentError(
            "the earlier run cannot be replaced", where=folder, found=error.strerror, fix=f"the new one is in {new}"
        ) from None
    shutil.rmtree(old, ignore_errors=True)


def exchange(first: Path, second: Path) -> bool:
    """Exchange the names of two files or folders in one step; return False if the system cannot do this."""
    import ctypes

    here, flag = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux
    try:
        renameat2 = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError, TypeError):
        return False
    return renameat2(here, os.fsencode(first), here, os.fsencode(second), flag) == 0


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


def check_unchanged(path: Path, settings: Mapping[str, Any], free: Collection[str] = FREE, *, resume: str = "") -> None:
    """Raise an error where settings other than `free` differ from a file's; `resume` is what continues the run then."""
    try:
        stored = tomllib.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return
    before, now = _flat(stored.get("settings", {})), _flat(settings)
    differing = [n for n in sorted(before | now) if n.split(".")[0] not in free and before.get(n) != now.get(n)]
    if differing:
        command = resume or f"`{_resuming(shlex.split(stored.get('command', '')))}`"
        raise ConcentError(
            "this run was begun with other settings",
            where=path.parent,
            expected=", ".join(f"{name} {before.get(name)}" for name in differing),
            found=", ".join(f"{name} {now.get(name)}" for name in differing),
            fix=f"continue with {command}, or start anew with --overwrite",
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
