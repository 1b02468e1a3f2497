import numpy as np
import pytest

from concent_warp.diagnosis.suggestion.cfg import MotionLimitsCfg, SuggestCfg
from concent_warp.diagnosis.suggestion.evaluations import Evaluations, key_of
from concent_warp.diagnosis.suggestion.evolution import DiagonalEvolution
from concent_warp.diagnosis.suggestion.trajectories import families
from concent_warp.reality.rigs.registry import RIGS
from concent_warp.reality.rigs.rig import record_rig
from tests.diagnosis.suggestion.carts import one_speed, recorded_range

RNG = np.random.default_rng(0)
PUSH = recorded_range(record_rig(RIGS["push"], (), 1, 0))
SLIDE = recorded_range(record_rig(RIGS["slide"], (), 1, 0))


@pytest.mark.parametrize("speed", [1.0, 0.3])
def test_fourier_series_keep_to_the_recorded_range_and_speed_from_rest_to_rest(speed):
    recorded = recorded_range(one_speed())
    (family,) = families(recorded, SuggestCfg(duration=4.0, limits=MotionLimitsCfg(speed=speed)), "mujoco")
    for _ in range(20):
        motion = family.candidate(2 * RNG.normal(size=family.size), "optimised").motions[0]
        command = motion.action["drive"]
        value = command.value.ravel()
        assert np.abs(value).max() <= 0.1 + 1e-9
        assert np.abs(np.diff(value) / np.diff(command.time)).max() <= speed * 0.1 * 1.02
        assert value[0] == pytest.approx(0.0, abs=1e-9)
        assert value[-1] == pytest.approx(0.0, abs=1e-9)
        assert motion.duration == pytest.approx(4.0)


def test_commands_that_meet_objects_are_repeated_nearly():
    family = families(PUSH, SuggestCfg(), "mujoco")[0]
    motion = family.candidate(RNG.normal(size=family.size), "optimised").motions[0]
    recorded = PUSH.longest.action["drive_x"].value.ravel()
    value = motion.action["drive_x"].value
    assert family.name == "varied repetition"
    assert recorded.min() - 1e-9 <= value.min()
    assert value.max() <= recorded.max() + 1e-9
    assert motion.duration <= SuggestCfg().duration


def test_throws_are_no_faster_than_recorded_ones():
    (family,) = families(SLIDE, SuggestCfg(), "mujoco")
    fastest = max(np.linalg.norm(v[:3]) for _, v in SLIDE.states)
    for _ in range(5):
        motions = family.candidate(2 * RNG.normal(size=family.size), "optimised").motions
        assert len(motions) == SuggestCfg().trajectory.throws
        assert all(np.linalg.norm(motion.qvel[:3]) <= fastest + 1e-9 for motion in motions)


def test_the_evolution_finds_the_top_of_a_hill():
    target = np.array([1.0, -2.0, 0.5, 0.0])
    evolution = DiagonalEvolution(4, 12, np.random.default_rng(1))
    for _ in range(60):
        samples = evolution.ask()
        evolution.tell(samples, -(((samples - target) * [1, 3, 1, 10]) ** 2).sum(axis=1))
    assert evolution.mean == pytest.approx(target, abs=0.05)


def test_results_are_read_again_though_the_last_line_was_cut_off(tmp_path):
    path = tmp_path / "evaluations.jsonl"
    Evaluations(path).add(key_of("a", 1.0), [1.0, 2.0])
    with path.open("a") as file:
        file.write('\n{"key": "b", "fou')
    again = Evaluations(path)
    assert again.known == {key_of("a", 1.0): [1.0, 2.0]}
    again.add("c", 3)
    assert set(Evaluations(path).known) == {key_of("a", 1.0), "c"}
