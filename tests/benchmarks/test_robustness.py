"""Commands that are killed, that find the disk full, and that are started twice: a few of each benchmark."""

import signal
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.robustness import at_once, disk_full, killed
from benchmarks.robustness.commands import SERVO_MODEL, WRITING, Ended, Writing, ended, launch, prepare
from benchmarks.robustness.contents import hashes, unfinished, unreadable
from benchmarks.robustness.page import page

COMMANDS = {writing.name: writing for writing in WRITING}
QUICK = ("add", pytest.param("compare", marks=pytest.mark.slow))  # which writes as "add" does


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    prepare(folder, [SERVO_MODEL])
    return folder


def test_every_command_with_an_output_is_measured():
    from concent_warp.cli.entry import COMMANDS as ALL

    assert {name.split(",")[0] for name in COMMANDS} == set(ALL) - {"play"}


@pytest.mark.parametrize("name", QUICK)
def test_a_full_disk_is_one_sentence_and_the_earlier_files_are_whole(inputs, name):
    trials = disk_full.measure(COMMANDS[name], inputs, (0.0, 0.5))
    assert [(t["code"], t["faults"]) for t in trials] == [(2, []), (2, [])]
    assert all("the file cannot be written" in t["said"] for t in trials)


def test_of_two_at_once_one_succeeds(inputs):
    found = at_once.measure(COMMANDS["add"], inputs)
    assert found["new"] == {"succeeded": 1, "said": found["new"]["said"], "faults": []}
    assert found["overwrite"]["faults"] == []


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_diagnosis_killed_at_a_late_moment_gives_the_same_result(inputs, tmp_path, jobs):
    writing = Writing("diagnose", killed.DIAGNOSE.replace("--jobs 2", f"--jobs {jobs}").replace(" backlash", ""))
    diagnose = replace(killed.KILLABLE["diagnose"], writing=writing)
    assert f"--jobs {jobs}" in diagnose.writing.line
    (tmp_path / "out").mkdir()
    whole = diagnose.finish(inputs, tmp_path, resumed=False)
    assert whole.code == 0
    row = killed.trial(diagnose, inputs, tmp_path, iter([0.8 * whole.seconds, 3.0, 2.0]), whole.seconds)
    assert {name: row[name] for name in ("resumed", "corrupt", "left", "differs")} == {
        "resumed": True, "corrupt": [], "left": [], "differs": [],
    }  # fmt: skip


def test_a_terminated_diagnosis_leaves_neither_processes_nor_shared_memory(inputs, tmp_path):
    words = killed.KILLABLE["diagnose"].writing.words(inputs, tmp_path / "out")
    process = launch(words, tmp_path, "last")
    begun = time.monotonic()
    while not list(tmp_path.glob("out/*.npz")) and time.monotonic() - begun < 120:
        time.sleep(0.05)
    started = killed.descendants(process.pid)
    assert len(started) > 2
    process.send_signal(signal.SIGTERM)
    done = ended(process, tmp_path, "last", begun)
    assert done.code == 143
    assert done.said[-1].startswith("concent diagnose: terminated. Finished parts are kept; continue with: concent ")
    until = time.monotonic() + 30
    while left(process.pid, started) and time.monotonic() < until:
        time.sleep(0.1)
    assert left(process.pid, started) == []
    assert not list(tmp_path.glob("MUJOCO_LOG.TXT"))


def left(pid: int, started: list[int]) -> list[str]:
    """Return what is left of a process: those that it started, and temporary files that bear its number."""
    alive = [str(one) for one in started if one != pid and Path(f"/proc/{one}/exe").exists()]
    places = (Path("/dev/shm"), Path(tempfile.gettempdir()))
    return alive + [path.name for place in places for path in place.glob(f"*[-_]{pid}[-_]*")]


def result(out: Path, code: int, *said: str) -> Ended:
    return Ended(code, "", [line.format(out=out) for line in said], 1.0)


