"""Run folders: an earlier run stays until a new one has succeeded, and what was killed can be resumed."""

import multiprocessing
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from concent_warp import run_folder as module
from concent_warp.errors import ConcentError
from concent_warp.files import not_written
from concent_warp.render.dataset.layout import EpisodeLayout
from concent_warp.render.dataset.lerobot import LeRobotWriter
from concent_warp.render.dataset.robomimic import RobomimicWriter
from concent_warp.run_folder import (
    INVOCATION,
    SETTINGS,
    UNFINISHED,
    claim_file,
    lock_folder,
    run_folder,
    write_settings,
)

COMMAND = ("fit", "demo.h5", "--overwrite")
CONTINUE = "concent fit demo.h5 --resume"


@pytest.fixture(autouse=True)
def invocation():
    token = INVOCATION.set(COMMAND)
    yield
    INVOCATION.reset(token)


def write(path: Path, text: str, *, state: bool = True) -> None:
    """Write what a run writes."""
    write_settings(path, {"text": text})
    (path / "model.toml").write_text(text)
    if state:
        (path / "checkpoint.pt").write_text(text)


def run(folder: Path, text: str, *, overwrite: bool = False, resume: bool = False) -> None:
    """Make a run that succeeds."""
    with run_folder(folder, overwrite=overwrite, resume=resume) as claimed:
        write(claimed.path, text)


def stopped(folder: Path, text: str, error: type[BaseException], *, state: bool, **options: bool) -> BaseException:
    """Make a run that ends early, and return the error that it ends with."""

    def work() -> None:
        with run_folder(folder, **{"overwrite": False, **options}) as claimed:
            write(claimed.path, text, state=state)
            raise error("early")

    with pytest.raises(error) as raised:
        work()
    return raised.value


def killed(folder: Path, text: str, *, state: bool, **options: bool) -> None:
    """Make a run in a process that is killed."""

    def work() -> None:
        with run_folder(folder, **{"overwrite": False, **options}) as claimed:
            write(claimed.path, text, state=state)
            os.kill(os.getpid(), signal.SIGKILL)

    process = multiprocessing.get_context("fork").Process(target=work)
    process.start()
    process.join(60)
    assert process.exitcode == -signal.SIGKILL


def content(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir() if path.is_file() and path.name != SETTINGS}


def whole(text: str) -> dict[str, str]:
    return {"model.toml": text, "checkpoint.pt": text}


def test_run_that_succeeds_replaces_the_earlier_one_at_once(tmp_path):
    folder = tmp_path / "run"
    run(folder, "old")
    (folder / "videos").mkdir()
    (folder / "curve.jsonl").touch()
    with run_folder(folder, overwrite=True) as claimed:
        write(claimed.path, "new")
        assert content(folder) == {**whole("old"), "curve.jsonl": ""}
    assert content(folder) == whole("new")
    assert (folder / "videos").is_dir()
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_run_takes_its_place_when_it_says_so(tmp_path):
    folder = tmp_path / "run"
    run(folder, "old")
    with run_folder(folder, overwrite=True) as claimed:
        write(claimed.path, "new")
        assert claimed.commit() == folder
        assert content(folder) == {**whole("new"), UNFINISHED: ""}
    assert content(folder) == whole("new")


@pytest.mark.parametrize("error", [ConcentError, KeyboardInterrupt, ZeroDivisionError])
@pytest.mark.parametrize("exchange", [True, False])
def test_earlier_run_survives_one_that_fails(tmp_path, monkeypatch, error, exchange):
    if not exchange:
        monkeypatch.setattr(module, "exchange", lambda *_: False)
    folder = tmp_path / "run"
    run(folder, "old")
    stopped(folder, "new", error, state=False, overwrite=True)
    assert content(folder) == whole("old")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    run(folder, "newer", overwrite=True)
    assert content(folder) == whole("newer")


