"""Bad input for every command: a part of the benchmark's cases, and inputs changed at random."""

import os
import subprocess
import sys
from collections import Counter

import pytest

from benchmarks.bad_input.all_cases import MODULES, cases
from benchmarks.bad_input.attempt import MAX_BYTES, MAX_SECONDS, Outcome, contents
from benchmarks.bad_input.case import Case
from benchmarks.bad_input.options import NEEDED
from benchmarks.bad_input.random_input import KINDS, equal, tried
from benchmarks.bad_input.sound_inputs import sound_recording
from concent_warp.cli.entry import COMMANDS

REFUSED = Case("area", "name", "compare gone.h5")
SAID = "concent compare: gone.h5: no such recording; check the path."


def test_cases_cover_all_commands_and_differ():
    found = cases()
    assert len(found) >= 400
    assert set(COMMANDS) == set(NEEDED) <= {case.command for case in found}
    assert not [case for case, count in Counter((c.area, c.name, c.line) for c in found).items() if count > 1]
    assert {case.area for case in found if case.accepted} == {"sound inputs", "surroundings"}
    assert all(next(iter(module.cases())) for module in MODULES)


@pytest.mark.timeout(300)
def test_a_part_of_the_cases_goes_as_required(tmp_path):
    """Every 60th case; a process of its own forks for each, without the threads of other tests."""
    command = [sys.executable, "-m", "benchmarks.bad_input", "--sample", "60", "--examples", "0"]
    command += ["--output", str(tmp_path / "page.md")]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, env=os.environ | {"OMP_NUM_THREADS": "1"}
    )
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "page.md").read_text()
    assert "Traceback" not in page
    assert "| **all** |" in page


@pytest.mark.parametrize("name", KINDS)
def test_inputs_changed_at_random_are_accepted_or_refused_in_one_line(tmp_path, name):
    found = tried(KINDS[name], 40, tmp_path)
    assert found.faults == []
    assert found.refused > 0


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({}, []),
        ({"code": 0}, ["exit status 0"]),
        ({"code": -11}, ["signal 11"]),
        ({"message": "Traceback (most recent call last):\n  KeyError"}, ["a traceback", "not one sentence"]),
        ({"message": SAID + "\n" + SAID}, ["not one sentence"]),
        ({"message": SAID[:-1]}, ["not one sentence"]),
        ({"message": SAID[:-1] + " no check foresaw."}, ["an unforeseen error"]),
        ({"message": ""}, ["not one sentence"]),
        ({"changed": ["inputs/out"]}, ["files changed: inputs/out"]),
        ({"seconds": MAX_SECONDS + 1}, ["11 s"]),
        ({"memory": 2 * MAX_BYTES}, ["4.0 GiB"]),
    ],
)
def test_outcomes_are_judged(change, fault):
    facts = {"code": 2, "message": SAID, "changed": [], "seconds": 1.0, "memory": 1 << 29}
    assert Outcome(REFUSED, **{**facts, **change}).faults == fault


def test_a_sound_input_is_to_be_accepted():
    sound = Case("area", "name", "compare recording.h5", accepted=True)
    assert Outcome(sound, 0, "", ["inputs/out"], 20.0, MAX_BYTES).faults == []
    assert Outcome(sound, 2, SAID, [], 1.0, 1).faults == ["refused"]


def test_changes_of_files_are_seen(tmp_path):
    (tmp_path / "a").write_text("1")
    (tmp_path / "b").mkdir()
    before = contents(tmp_path)
    (tmp_path / "a").write_text("2")
    os.mkfifo(tmp_path / "b" / "pipe")
    after = contents(tmp_path)
    assert before["a"] != after["a"]
    assert set(after) - set(before) == {"b/pipe"}


def test_recordings_are_compared_number_by_number():
    changed = sound_recording()
    assert equal(changed, sound_recording())
    changed[0].measured["elbow_angle"].value[3] += 1e-12
    assert not equal(changed, sound_recording())
