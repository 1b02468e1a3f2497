import json
from dataclasses import replace

import numpy as np
import pytest

from concent_warp.diagnosis.experiment.joint_motions import Drives, commanded_motion
from concent_warp.diagnosis.suggestion.forecast import Forecast, courses, forecasts
from concent_warp.fit.effects.prediction import Prediction
from tests.diagnosis.suggestion.carts import NOISE, friction_or_damping, one_speed, recorded_range

RECORDING = one_speed()
RECORDED = recorded_range(RECORDING)


def motion(speed, seconds=2.0):
    drives = Drives.of(RECORDED)
    assert drives is not None
    time = np.arange(0, seconds, 0.01)
    return commanded_motion(RECORDED, drives, "sweep", "sweep", speed * time[:, None])


def forecast(hypotheses, *motions, starts=False):
    moved = courses(hypotheses, RECORDED, motions, "mujoco")
    pairs = [[(motion, course) for motion, course in zip(motions, moved, strict=True) if course is not None]]
    (found,) = forecasts(hypotheses, RECORDED, pairs, "mujoco", window=2.0, step=0.1, starts=starts)
    assert found is not None
    return found


def test_evidence_without_a_refit_is_half_the_squared_difference_over_the_noise():
    hypotheses = friction_or_damping(RECORDING)
    (moved,) = courses(hypotheses, RECORDED, [motion(0.02)], "mujoco")
    assert moved is not None
    rows = np.round(np.arange(0, 2, 0.01) / 0.004 - 1e-9).astype(int)
    apart = np.interp(np.arange(0, 2, 0.01), moved.time, moved.qpos[0, :, 0] - moved.qpos[1, :, 0]) / NOISE
    found = forecast(hypotheses, motion(0.02))
    assert found.count == len(rows)
    assert found.evidence[0, 1] == pytest.approx(0.5 * (apart**2).sum(), rel=1e-2)
    assert found.separation[0, 1] == pytest.approx(np.sqrt((apart**2).mean()), rel=1e-2)
    assert found.channels[0][1] == "rail_position"


def test_a_refit_absorbs_what_the_data_leave_open():
    fixed = forecast(friction_or_damping(RECORDING), motion(0.02)).evidence[0, 1]
    close = forecast(friction_or_damping(RECORDING, std=0.05), motion(0.02)).evidence[0, 1]
    wide = forecast(friction_or_damping(RECORDING, std=50.0), motion(0.02)).evidence[0, 1]
    assert wide < close < fixed
    assert wide < 0.1 * fixed


def test_the_recorded_speed_tells_less_than_another_one_once_refitted():
    same = forecast(friction_or_damping(RECORDING, std=50.0), motion(0.1)).evidence[0, 1]
    both = forecast(friction_or_damping(RECORDING, std=50.0), motion(0.1), motion(0.02)).evidence[0, 1]
    assert both > 5 * same


def test_unknown_initial_states_take_up_evidence():
    hypotheses = friction_or_damping(RECORDING)
    known = forecast(hypotheses, motion(0.02)).evidence[0, 1]
    assert forecast(hypotheses, motion(0.02), starts=True).evidence[0, 1] < known


def test_scores_grow_with_the_least_of_the_evidence():
    found = forecast(friction_or_damping(RECORDING), motion(0.02))
    assert found.score(1.0, 0.01) > found.score(10.0, 0.01)
    confused = found.evidence.copy()
    confused[0, 1] = 0.0
    assert type(found)(confused, found.separation, found.channels, found.count).score(1.0, 0.01) < found.score(
        1.0, 0.01
    )


def test_evidence_of_many_readings_by_a_small_difference_counts_less():
    found = forecast(friction_or_damping(RECORDING), motion(0.02))
    least = min(found.separation[0, 1], found.separation[1, 0])
    assert found.score(1.0, 0.5 * least) == found.score(1.0, least) > found.score(1.0, 10 * least)
    assert found.decides(1e-6, least)
    assert not found.decides(1e-6, 1.01 * least)
    assert not found.decides(1e9, least)


def test_what_courses_tell_is_not_simulated_again(monkeypatch):
    hypotheses, motions = friction_or_damping(RECORDING, std=0.05), [motion(0.02), motion(0.05)]
    moved = courses(hypotheses, RECORDED, motions, "mujoco")
    candidates = [[(one, course)] for one, course in zip(motions, moved, strict=True) if course is not None]
    counts, simulate = [], Prediction.courses
    monkeypatch.setattr(
        Prediction, "courses", lambda self, trials, *args: counts.append(len(trials)) or simulate(self, trials, *args)
    )

    def made(parts):
        counts.clear()
        found = forecasts(hypotheses, RECORDED, parts, "mujoco", window=2.0, step=0.1, starts=False)
        return [one for one in found if one is not None], sum(counts)

    short, count = made(candidates)
    assert count == len(motions) * len(hypotheses)
    whole, count = made([[(one, replace(course, readings=()))] for ((one, course),) in candidates])
    assert count == 2 * len(motions) * len(hypotheses)
    for a, b in zip(short, whole, strict=True):
        assert a.evidence == pytest.approx(b.evidence, rel=1e-9)
        assert Forecast.of(json.loads(json.dumps(a.plain()))).evidence == pytest.approx(a.evidence)