def test_what_is_wrong_after_a_full_disk_is_found(tmp_path):
    (tmp_path / "a").write_text("a")
    before = hashes(tmp_path)
    sentence = "concent fit: {out}/a: the file cannot be written."

    def faults(code, *said):
        return disk_full.judged(result(tmp_path, code, *said), tmp_path, before)["faults"]

    assert faults(2, sentence) == faults(2, "concent fit: warning: few readings", sentence) == []
    assert faults(-11) == ["status -11", "no path in the sentence", "0 sentences"]
    assert faults(2, sentence, sentence) == ["2 sentences"]
    assert faults(1, "Traceback", sentence) == ["traceback", "2 sentences"]
    (tmp_path / "a").write_text("b")
    (tmp_path / ".run.new").mkdir()
    (tmp_path / ".run.new" / "checkpoint.pt").touch()
    (tmp_path / ".a.partial").touch()
    left = ["changed: a", "left: .a.partial", "left: .run.new/checkpoint.pt", "part left: .a.partial"]
    assert faults(2, sentence) == left
    assert faults(2, sentence + " continue with `concent fit --resume`") == [left[0], left[1], left[3]]


def test_what_is_wrong_after_two_at_once_is_found(tmp_path):
    refused = result(tmp_path, 2, "concent fit: {out}/a: another command is writing to this place.")
    done = result(tmp_path, 0)

    def faults(*found, **options):
        return at_once.judged(list(found), tmp_path, **options)["faults"]

    assert faults(done, refused) == []
    assert faults(done, done) == ["2 succeeded"]
    assert faults(done, done, replacing=True) == []
    assert faults(refused, refused) == ["0 succeeded"]
    other = result(tmp_path, 1, "concent fit: KeyError.")
    assert faults(done, other) == ["status 1", "said: concent fit: KeyError.", "no path in the sentence"]
    (tmp_path / "a.json").write_text("[1,")
    (tmp_path / ".b.partial").touch()
    assert faults(done, refused) == ["unreadable: a.json", "part left: .b.partial"]


def test_files_cut_short_are_unreadable(tmp_path):
    (tmp_path / "curve.jsonl").write_text('{"a": 1}\n{"a"')
    (tmp_path / "demo.h5").write_bytes(b"\x89HDF\r\n")
    (tmp_path / "checkpoint.pt").write_bytes(b"PK")
    (tmp_path / "model.toml").write_text("a = 1\n")
    (tmp_path / "events.out.tfevents.1").write_bytes(b"a")
    (tmp_path / ".x.npz.partial").write_bytes(b"a")
    assert unreadable(tmp_path) == ["checkpoint.pt", "curve.jsonl", "demo.h5"]
    assert unfinished(tmp_path) == [".x.npz.partial"]


def test_moments_are_repeatable_spread_over_the_run_and_earlier_each_time():
    first = [next(killed.moments_of(0, "fit", k, 10.0)) for k in range(200)]
    assert first == [next(killed.moments_of(0, "fit", k, 10.0)) for k in range(200)]
    assert min(first) < 0.5
    assert max(first) > 9.5
    moments = killed.moments_of(0, "fit", 0, 10.0)
    found = [next(moments) for _ in range(5)]
    assert found == sorted(found, reverse=True)


def test_page_counts_what_is_sound():
    facts = {"date": "2026-11-23", "processor": "P", "cores": 2, "python": "3"}
    facts |= dict.fromkeys(("mujoco", "mujoco-warp", "warp-lang", "torch"), "1")
    sound = {"share": 0.5, "code": 2, "said": "full", "faults": []}
    trial = {"after": 1.0, "files": 2, "resumed": True, "corrupt": [], "differs": [], "left": []}
    once = {"succeeded": 1, "said": ["busy"], "faults": []}
    text = page(
        {
            "killed": {"machine": facts, "seconds": {"fit": 4.0},
                       "trials": {"fit": [trial, {**trial, "corrupt": ["a"], "differs": ["a"]}]}},
            "disk full": {"machine": facts, "commands": {"fit": {"trials": [sound, {**sound, "faults": ["left: a"]}]}}},
            "at once": {"machine": facts, "commands": {"fit": {"new": once, "overwrite": once}}},
        }
    )  # fmt: skip
    assert "**2 of 2 runs were resumed, 1 files were corrupt, 1 of 2 results are the same.**" in text
    assert "**1 of 2 runs are sound**" in text
    assert "| fit | 2, 2 | 1 of 2 |  | left: a |" in text
    assert "**1 of 1 commands are sound**" in text