@pytest.mark.parametrize("end", ["interrupted", "killed"])
def test_replacing_run_that_was_stopped_is_resumed_beside_the_earlier_one(tmp_path, end):
    folder = tmp_path / "run"
    run(folder, "old")
    if end == "killed":
        killed(folder, "new", state=True, overwrite=True)
    else:
        said = str(stopped(folder, "new", KeyboardInterrupt, state=True, overwrite=True))
        assert said == (
            f"Until it has ended, {folder} is the earlier run. The state is saved; continue with: {CONTINUE}"
        )
    assert content(folder) == whole("old")
    with pytest.raises(ConcentError, match=f"interrupted; continue it with `{CONTINUE}`, or start anew with"):
        run(folder, "newer")
    with run_folder(folder, overwrite=False, resume=True) as claimed:
        assert content(claimed.path) == {**whole("new"), UNFINISHED: ""}
        assert content(folder) == whole("old")
    assert content(folder) == whole("new")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_replacing_run_that_was_stopped_is_replaced_itself(tmp_path):
    folder = tmp_path / "run"
    run(folder, "old")
    killed(folder, "new", state=True, overwrite=True)
    run(folder, "newer", overwrite=True)
    assert content(folder) == whole("newer")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("exists", [True, False])
@pytest.mark.parametrize("end", ["interrupted", "killed"])
def test_run_stopped_before_its_first_checkpoint_is_no_obstacle(tmp_path, exists, end):
    folder = tmp_path / "run"
    if exists:
        folder.mkdir()
    if end == "killed":
        killed(folder, "new", state=False)
    else:
        assert str(stopped(folder, "new", KeyboardInterrupt, state=False)) == "Nothing was saved yet."
        assert folder.exists() == exists
    run(folder, "newer")
    assert content(folder) == whole("newer")
    killed(tmp_path / "other", "new", state=False)
    run(tmp_path / "other", "newer", resume=True)
    assert content(tmp_path / "other") == whole("newer")


@pytest.mark.parametrize("end", ["interrupted", "killed"])
def test_run_stopped_after_its_first_checkpoint_says_how_to_go_on(tmp_path, end):
    folder = tmp_path / "run"
    if end == "killed":
        killed(folder, "new", state=True)
    else:
        said = stopped(folder, "new", KeyboardInterrupt, state=True)
        assert str(said) == f"The state is saved; continue with: {CONTINUE}"
    with pytest.raises(ConcentError, match=f"was interrupted; continue it with `{CONTINUE}`"):
        run(folder, "newer")
    (folder / SETTINGS).unlink()
    with pytest.raises(ConcentError, match="was interrupted; continue it with --resume"):
        run(folder, "newer")
    run(folder, "resumed", resume=True)
    assert content(folder) == whole("resumed")


@pytest.mark.parametrize("writer", [RobomimicWriter, LeRobotWriter])
@pytest.mark.parametrize("end", ["begun", "dropped", "staged", "packed"])
def test_interrupted_data_set_is_not_taken_for_nothing(tmp_path, writer, end):
    layout, image = EpisodeLayout(10, ("base",), (64, 64), ("x",), ("x",)), np.zeros((64, 64, 3), np.uint8)

    def interrupted() -> None:
        with run_folder(tmp_path / "data", overwrite=False) as claimed:
            write(claimed.path, "data", state=False)
            made = writer(claimed.path, layout)
            episode = made.begin(0, "push")
            for _ in range(3):
                episode.add({"base": image}, np.zeros(1), np.zeros(1))
            if end == "dropped":
                episode.drop()
            elif end != "begun":
                episode.save()
            if end == "packed":
                made.finish()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="Nothing was saved" if end == "begun" else "continue with"):
        interrupted()
    assert (tmp_path / "data").exists() == (end != "begun")


def test_folder_between_two_renamings_is_restored(tmp_path):
    folder = tmp_path / "run"
    run(folder, "old")
    folder.rename(tmp_path / ".run.old")
    with pytest.raises(ConcentError, match="the folder holds a run; choose another folder"):
        run(folder, "new")
    assert content(folder) == whole("old")


