import json
from collections import Counter

import numpy as np
import pytest

from benchmarks.foreign import __main__ as command
from benchmarks.foreign import study
from benchmarks.foreign.cases import all_cases, is_locked
from benchmarks.foreign.log import KINDS, Log, Recorded, Table
from benchmarks.foreign.scoring import KEPT, page, score
from concent_warp.effects.registry import effect_class
from concent_warp.recording.load import load_recording


def row(kind="single", verdict="effect", named=(("mass",),), accepted=(("mass", "inertia"),), **more):
    groups = [list(group) for group in named]
    known = {"name": "a-b", "machine": "a", "kind": kind, "accepted": [list(names) for names in accepted]}
    times = {"seconds": 2.0, "processor_seconds": 3.0, "commit": "0123456789ab", "locked": False, "ratio": [2.0, 1.0]}
    return known | times | {"verdict": verdict, "groups": groups} | more


@pytest.mark.parametrize(
    ("result", "expected"),
    [
        (row(), "right"),
        (row(named=(("inertia(rod, axis_x)", "armature"),)), "right"),
        (row(named=(("size", "armature"),)), "wrong"),
        (row(named=(("mass", "armature", "size"),)), "wrong"),  # a group of three names nothing
        (row(named=(("mass",), ("size",))), "wrong"),
        (row(verdict="none_of_these"), "wrong"),
        (row(verdict="unsettled"), "unsettled"),
        ({**row(), "error": "time-out"}, "unsettled"),
        (row("pair", accepted=(("mass",), ("size",)), named=(("size",), ("mass", "inertia"))), "right"),
        (row("pair", accepted=(("mass",), ("size",)), named=(("size",), ("size",))), "wrong"),
        (row("null", "none_needed", (), ()), "right"),
        (row("null", "effect", (("mass",),), ()), "wrong"),
        (row("outside", "none_of_these", (("mass",),), ()), "right"),
        (row("outside", "none_needed", (), ()), "wrong"),
    ],
)
def test_an_answer_is_right_where_it_names_what_is_hidden_and_nothing_else(result, expected):
    assert score(result) == expected


def test_names_that_count_are_effects_of_the_library_and_a_part_of_the_machines_is_locked():
    cases = all_cases()
    for case in cases:
        assert len(case.accepted) == {"null": 0, "outside": 0, "single": 1, "pair": 2}[case.kind]
        for name in (name for names in case.accepted for name in names):
            effect_class(name)
    assert {kind for case in cases for kind in [case.kind]} == set(KINDS)
    locked = Counter(is_locked(machine) for machine in {case.machine for case in cases})
    assert min(locked[True], locked[False]) >= 5


def test_a_log_is_read_back_as_it_was_written(tmp_path):
    time = np.arange(5) / 100
    model = (
        "<mujoco><worldbody><body name='b'><joint name='j' axis='0 1 0'/><geom size='0.1'/></body></worldbody>"
        "<actuator><motor name='m' joint='j'/></actuator><sensor><jointpos name='q' joint='j'/></sensor></mujoco>"
    )
    angle = np.array([0.0, 0.1, np.nan, 0.3, 0.4])
    motion = Recorded({"q": Table(time, {"q": angle})}, {"m": Table(time, {"m": 2 * time})})
    Log(model, (motion, motion), {"q": 1e-3}).write(tmp_path / "log")
    found = load_recording(tmp_path / "log")
    assert len(found.demonstrations) == 2
    for demonstration in found.demonstrations:
        np.testing.assert_allclose(demonstration.measured["q"].value.ravel(), angle)
        np.testing.assert_allclose(demonstration.action["m"].value.ravel(), 2 * time)
        assert demonstration.measured["q"].noise_std == pytest.approx(1e-3)


def test_a_log_is_diagnosed_by_a_process_of_its_own_and_the_page_has_it(tmp_path):
    (case,) = [case for case in all_cases() if case.name == "hoist-null"]
    args = command.Args(names=(case.name,), out=tmp_path, cores=1)
    result = command.in_process(case, args, "0123456789ab")
    assert (result["verdict"], score(result)) == ("none_needed", "right")
    assert result["noise_stated"] is True  # as this log states it
    text = page([result, row("single", "none_needed", ())], "Measured somewhere.", 2)
    assert "50 %" in text
    assert "`a-b`" in text
    assert "`hoist-null`" not in text
    assert set(KEPT) >= set(study.described(case)) - {"cause"}
    with pytest.raises(SystemExit, match="has no no_such"):
        command.main(command.Args(names=("no_such",)))
    with pytest.raises(SystemExit, match="no results in"):
        command.main(command.Args(report=True, results=(tmp_path / "empty",)))
    assert json.loads((tmp_path / "hoist-null.json").read_text())["commit"] == "0123456789ab"
