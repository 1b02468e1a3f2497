"""Inputs are checked before warp and torch are imported, which takes seconds."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from concent_warp.cli import main
from concent_warp.cli.entry import COMMANDS

PROBE = """
import json, os, sys
import h5py, mujoco, scipy.optimize, scipy.spatial, tyro  # not heavy, and imported once for all cases
from concent_warp.cli.entry import main

def tell(folder, words):
    os.chdir(folder)
    for number, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(folder + "." + name, os.O_WRONLY | os.O_CREAT), number)
    code = main(words)
    print("imported:", *(name for name in ("torch", "warp") if name in sys.modules), flush=True)
    return code

codes = []
for folder, line in json.loads(sys.argv[1]):
    child, code = os.fork(), 70
    if not child:
        try:
            code = tell(folder, line.split())
        finally:
            os._exit(code)
    codes.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
print(json.dumps(codes))
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


@pytest.fixture(scope="module")
def told(bench, tmp_path_factory) -> dict[str, tuple[int, Path, list[Path]]]:
    """Return the exit code of each case, its folder with what it said beside it, and the files that were in it."""
    folders, before = {}, {}
    for line, _ in CASES:
        folder = folders[line] = tmp_path_factory.mktemp("case")
        for path in bench.iterdir():
            if path.is_file():
                (folder / path.name).symlink_to(path)
        (folder / "text.pt").write_text("no checkpoint")
        (folder / "other").mkdir()
        (folder / "other" / "notes.txt").write_text("notes")
        before[line] = sorted(folder.rglob("*"))
    cases = json.dumps([(str(folder), line) for line, folder in folders.items()])
    done = subprocess.run(
        [sys.executable, "-c", PROBE, cases], capture_output=True, text=True, check=True,
        env=os.environ | {"PYTHONWARNINGS": "ignore"},
    )  # fmt: skip
    codes = json.loads(done.stdout)
    return {line: (code, folders[line], before[line]) for (line, _), code in zip(CASES, codes, strict=True)}


@pytest.mark.parametrize(("line", "words"), CASES, ids=[line for line, _ in CASES])
def test_inputs_are_checked_before_heavy_imports(line, words, told):
    code, folder, before = told[line]
    said = [one for one in Path(f"{folder}.err").read_text().splitlines() if "loading" not in one]
    assert code == 2
    assert len(said) == 1
    assert words in said[0]
    assert Path(f"{folder}.out").read_text() == "imported:\n"
    assert sorted(folder.rglob("*")) == before


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
