"""Trials of a policy as a recording, and what a biased tracker makes of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.deploy.explain.policy_evidence import other_action
from concent_warp.recording.recording import Recording

BIAS = (0.02, 0.0, -0.01)


@pytest.fixture(scope="module")
def policy() -> cw.Policy:
    """The insertion policy with steps so small that it cannot succeed, and short episodes."""
    return cw.load_policy("shape_sorter").scaled(0.05)


@pytest.fixture(scope="module")
def trials(policy: cw.Policy, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Two trials in Reality."""
    folder = tmp_path_factory.mktemp("trials")
    result = cw.evaluate(policy, cw.EvaluateCfg(record_failures=True), episodes=2, record=folder)
    assert result.recorded == folder / "trials.h5"
    return cw.load_recording(folder / "trials.h5")


def test_a_trial_has_readings_and_frames_at_their_own_times_and_no_truth(trials: Recording) -> None:
    trial = trials[0]
    assert (trial.success, trial.qpos, trial.qvel) == (False, None, None)
    joints, frames = trial.measured["joint2_position"], trial.measured["block_position"]
    np.testing.assert_allclose(np.diff(joints.time), 0.05)
    gaps = np.diff(frames.time) * 30
    np.testing.assert_allclose(gaps, np.round(gaps), atol=1e-3)
    assert gaps.max() > 1.5  # frames in which the block was not found are left out
    assert frames.noise_std == 1e-3
    assert trial.measured["block_orientation"].noise_std == 0.0175


def test_commands_are_those_that_the_logged_actions_make(policy: cw.Policy, trials: Recording) -> None:
    log, step = trials[0].policy, policy.run.cfg.environment.action.turn
    assert log is not None
    assert log.observation.shape[1] == 155
    moved = np.diff(trials[0].action["joint4"].value)
    np.testing.assert_allclose(moved, step * log.action[1 : len(moved) + 1, 3], atol=1e-5)


def test_the_policy_acts_as_logged_when_it_is_asked_again(policy: cw.Policy, trials: Recording) -> None:
    from concent_warp.train.environment.worlds import make_environment

    task = policy.run.task()
    cfg = replace(policy.run.cfg.environment, worlds=1)
    environment = make_environment(task, cfg, policy.run.evaluation_states(task, 1, 0), device="cpu")
    act = policy.act_in(environment)
    difference = other_action(act, 155, trials[0])
    assert difference is not None
    assert difference < 1e-4
    assert other_action(act, 148, trials[0]) == float("inf")


def test_a_log_of_another_length_is_refused(trials: Recording, tmp_path: Path) -> None:
    log = trials[0].policy
    assert log is not None
    wrong = replace(trials[0], policy=replace(log, action=log.action[1:]))
    with pytest.raises(cw.RecordingError, match="wrong shape of action"):
        cw.write_hdf5(Recording(trials.scene, (wrong,)), tmp_path / "wrong.h5")


def test_a_bias_shifts_the_frames_of_the_named_objects_only(
    policy: cw.Policy, tmp_path: Path, trials: Recording
) -> None:
    sensors = cw.SensorErrorsCfg(position_bias=BIAS, orientation_bias=(0, 0, 0.2), biased=("block",))
    result = cw.evaluate(policy, cw.EvaluateCfg(sensors=sensors), episodes=2, record=tmp_path)
    assert result.recorded is not None
    biased = cw.load_recording(result.recorded)[0]
    for name, expected in (("block_position", BIAS), ("box_position", (0, 0, 0))):
        shift = biased.measured[name].value[:5].mean(axis=0) - trials[0].measured[name].value[:5].mean(axis=0)
        np.testing.assert_allclose(shift, expected, atol=2.5e-3)


def test_an_unknown_biased_object_is_refused(policy: cw.Policy) -> None:
    sensors = cw.SensorErrorsCfg(position_bias=BIAS, biased=("lid",))
    with pytest.raises(cw.TrainError, match="poses of an unknown object are biased"):
        cw.evaluate(policy, cw.EvaluateCfg(sensors=sensors), episodes=1)


def test_trials_are_recorded_in_reality_only(policy: cw.Policy, tmp_path: Path) -> None:
    with pytest.raises(cw.TrainError, match="trials are recorded in Reality"):
        cw.evaluate(policy, world="simulation", episodes=1, record=tmp_path)
    assert not list(tmp_path.iterdir())
