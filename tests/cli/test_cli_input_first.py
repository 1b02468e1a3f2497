"""Inputs are checked before warp and torch are imported, which takes seconds."""

import os
import subprocess
import sys

import pytest

from concent_warp.cli import main
from concent_warp.cli.entry import COMMANDS

PROBE = """
import sys
from concent_warp.cli.entry import main

code = main(sys.argv[1:])
print("imported:", *(name for name in ("torch", "warp") if name in sys.modules))
sys.exit(code)
"""
CASES = [
    ("evaluate", "one policy is to be run; expected either --checkpoint"),
    ("evaluate --checkpoint nowhere", "nowhere: no such training"),
    ("evaluate --checkpoint text.pt", "text.pt: not a checkpoint"),
    ("evaluate --checkpoint other", "other: the folder holds no training"),
    ("evaluate --pretrained nothing", "no such policy comes with the package"),
    ("evaluate --pretrained --out text.pt", "text.pt: this is a file"),
    ("distil nobody", "no such policy comes with the package"),
    ("distil other", "other: the folder holds no training"),
    ("distil shape_sorter -o other", "other: the folder holds other things than a run"),
    ("export", "one policy is to be run"),
    ("export --checkpoint nowhere", "no such training"),
    ("export --pretrained -o demo.h5", "demo.h5: the file exists"),
    ("export --pretrained -o text.pt/policy.onnx", "text.pt: this is a file"),
    ("export --pretrained --as-pretrained -o text.pt", "text.pt: this is a file"),
    ("play", "one policy is to be run"),
    ("play --checkpoint other", "the folder holds no training"),
    ("render", "expected either --recording, or --checkpoint or --pretrained"),
    ("render --recording nowhere.h5", "nowhere.h5: no such recording"),
    ("render --checkpoint nowhere", "no such training"),
    ("render --pretrained -o other", "other: the folder holds other things than a run"),
    ("render --pretrained --networks nowhere", "nowhere: there are no trained networks"),
    ("splat-fit nowhere", "no posed images"),
    ("splat-fit other -o text.pt", "text.pt: this is a file"),
    ("render-train nowhere.h5", "no such recording"),
    ("render-train demo.h5 -o other", "other: the folder holds other things than a run"),
    ("train nowhere.h5 --model inset.toml", "no such recording"),
    ("train demo.h5 --model nowhere.toml", "no such model"),
    ("train demo.h5 --model inset.toml --events nowhere.json", "nowhere.json"),
    ("train demo.h5 --model inset.toml --begin-with nowhere", "no such training"),
    ("train demo.h5 --model inset.toml -o text.pt", "text.pt: this is a file"),
]


@pytest.mark.parametrize(("line", "words"), CASES, ids=[line for line, _ in CASES])
def test_inputs_are_checked_before_heavy_imports(line, words, bench, tmp_path):
    for path in bench.iterdir():
        if path.is_file():
            (tmp_path / path.name).symlink_to(path)
    (tmp_path / "text.pt").write_text("no checkpoint")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("notes")
    before = sorted(tmp_path.rglob("*"))
    done = subprocess.run(
        [sys.executable, "-c", PROBE, *line.split()], capture_output=True, text=True, cwd=tmp_path, check=False,
        env=os.environ | {"PYTHONWARNINGS": "ignore"},
    )  # fmt: skip
    said = [one for one in done.stderr.splitlines() if "loading" not in one]
    assert done.returncode == 2
    assert len(said) == 1
    assert words in said[0]
    assert done.stdout == "imported:\n"
    assert sorted(tmp_path.rglob("*")) == before


def test_all_commands_that_import_torch_are_tried():
    heavy = {"distil", "evaluate", "export", "play", "render", "splat-fit", "render-train", "train"}
    assert {line.split()[0] for line, _ in CASES} == heavy
    assert heavy < set(COMMANDS)


def test_videos_that_cannot_be_written_are_refused_before_the_episodes(capsys):
    line = "evaluate --pretrained --world reality --episodes 1 --videos 1 --device cpu --out /proc/nothing/videos"
    assert main(line.split()) == 2
    said = [one for one in capsys.readouterr().err.splitlines() if "loading" not in one]
    assert len(said) == 1
    assert "/proc/nothing/videos: the folder cannot be made" in said[0]
