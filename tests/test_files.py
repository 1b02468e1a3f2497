"""Files are written whole or not at all."""

import multiprocessing
import os
import resource
import signal
from pathlib import Path

import pytest

from concent_warp.errors import ConcentError
from concent_warp.files import DiskFile, all_or_none, claimed_files, new_file, not_written, write_bytes, write_text
from concent_warp.model import Model
from concent_warp.run_folder import claim_file
from concent_warp.scene.scene import Scene


def with_small_files(limit: int, path: Path, results) -> None:
    """Write more than `limit` bytes where the system refuses larger files, as a full disk does."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    try:
        write_bytes(path, b"x" * (limit + 1))
        results.put("written")
    except ConcentError as error:
        results.put(str(error))


def test_refused_file_leaves_the_earlier_one_and_nothing_else(tmp_path):
    path = tmp_path / "model.toml"
    write_text(path, "earlier")
    context = multiprocessing.get_context("spawn")
    results = context.SimpleQueue()
    process = context.Process(target=with_small_files, args=(1000, path, results))
    process.start()
    process.join(60)
    assert results.get() == (
        f"{path}: the file cannot be written; found File too large; make room on the disk, or choose another place."
    )
    assert [file.name for file in tmp_path.iterdir()] == ["model.toml"]
    assert path.read_text() == "earlier"


def write_half(path: Path) -> None:
    with new_file(path) as partial:
        partial.write_text("half")
        (path.parent / "nowhere").read_text()


def test_failed_writing_leaves_nothing_and_its_error_passes(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        write_half(tmp_path / "a")
    assert not list(tmp_path.iterdir())


def test_what_an_ended_process_left_is_replaced(tmp_path):
    (tmp_path / ".a.partial").write_text("a long half of an earlier file")
    write_text(tmp_path / "a", "whole")
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("a", "whole")]


def write_often(path: Path, letter: str) -> None:
    for _ in range(200):
        write_bytes(path, letter.encode() * 100_000)


def test_two_processes_that_write_one_file_take_turns(tmp_path):
    path = tmp_path / "a"
    processes = [multiprocessing.get_context("spawn").Process(target=write_often, args=(path, s)) for s in "ab"]
    for process in processes:
        process.start()
    seen = set()
    while any(process.is_alive() for process in processes):
        if path.exists():
            seen.add(path.read_bytes())
    assert [process.exitcode for process in processes] == [0, 0]
    assert seen <= {b"a" * 100_000, b"b" * 100_000}
    assert [file.name for file in tmp_path.iterdir()] == ["a"]


def test_devices_and_folders_are_not_replaced(tmp_path):
    for path in (Path(os.devnull), tmp_path):
        with pytest.raises(ConcentError, match="not a file"):
            write_text(path, "text")


def test_files_that_belong_together_are_replaced_together(tmp_path):
    for name in "ab":
        write_text(tmp_path / name, "old")

    def replace(last: str) -> None:
        with all_or_none():
            write_text(tmp_path / "a", "new")
            assert (tmp_path / "a").read_text() == "old"
            write_text(tmp_path / "a", "newer")
            with all_or_none():
                write_text(tmp_path / "b", "newer")
            assert (tmp_path / "b").read_text() == "old"
            write_text(tmp_path / last, "newer")

    with pytest.raises(ConcentError, match="nowhere/c: the file cannot be written"):
        replace("nowhere/c")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a": "old", "b": "old"}
    replace("c")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys("abc", "newer")


def test_model_is_replaced_with_its_scene_or_not_at_all(tmp_path, monkeypatch):
    scene = "<mujoco><worldbody><body><freejoint/><geom size='{}'/></body></worldbody></mujoco>"
    old, new = (Model(Scene(scene.format(size))) for size in ("0.1", "0.2"))
    old.save(tmp_path / "model.toml")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    text = "concent_warp.model.write_text"

    def full(path, _):
        raise not_written(path, OSError(28, "No space left on device"))

    with monkeypatch.context() as patch:
        patch.setattr(text, lambda path, words: (full if path.suffix == ".toml" else write_text)(path, words))
        with pytest.raises(ConcentError, match=r"model\.toml: the file cannot be written"):
            new.save(tmp_path / "model.toml")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    new.save(tmp_path / "model.toml")
    assert "0.2" in Model.load(tmp_path / "model.toml").scene.xml


def hold(path: Path, ready, end) -> None:
    with claimed_files():
        claim_file(path, overwrite=True)
        ready.set()
        end.wait(60)


@pytest.mark.parametrize("ended", ["ended", "killed"])
def test_file_is_kept_for_the_command_that_claims_it(tmp_path, ended):
    path, context = tmp_path / "new" / "a", multiprocessing.get_context("fork")
    ready, end = context.Event(), context.Event()
    process = context.Process(target=hold, args=(path, ready, end))
    process.start()
    assert ready.wait(60)
    with claimed_files():
        claim_file(tmp_path / "new" / "b", overwrite=False)
        with pytest.raises(ConcentError, match="new/a: another command is writing to this place; wait until it"):
            claim_file(path, overwrite=False)
    if ended == "killed":
        process.kill()
    else:
        end.set()
    process.join()
    with claimed_files():
        claim_file(path, overwrite=False)
        claim_file(path, overwrite=False)
        write_text(tmp_path / "new" / ".." / "new" / "a", "first")
        write_text(path, "second")
    assert [(file.name, file.read_text()) for file in path.parent.iterdir()] == [("a", "second")]


def test_what_a_command_has_not_written_is_cleaned_up(tmp_path):
    def fail() -> None:
        with claimed_files():
            claim_file(tmp_path / "some" / "where" / "a", overwrite=False)
            assert list((tmp_path / "some" / "where").iterdir())
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert not list(tmp_path.iterdir())


def test_file_written_by_another_command_meanwhile_is_not_replaced(tmp_path, monkeypatch):
    path = tmp_path / "a"
    monkeypatch.setattr("concent_warp.run_folder.claim", lambda _: path.write_text("of another command"))
    with pytest.raises(ConcentError, match="the file exists"):
        claim_file(path, overwrite=False)


def test_disk_file_keeps_its_first_error_and_never_fails(tmp_path):
    path = tmp_path / "a"
    with DiskFile(path) as file:
        assert file.write(b"abc") == 3
        file.check()
        file._raw.close()
        file._raw = open("/dev/full", "wb", buffering=0)  # noqa: SIM115
        assert file.write(b"def") == 3
        assert file.write(b"ghi") == 3
        with pytest.raises(OSError, match=f"No space left on device: '{path}'"):
            file.check()