def test_finished_run_and_other_things_are_left_alone(tmp_path):
    folder = tmp_path / "run"
    run(folder, "old")
    with pytest.raises(ConcentError, match="pass --overwrite or --resume"):
        run(folder, "new")
    assert content(folder) == whole("old")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    for options in ({"overwrite": True}, {"resume": True}, {}):
        with pytest.raises(ConcentError, match="other things than a run"):
            run(tmp_path / "mine", "new", **options)
    assert content(tmp_path / "mine") == {"notes.txt": "mine"}


def test_refused_resumption_leaves_a_finished_run_finished(tmp_path):
    folder = tmp_path / "run"
    run(folder, "old")
    stopped(folder, "old", ConcentError, state=True, resume=True)
    assert content(folder) == whole("old")
    stopped(folder, "old", KeyboardInterrupt, state=True, resume=True)
    assert content(folder) == {**whole("old"), UNFINISHED: ""}


def test_folder_in_use_as_working_directory_is_not_replaced(tmp_path, monkeypatch):
    run(tmp_path, "old")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConcentError, match="the working directory is in the folder"):
        run(Path(), "new", overwrite=True)
    assert content(tmp_path) == whole("old")


def test_link_to_a_run_is_kept(tmp_path):
    run(tmp_path / "run", "old")
    (tmp_path / "latest").symlink_to(tmp_path / "run")
    run(tmp_path / "latest", "new", overwrite=True)
    assert (tmp_path / "latest").is_symlink()
    assert content(tmp_path / "run") == whole("new")


def hold(folder: Path, ready, options: dict[str, bool]) -> None:
    with run_folder(folder, **options) as claimed:
        write(claimed.path, "held")
        ready.set()
        signal.pause()


@pytest.mark.parametrize("options", [{"overwrite": True}, {"overwrite": False, "resume": True}])
def test_folder_is_locked_while_a_process_writes_to_it(tmp_path, options):
    folder, context = tmp_path / "run", multiprocessing.get_context("fork")
    run(folder, "old")
    ready = context.Event()
    process = context.Process(target=hold, args=(folder, ready, options))
    process.start()
    assert ready.wait(60)
    for other in ({"overwrite": True}, {"resume": True}, {}):
        with pytest.raises(ConcentError, match="another command is writing to this folder; wait"):
            run(folder, "new", **other)
    process.kill()
    process.join()
    run(folder, "new", overwrite=True)
    assert content(folder) == whole("new")


def test_devices_are_no_files_to_write(tmp_path):
    claim_file(tmp_path / "a", overwrite=False)
    with pytest.raises(ConcentError, match="not a file"):
        claim_file(Path(os.devnull), overwrite=True)


@pytest.mark.parametrize("state", [True, False])
@pytest.mark.parametrize("error", [not_written(Path("a"), OSError(28, "full")), OSError(28, "full", "a")])
def test_full_disk_says_how_to_continue_where_there_is_a_state(tmp_path, state, error):
    def work() -> None:
        with run_folder(tmp_path / "run", overwrite=False) as claimed:
            write(claimed.path, "new", state=state)
            raise error

    with pytest.raises(ConcentError) as raised:
        work()
    said = "a: the file cannot be written; found full; make room on the disk, or choose another place"
    assert str(raised.value) == (f"{said}; the state is saved, continue with `{CONTINUE}`." if state else f"{said}.")
    assert (tmp_path / "run").exists() == state


def test_other_errors_of_the_system_pass(tmp_path):
    error = stopped(tmp_path / "run", "new", FileNotFoundError, state=True)
    assert str(error) == "early"


def test_folder_is_kept_for_one_process(tmp_path):
    folder = tmp_path / "pieces"
    match = "another command is writing to this folder"
    with lock_folder(folder), pytest.raises(ConcentError, match=match), lock_folder(folder):
        pass
    with lock_folder(folder):
        assert folder.is_dir()
