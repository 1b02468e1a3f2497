"""Causes of failed trials."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.deploy.explain.cfg import JudgeCfg
from concent_warp.deploy.explain.evidence import Evidence, Judge
from concent_warp.deploy.explain.explain import _Explaining
from concent_warp.deploy.explain.failure_rate import FailureRates
from concent_warp.deploy.explain.misfit import divergence, misfit
from concent_warp.deploy.explain.own_simulation import OwnSimulation, SimulatedTrials
from concent_warp.deploy.explain.pose_bias import PoseBias
from concent_warp.deploy.explain.prepared import Preparation, PreparedTrial
from concent_warp.deploy.explain.replay_trial import ReplayedTrials
from concent_warp.diagnosis.tasks import ignore_progress
from concent_warp.recording.recording import Recording


@pytest.fixture(scope="module")
def policy() -> cw.Policy:
    return cw.load_policy("shape_sorter")


@pytest.fixture(scope="module")
def prepared(policy: cw.Policy, tmp_path_factory: pytest.TempPathFactory) -> tuple[Preparation, list[PreparedTrial]]:
    """Two trials in Reality whose tracker shows all objects 12 mm too low, made ready."""
    sensors = cw.SensorErrorsCfg(position_bias=(0.0, 0.0, -0.012))
    folder = tmp_path_factory.mktemp("biased")
    result = cw.evaluate(policy, cw.EvaluateCfg(sensors=sensors), episodes=2, record=folder)
    assert result.recorded is not None
    assert not result.success.any()
    preparation = Preparation(policy.run.task(), policy.run.model.scene.model, cw.ExplainCfg())
    return preparation, [preparation.trial(d) for d in cw.load_recording(result.recorded).demonstrations]


def test_a_start_is_moved_until_nothing_overlaps(prepared: tuple[Preparation, list[PreparedTrial]]) -> None:
    preparation, trials = prepared
    start, address = trials[0].start, preparation.contact.address
    inside = start.qpos.copy()
    inside[address : address + 3] += (0.0, 0.0, -0.002)
    settled, move = preparation.contact.settled(replace(start, qpos=inside))
    again = preparation.contact.settled(settled)[1]
    assert np.abs(again[:3]).max() < 0.3 * max(np.abs(move[:3]).max(), 1e-3)


def test_the_misfit_of_a_perfect_replay_is_that_of_noise(prepared: tuple[Preparation, list[PreparedTrial]]) -> None:
    readings = prepared[1][0].readings
    pose = readings.pose.rotation.as_quat(scalar_first=True)
    exact = ReplayedTrials(readings.joints[None], readings.pose.position[None], pose[None], np.zeros(1, bool))
    assert misfit(readings, exact, 1.0).total == pytest.approx(0.0)
    shifted = replace(exact, position=exact.position - 3 * readings.pose_std[0])
    assert misfit(readings, shifted, 1.0).position == pytest.approx(9 * np.log(2))
    bias = np.array([[*np.full(3, 3 * readings.pose_std[0]), 0, 0, 0]])
    assert misfit(readings, shifted, 1.0, bias).position == pytest.approx(0.0)


def test_windows_show_when_a_replay_leaves_the_measurements(prepared: tuple[Preparation, list[PreparedTrial]]) -> None:
    readings = prepared[1][0].readings
    pose = readings.pose.rotation.as_quat(scalar_first=True)
    joints = readings.joints + 10 * readings.joint_std * (readings.time > 1.0)[:, None]
    late = ReplayedTrials(joints[None], readings.pose.position[None], pose[None], np.zeros(1, bool))
    windows = divergence(readings, late, 2.0, 0.5)
    np.testing.assert_allclose(windows[:2], 0.0, atol=1e-6)
    assert windows[2:].min() > 4.0


def test_the_own_simulation_succeeds_from_measured_starts(
    policy: cw.Policy, prepared: tuple[Preparation, list[PreparedTrial]]
) -> None:
    start = prepared[1][0].start
    lifted = start.qpos.copy()
    lifted[prepared[0].contact.address + 2] += 0.012
    found = OwnSimulation(policy, 2, 0).run([replace(start, qpos=lifted)])
    assert found.success.shape == (1, 2)
    assert found.rate >= 0.5
    assert len(found.recording.demonstrations) == 2
    assert set(found.position) == {0, 1}


def evidence(**changes: Any) -> Evidence:
    """Evidence on eight trials of a good policy that agree with the model."""
    rng = np.random.default_rng(0)
    own = SimulatedTrials(np.ones((8, 2), bool), Recording("", ()))
    base = Evidence(
        trials=(), own=own, joint_scale=2.0, misfit=rng.uniform(0.9, 1.1, 8), usual=rng.uniform(0.9, 1.1, 16),
        free=np.full(8, 2.0), usual_free=np.full(16, 2.0), windows=(), usual_windows=(),
    )  # fmt: skip
    return replace(base, **changes)


def bias(p: float = 0.01, gain: float = 0.8, shift: float = -0.012) -> PoseBias:
    """An error of poses along the vertical that explains most of the loss."""
    value = np.array([0.0, 0.0, shift, 0.0, 0.0, 0.0])
    noise = np.repeat((1e-3, 0.0175), 3)
    return PoseBias(value, np.ones(6), noise, np.full(8, 2.0), np.full(8, 0.5), np.full(8, gain), p)


def named(family: str, gain: float) -> Any:
    """A diagnosis that accepted one effect."""
    return SimpleNamespace(accepted=(SimpleNamespace(family=family, gain=gain),))


WEAK = SimulatedTrials(np.zeros((8, 2), bool), Recording("", ()))
FAR = np.full(8, 7.0)


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({}, "unexplained"),
        ({"own": WEAK}, "policy"),
        ({"misfit": FAR, "bias": bias()}, "perception"),
        ({"bias": bias()}, "perception"),
        ({"misfit": FAR, "bias": bias(p=0.3)}, "unexplained"),
        ({"misfit": FAR, "bias": bias(gain=0.1)}, "unexplained"),
        ({"misfit": FAR, "bias": bias(shift=-0.002)}, "unexplained"),
        ({"misfit": FAR, "bias": bias(p=0.3), "free": np.full(8, 30.0)}, "physics"),
        ({"misfit": FAR[:1], "usual": np.ones(4), "free": np.full(1, 30.0)}, "physics"),
        ({"misfit": FAR, "bias": bias(p=0.3), "misfit_with_effect": np.full(8, 1.2)}, "physics"),
        ({"misfit": FAR, "bias": bias(p=0.3), "diagnosis": named("joints", 0.8)}, "physics"),
        ({"misfit": FAR, "bias": bias(p=0.3), "diagnosis": named("measurement", 0.8)}, "perception"),
        ({"misfit": FAR, "bias": bias(p=0.3), "diagnosis": named("joints", 0.2)}, "unexplained"),
        ({"misfit": FAR, "own": WEAK, "bias": bias(p=0.3)}, "policy"),
        ({"own": WEAK, "bias": bias()}, "policy"),
        ({"rates": FailureRates(6, 48, 8, 96)}, "policy"),
        ({"rates": FailureRates(6, 48, 3, 96)}, "unexplained"),
        ({"rates": FailureRates(40, 60, 35, 96)}, "unexplained"),
        ({"rates": FailureRates(2, 96, 0, 96)}, "unexplained"),
        ({"rates": FailureRates(6, 48, 8, 96), "misfit": FAR}, "unexplained"),
    ],
)  # fmt: skip
def test_the_cause_follows_from_the_evidence(policy: cw.Policy, changes: dict[str, Any], cause: str) -> None:
    assert Judge(policy, policy.run.task(), JudgeCfg()).cause(evidence(**changes)) == cause


@pytest.mark.parametrize(
    ("rate", "misfit_of_trials", "free", "doubted"),
    [(0.0, 6.0, 2.0, True), (0.0, 1.2, 2.0, False), (1.0, 6.0, 2.0, True), (1.0, 6.0, 30.0, False)],
)
def test_poses_are_doubted_unless_the_policy_fails_from_credible_starts_or_free_motion_differs(
    policy: cw.Policy, rate: float, misfit_of_trials: float, free: float, doubted: bool
) -> None:
    own = SimulatedTrials(np.full((8, 2), bool(rate)), Recording("", ()))
    given = evidence(misfit=np.full(8, misfit_of_trials), own=own, free=np.full(8, free))
    assert Judge(policy, policy.run.task(), JudgeCfg()).doubts_poses(given) == doubted


def test_free_motion_ends_before_the_object_comes_near_anything(
    policy: cw.Policy, prepared: tuple[Preparation, list[PreparedTrial]], tmp_path: Path
) -> None:
    touching, moving = prepared[1]
    moving = replace(moving, free_error=9.0, free_time=0.6)
    assert touching.free_error is None  # 12 mm too low, it touches from the start
    given = Recording(policy.run.recording.scene, (moving.demonstration,))
    explaining = _Explaining(policy, [given], cw.ExplainCfg(), ignore_progress, tmp_path / "out")
    found = explaining._free_motion([touching, moving])
    assert explaining._write(found) == str(tmp_path / "out" / "free_motion.h5")
    assert cw.load_recording(tmp_path / "out" / "free_motion.h5")[0].measured.keys() == found[0].measured.keys()
    assert len(found.demonstrations) == 1
    ends = [float(channel.time[-1]) for channel in found.demonstrations[0].measured.values()]
    assert 0.4 < max(ends) <= 0.6 < moving.readings.end


@pytest.mark.parametrize(("effects", "moving"), [((), 7), (("joint_damping",), 7), (("pad_friction",), 15)])
def test_effects_are_searched_for_in_the_arm_alone_unless_one_wants_the_object(
    policy: cw.Policy,
    prepared: tuple[Preparation, list[PreparedTrial]],
    monkeypatch: pytest.MonkeyPatch,
    effects: tuple[str, ...],
    moving: int,
) -> None:
    found: list[tuple[int, set[str]]] = []

    class AskedError(Exception):
        """Ends the explanation where the diagnosis begins."""

    def asked(model: cw.Model, recording: Recording, *_: Any, **__: Any) -> None:
        model.check_recording(recording)
        found.append((model.compile().nv, set(recording[0].measured)))
        raise AskedError

    monkeypatch.setattr("concent_warp.deploy.explain.explain.diagnose", asked)
    trial = replace(prepared[1][1], free_error=9.0, free_time=0.6)
    given = Recording(policy.run.recording.scene, (trial.demonstration,))
    explaining = _Explaining(policy, [given], cw.ExplainCfg(effects=effects), ignore_progress, None)
    judge: Any = SimpleNamespace(moves_otherwise=lambda _: True)
    with pytest.raises(AskedError):
        explaining._with_diagnosis(evidence(trials=[trial]), judge, [])
    assert found[0][0] == moving
    assert ("block_position" in found[0][1]) == (moving == 15)


def test_the_model_with_the_missing_effect_is_kept_unless_it_has_other_constants_too(
    policy: cw.Policy, prepared: tuple[Preparation, list[PreparedTrial]], tmp_path: Path
) -> None:
    given = Recording(policy.run.recording.scene, (prepared[1][1].demonstration,))
    better = policy.run.model.add_effect("actuator_delay", values={"delay": 0.03})
    as_given = {"accepted": ("one",), "changes_model": True, "model": better, "time_step": None, "holding": ()}
    found: Any = SimpleNamespace(**as_given)
    explaining = _Explaining(policy, [given], cw.ExplainCfg(), ignore_progress, tmp_path / "out")
    assert explaining._save(found, in_arm_alone=True) == str(tmp_path / "out" / "with_effects.toml")
    (effect,) = cw.load_model(tmp_path / "out" / "with_effects.toml").effects
    assert effect.values == (0.03,)
    unchanged: Any = SimpleNamespace(**as_given | {"changes_model": False})
    assert explaining._save(unchanged, in_arm_alone=True) is None
    shorter: Any = SimpleNamespace(**as_given | {"time_step": "half"})
    assert explaining._save(shorter, in_arm_alone=True) is None
    assert explaining._save(shorter, in_arm_alone=False) is not None
    assert _Explaining(policy, [given], cw.ExplainCfg(), ignore_progress, None)._save(found, in_arm_alone=True) is None


def test_trials_that_all_succeeded_are_refused(
    policy: cw.Policy, prepared: tuple[Preparation, list[PreparedTrial]]
) -> None:
    trial = replace(prepared[1][0].demonstration, success=True)
    recording = Recording(policy.run.model.scene.xml, (trial,), "good")
    with pytest.raises(cw.RecordingError, match="no trial failed"):
        cw.explain(policy, recording)


def test_few_trials_are_simulated_often_enough_to_be_judged(policy: cw.Policy, tmp_path: Path) -> None:
    slow = policy.scaled(action_scale=0.05)
    recorded = cw.evaluate(slow, episodes=1, device="cpu", record=tmp_path).recorded
    assert recorded is not None
    trials = cw.load_recording(recorded)
    found = cw.explain(slow, trials, cw.ExplainCfg(repetitions=1, simulated=4, diagnose=False))
    assert "of 4 episodes" in found.remarks[0]


def test_a_trial_without_tracked_poses_is_refused(
    policy: cw.Policy, prepared: tuple[Preparation, list[PreparedTrial]]
) -> None:
    trial = prepared[1][0].demonstration
    measured = {name: c for name, c in trial.measured.items() if not name.startswith("block")}
    recording = Recording(policy.run.model.scene.xml, (replace(trial, measured=measured),), "blind")
    with pytest.raises(cw.RecordingError, match="manipulated object was not tracked"):
        cw.explain(policy, recording)


def test_a_trial_that_agrees_is_the_policys_where_that_fails_from_the_other_starts(
    policy: cw.Policy, prepared: tuple[Preparation, list[PreparedTrial]]
) -> None:
    trials = prepared[1]
    success = np.array([[False] * 4, [True] * 4])
    own = SimulatedTrials(success, Recording("", ()), {k: np.zeros((400, 3)) for k in range(8)})
    windows = [np.ones(8)] * 2
    of_both = evidence(trials=trials, own=own, misfit=np.ones(2), windows=windows, usual_windows=windows)
    found = Judge(policy, policy.run.task(), JudgeCfg()).explanation(of_both, ["a", "b"], 2, 2)
    assert [t.cause for t in found.trials] == ["policy", "policy"]
    assert "fails in its own simulation too" in found.trials[0].sentence
    assert "now and then" in found.trials[1].sentence
    differing = replace(of_both, misfit=np.array([1.0, 9.0]))
    found = Judge(policy, policy.run.task(), JudgeCfg()).explanation(differing, ["a", "b"], 2, 2)
    assert [t.cause for t in found.trials] == ["policy", "unexplained"]


def test_failures_are_counted_in_all_trials_and_in_the_own_simulation_from_their_starts(
    policy: cw.Policy, tmp_path: Path
) -> None:
    result = cw.evaluate(policy, episodes=3, record=tmp_path)
    assert result.recorded is not None
    assert result.success.all()
    recording = cw.load_recording(result.recorded)
    first, *others = recording.demonstrations
    recording = replace(recording, demonstrations=(replace(first, success=False), *others))
    settings = cw.ExplainCfg(repetitions=1, simulated=3, judge=JudgeCfg(rate_trials=2))
    rates = _Explaining(policy, [recording], settings, ignore_progress, None)._with_rates(evidence()).rates
    assert rates is not None
    assert (rates.failed, rates.trials, rates.simulated) == (1, 3, 2)
    assert not rates.agree(JudgeCfg())
    failed = replace(recording, demonstrations=recording.demonstrations[:1])
    assert _Explaining(policy, [failed], settings, ignore_progress, None)._with_rates(evidence()).rates is None
