"""Both solvers bring the tool where it is asked to be, and say where it cannot be."""

import mujoco
import numpy as np
import pytest

from concent_warp.scene.shape_sorter import ShapeSorterCfg, home
from concent_warp.train.cfg import ActionCfg
from concent_warp.train.resets.inverse_kinematics import solve_inverse_kinematics
from concent_warp.train.resets.inverse_kinematics_batch import _tool_chain, solve_inverse_kinematics_batch
from concent_warp.train.task.robot import Robot

Asked = tuple[mujoco.MjModel, Robot, np.ndarray, np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def asked() -> Asked:
    """Return an arm, postures, and tool poses near them; the last one is out of reach."""
    m = ShapeSorterCfg().build().model
    robot = Robot.of(m, ActionCfg())
    rng = np.random.default_rng(0)
    d = mujoco.MjData(m)
    qpos = np.tile(home(m), (6, 1))
    qpos[:, robot.qpos] += rng.uniform(-0.1, 0.1, (6, 7))
    position, rotation = np.zeros((6, 3)), np.zeros((6, 3, 3))
    for i in range(6):
        d.qpos[:] = qpos[i]
        mujoco.mj_kinematics(m, d)
        position[i] = d.site_xpos[robot.tool] + rng.uniform(-0.03, 0.03, 3)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, np.array([np.cos(0.1), 0, 0, np.sin(0.1)]))
        rotation[i] = turn.reshape(3, 3) @ d.site_xmat[robot.tool].reshape(3, 3)
    position[-1] += [2.0, 0, 0]
    return m, robot, qpos, position, rotation


def check(asked: Asked, i: int, joints: np.ndarray) -> None:
    m, robot, qpos, position, rotation = asked
    d = mujoco.MjData(m)
    d.qpos[:] = qpos[i]
    d.qpos[robot.qpos] = joints
    mujoco.mj_kinematics(m, d)
    np.testing.assert_allclose(d.site_xpos[robot.tool], position[i], atol=5e-4)
    np.testing.assert_allclose(d.site_xmat[robot.tool].reshape(3, 3), rotation[i], atol=5e-3)
    assert (joints >= m.jnt_range[robot.joint, 0] - 1e-4).all()
    assert (joints <= m.jnt_range[robot.joint, 1] + 1e-4).all()


def test_small_displacements_are_reached_from_the_posture(asked):
    m, robot, qpos, position, rotation = asked
    for i in range(6):
        d = mujoco.MjData(m)
        d.qpos[:] = qpos[i]
        joints = solve_inverse_kinematics(m, d, robot, position[i], rotation[i])
        if i == 5:
            assert joints is None
        else:
            assert joints is not None
            check(asked, i, joints)


@pytest.mark.slow
def test_newton_reaches_all_poses_at_once(asked):
    m, robot, qpos, position, rotation = asked
    joints, fine = solve_inverse_kinematics_batch(m, robot, qpos, position, rotation, device="cpu")
    assert fine.tolist() == [True] * 5 + [False]
    for i in range(5):
        check(asked, i, joints[i])


def test_newton_chain_has_the_joints_of_the_arm(asked):
    m, robot, *_ = asked
    chain, joints, link, offset = _tool_chain(m, robot, "cpu")
    assert joints.tolist() == robot.joint.tolist()
    assert chain.joint_count == 7
    assert link == 6
    # The hand is fixed to the last link: flange and tool centre are along its axis.
    np.testing.assert_allclose(offset[0], [0, 0, 0.107 + 0.1034], atol=1e-6)
