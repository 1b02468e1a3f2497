"""What files and paths say never steers the terminal, and warnings are one line each."""

import subprocess
import sys
from pathlib import Path

import h5py
import pytest

from benchmarks.bad_input.sound_inputs import SCENE, write_recording_and_model
from concent_warp.cli import main
from concent_warp.cli.terminal import say, say_written

ESCAPES = ["\x1b[31m", "\x07", "\x9b31m", "\u202e", "\x08", "\r"]


def lines(text: str) -> list[str]:
    found = text.rstrip("\n").split("\n")
    assert all(line.isprintable() for line in found), text
    return found


@pytest.mark.parametrize("escape", ESCAPES)
def test_names_in_files_and_paths_are_shown_with_escapes(tmp_path, monkeypatch, capsys, escape):
    recording, _ = write_recording_and_model(tmp_path)
    with h5py.File(recording, "r+") as file:
        file.move("data/demo_0", f"data/demo_0{escape}")
    monkeypatch.chdir(tmp_path)
    assert main(["compare", str(recording)]) == 2
    assert main(["compare", f"gone{escape}.h5"]) == 2
    assert main([f"comp{escape}are"]) == 2
    shown = lines(capsys.readouterr().err)
    assert len([line for line in shown if not line.endswith(": loading ...")]) == 3


@pytest.mark.parametrize("escape", ESCAPES)
def test_a_task_that_steers_the_terminal_is_refused(tmp_path, capsys, escape):
    recording, _ = write_recording_and_model(tmp_path)
    with h5py.File(recording, "r+") as file:
        file["data/demo_0"].attrs["task"] = f"push{escape}!"
    code = main(["compare", str(recording)])
    assert code == (0 if escape == "\r" else 2)  # a carriage return is white space
    lines(capsys.readouterr().err)


def test_remarks_and_written_paths_are_printable(capsys):
    say("a line\nwith \x1b[31m red")
    say_written(Path("a\x1b[31m.h5"))
    assert lines(capsys.readouterr().out) == ["a line", "with \\x1b[31m red", "wrote a\\x1b[31m.h5"]


def test_a_warning_is_one_line_without_a_place_in_the_code(tmp_path):
    recording, _ = write_recording_and_model(tmp_path)
    with h5py.File(recording, "r+") as file:
        file["data/demo_0"].attrs["operator"] = "Ada"
    command = [sys.executable, "-m", "concent_warp", "compare", str(recording)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0
    shown = [line for line in lines(done.stderr) if "loading" not in line]
    assert shown == [f"concent compare: warning: {recording}: attributes that are not read: /data/demo_0, operator"]


def test_an_unstable_simulation_leaves_no_log_file(tmp_path, monkeypatch):
    import mujoco

    from concent_warp.scene.scene import Scene

    monkeypatch.chdir(tmp_path)
    m = Scene(SCENE).model
    d = mujoco.MjData(m)
    d.qvel[:] = 1e12
    with pytest.warns(UserWarning, match="MuJoCo: .*unstable"):
        mujoco.mj_step(m, d)
    assert list(tmp_path.iterdir()) == []
