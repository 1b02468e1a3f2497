"""A full disk is said in one sentence with the file; what was there stays whole, and nothing unfinished is left."""

import resource
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from test_checkpoint_files import copied, trained, training

from concent_warp.cli import main

assert trained
"""Fixture."""


@pytest.fixture
def run_limited(capsys) -> Callable[[list[tuple[int, list[str]]]], list[tuple[int, str]]]:
    """Return a function that runs commands that cannot write larger files than a limit [bytes].

    It returns exit codes and last lines of errors.
    """

    def run(commands: list[tuple[int, list[str]]]) -> list[tuple[int, str]]:
        before, handled, found = resource.getrlimit(resource.RLIMIT_FSIZE), signal.getsignal(signal.SIGXFSZ), []
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        for limit, arguments in commands:
            capsys.readouterr()
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
            try:
                code = main(arguments)
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, before)
            said = capsys.readouterr().err
            assert "Traceback" not in said, said
            found.append((code, said.strip().splitlines()[-1]))
        signal.signal(signal.SIGXFSZ, handled)
        return found

    return run


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_training_that_finds_the_disk_full_leaves_the_earlier_one(trained, tmp_path, run_limited):
    copied(trained, tmp_path)
    before = content(tmp_path)
    limits = [0, 1000, 3000, 12_000, 15_000, 30_000]
    found = run_limited([(limit, training(tmp_path, "--overwrite")) for limit in limits])
    for code, said in found:
        assert code == 2
        assert said.startswith(f"concent train: {tmp_path}/.run.new/")
        assert "cannot be written" in said
    assert len({said for _, said in found}) >= 4
    assert content(tmp_path) == before


def test_training_that_fills_the_disk_keeps_its_last_checkpoint(trained, tmp_path, run_limited):
    run = copied(trained, tmp_path)
    size = (run / "checkpoint.pt").stat().st_size
    curve = run / "curve.jsonl"
    first = curve.read_text().splitlines(keepends=True)[0]
    curve.write_text(first * (size // len(first)))  # as after thousands of iterations: larger than the checkpoint
    command = training(tmp_path, "--resume", "--iterations", "1000", "--checkpoint", "1000")
    [(code, said)] = run_limited([(size + 4000, command)])
    assert code == 2
    full = "the file cannot be written; found File too large; make room on the disk, or choose another place; the state"
    assert said.split(" is saved, continue with `concent train ")[0] == f"concent train: {curve}: {full}"
    assert said.endswith(" --resume`.")
    assert not list(tmp_path.rglob("*partial*"))
    assert main(training(tmp_path, "--resume", "--iterations", "2")) == 0


def test_export_to_a_full_disk_leaves_the_earlier_file(trained, tmp_path, run_limited):
    run = copied(trained, tmp_path)
    commands = []
    for name in ("policy.onnx", "policy.pt", "pretrained"):
        command = ["export", "--checkpoint", str(run), "--out", str(tmp_path / name), "--overwrite"]
        commands.append(command + ["--as-pretrained"] * (name == "pretrained"))
    assert [main(command) for command in commands] == [0, 0, 0]
    before = content(tmp_path)
    for code, said in run_limited([(limit, command) for command in commands for limit in (0, 1000, 5000)]):
        assert code == 2
        assert said.startswith("concent export: ")
        assert "cannot be" in said
    assert content(tmp_path) == before
    assert {path.name for path in tmp_path.iterdir() if path.is_dir()} <= {"run", "pretrained"}
