"""Errors of tracked poses are found in short windows of real trials, and not where there are none."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import concent_warp as cw
from concent_warp.deploy.explain.cfg import ContactStartCfg, JudgeCfg, PoseBiasCfg, WindowsCfg
from concent_warp.deploy.explain.contact_start import moved
from concent_warp.deploy.explain.contact_windows import TrialWindows, WindowSimulation
from concent_warp.deploy.explain.grasp_fit import GraspFit
from concent_warp.deploy.explain.pose_bias import PoseBias, PoseBiasSearch, sign_flip
from concent_warp.deploy.explain.prepared import Preparation

SHIFT = 0.01
"""Error of the block's position along x [m]."""
SMALL = PoseBiasCfg(positions=(0.01,), orientations=(), samples=8, elite=3, iterations=3, last_iterations=2)


@pytest.fixture(scope="module")
def policy() -> cw.Policy:
    return cw.load_policy("shape_sorter")


def windows_of(
    policy: cw.Policy, folder: Path, cfg: cw.EvaluateCfg, seed: int
) -> tuple[WindowSimulation, list[TrialWindows]]:
    """Windows of four trials in Reality."""
    recorded = cw.evaluate(policy, cfg, episodes=4, seed=seed, record=folder).recorded
    assert recorded is not None
    preparation = Preparation(policy.run.task(), policy.run.model.scene.model, cw.ExplainCfg())
    simulation = WindowSimulation(policy.run.model, preparation.task, WindowsCfg(most=5), ContactStartCfg())
    trials = [preparation.trial(d) for d in cw.load_recording(recorded).demonstrations]
    return simulation, [simulation.windows(t.demonstration, t.readings, t.measured) for t in trials]


@pytest.fixture(scope="module")
def shifted(policy: cw.Policy, tmp_path_factory: pytest.TempPathFactory) -> tuple[WindowSimulation, list[TrialWindows]]:
    """Trials whose tracker shows the block 10 mm off."""
    cfg = cw.EvaluateCfg(sensors=cw.SensorErrorsCfg(position_bias=(SHIFT, 0.0, 0.0), biased=("block",)))
    return windows_of(policy, tmp_path_factory.mktemp("shifted"), cfg, 77)


@pytest.fixture(scope="module")
def right(policy: cw.Policy, tmp_path_factory: pytest.TempPathFactory) -> tuple[WindowSimulation, list[TrialWindows]]:
    """Trials of a policy with small steps whose tracker is right."""
    return windows_of(policy, tmp_path_factory.mktemp("right"), cw.EvaluateCfg(action_scale=0.3), 78)


def found(simulation: WindowSimulation, windows: list[TrialWindows]) -> PoseBias:
    return PoseBiasSearch(simulation, SMALL).run(windows)


def test_windows_are_foreseen_best_under_the_error_that_the_tracker_has(
    shifted: tuple[WindowSimulation, list[TrialWindows]], right: tuple[WindowSimulation, list[TrialWindows]]
) -> None:
    errors = SHIFT * np.array([-1.0, 0.0, 1.0, 2.0])[:, None] * np.eye(6)[0]
    for (simulation, windows), best in ((shifted, 2), (right, 1)):
        losses = np.stack([simulation.losses(w, errors).mean(axis=1) for w in windows])
        assert losses.mean(axis=0).argmin() == best


def test_an_error_of_poses_is_found_by_what_it_gains_in_other_trials(
    shifted: tuple[WindowSimulation, list[TrialWindows]],
) -> None:
    bias, judged = found(*shifted), JudgeCfg()
    np.testing.assert_allclose(bias.value[:3], (SHIFT, 0.0, 0.0), atol=3.5e-3)
    assert bias.p <= judged.significance
    assert bias.held_out >= judged.least_gain
    assert bias.size >= judged.least_bias
    assert bias.after.mean() < bias.before.mean()


def test_no_error_of_poses_is_found_where_there_is_none(
    right: tuple[WindowSimulation, list[TrialWindows]],
) -> None:
    bias, judged = found(*right), JudgeCfg()
    assert bias.p > judged.significance or bias.held_out < judged.least_gain or bias.size < judged.least_bias


def test_an_object_is_fitted_between_the_fingers(
    policy: cw.Policy, right: tuple[WindowSimulation, list[TrialWindows]]
) -> None:
    m = policy.run.model.scene.model
    block = m.body("block").id
    fit, address = GraspFit(m, block, ContactStartCfg()), int(m.jnt_qposadr[m.body_jntadr[block]])
    held = fit(right[1][0].qpos[1])
    data = mujoco.MjData(m)
    data.qpos[:] = held
    mujoco.mj_kinematics(m, data)
    across = data.body("left_finger").xpos - data.body("right_finger").xpos
    across /= np.linalg.norm(across)

    def after(move: np.ndarray) -> np.ndarray:
        """By how much an object that was moved is off after the fit, (6,)."""
        pushed = held.copy()
        pushed[address : address + 7] = moved(held[address : address + 7], move)
        return fit(pushed)[address : address + 3] - held[address : address + 3]

    assert abs(after(np.array([*0.003 * across, 0, 0, 0])) @ across) < 1e-3
    along = np.cross(across, (0.0, 0.0, 1.0))
    assert after(np.array([*0.003 * along, 0, 0, 0])) @ along == pytest.approx(0.003, abs=1e-3)


def test_a_window_without_anything_near_its_end_is_foreseen_well(
    right: tuple[WindowSimulation, list[TrialWindows]],
) -> None:
    simulation, windows = right
    assert np.median([simulation.losses(w, np.zeros((1, 6)))[0] for w in windows]) < 1.0


@pytest.mark.parametrize(("gains", "p"), [(np.ones(5), 1 / 32), (np.array([1.0, -1.0]), 0.75), (np.zeros(0), 1.0)])
def test_the_sign_flip_test_is_exact(gains: np.ndarray, p: float) -> None:
    assert sign_flip(gains) == pytest.approx(p)


def test_the_sign_flip_test_of_many_gains_samples_signs() -> None:
    assert sign_flip(np.ones(20)) < 0.01
    assert sign_flip(-np.ones(20)) > 0.9


def test_few_trials_are_cut_into_pieces(right: tuple[WindowSimulation, list[TrialWindows]]) -> None:
    simulation, windows = right
    units = PoseBiasSearch(simulation, PoseBiasCfg(least_units=6))._units(windows)
    assert len(units) == 8
    assert sum(map(len, units)) == sum(map(len, windows))
