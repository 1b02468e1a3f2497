"""Joints of linkages that follow from others by the loop that they close."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.estimation import joint_signals
from concent_warp.estimation.closed_loops import close_loops
from concent_warp.estimation.state_estimator import StateEstimator
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene

FOUR_BAR = """<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody>
<body name="crank"><joint name="crank" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 0.1" size="0.01" contype="0"/>
<body name="coupler" pos="0 0 0.1"><joint name="coupler" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0.25 0 0.05" size="0.01" contype="0"/></body></body>
<body name="rocker" pos="0.25 0 0"><joint name="rocker" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 0.15" size="0.01" contype="0"/></body></worldbody>
<equality>{loop}</equality>
<sensor><jointpos name="encoder" joint="crank"/></sensor></mujoco>"""
LOOP = '<connect body1="coupler" body2="rocker" anchor="0.25 0 0.05"/>'
TIME = np.arange(0, 2, 0.01)
CRANK = 2.5 * TIME + 0.5 * np.sin(4 * TIME)


def turned(loop=LOOP):
    """Return a scene, and a demonstration in which the crank alone is measured and goes round."""
    scene = Scene(FOUR_BAR.format(loop=loop))
    return scene, Demonstration("demo_0", measured={"encoder": Channel(TIME, CRANK[:, None])})


def gap(m, qpos):
    """Return the distance between the two ends of the loop [m]."""
    d = mujoco.MjData(m)
    d.qpos[:] = qpos
    mujoco.mj_kinematics(m, d)
    ends = [
        d.body(n).xpos + d.body(n).xmat.reshape(3, 3) @ at
        for n, at in (("coupler", (0.25, 0, 0.05)), ("rocker", (0, 0, 0.15)))
    ]
    return float(np.linalg.norm(ends[0] - ends[1]))


def test_states_of_a_linkage_follow_from_the_joint_that_was_measured():
    scene, demonstration = turned()
    estimator = StateEstimator.of(Model(scene), demonstration)
    states = estimator.states(TIME[20:-20:20])
    for qpos, qvel in zip(states.qpos, states.qvel, strict=True):
        assert gap(scene.model, qpos) < 2e-4
        assert gap(scene.model, qpos + 0.01 * qvel) < 2e-3
    np.testing.assert_allclose(states.qpos[:, 0], CRANK[20:-20:20], atol=1e-3)
    assert np.ptp(states.qpos[:, 2]) > 0.5


@pytest.mark.parametrize("loop", ["", '<weld body1="crank" body2="rocker" active="false"/>'])
def test_joints_that_no_loop_determines_are_named(loop):
    scene, demonstration = turned(loop)
    with pytest.raises(RecordingError, match=r"expected readings of \['coupler', 'rocker'\]"):
        StateEstimator.of(Model(scene), demonstration)


def test_a_loop_that_cannot_be_closed_is_no_answer():
    m = turned()[0].model
    away = np.array([[0.0, 0.0, 0.0]])
    assert close_loops(m, away, np.array([1, 2])) == pytest.approx(away, abs=1e-6)
    assert close_loops(m, np.array([[0.0, 0.0, 2.0]]), np.array([1])) is None


def test_constraints_that_do_not_depend_on_the_linkage_do_not_matter():
    elsewhere = LOOP + '<weld body1="object" body2="crank"/><weld body1="target" body2="crank"/>'
    xml = FOUR_BAR.format(loop=elsewhere).replace(
        "</worldbody>",
        '<body name="object" pos="1 0 0"><freejoint/><geom size="0.1"/></body><body name="target" mocap="true"/>'
        "</worldbody>",
    )
    m, alone = mujoco.MjModel.from_xml_string(xml), turned()[0].model
    qpos = np.tile(m.qpos0, (5, 1))
    qpos[:, 0] = CRANK[:5]
    found, expected = (close_loops(one, at, np.array([1, 2])) for one, at in ((m, qpos), (alone, qpos[:, :3])))
    assert found is not None
    assert expected is not None
    np.testing.assert_allclose(found[:, :3], expected, atol=1e-9)


def test_readings_at_a_high_rate_are_closed_at_a_lower_one(monkeypatch):
    scene, demonstration = turned()
    fine = np.arange(0, 2, 0.001)
    channel = Channel(fine, np.interp(fine, TIME, CRANK)[:, None])
    times = []

    def counted(m, qpos, dofs, cfg=None):
        times.append(len(qpos))
        return close_loops(m, qpos, dofs, cfg)

    monkeypatch.setattr(joint_signals, "close_loops", counted)
    estimator = StateEstimator.of(Model(scene), replace(demonstration, measured={"encoder": channel}))
    assert times == [500]
    for qpos in estimator.states(fine[20:-20:200]).qpos:
        assert gap(scene.model, qpos) < 2e-4


def test_a_weld_counts_whole_or_not_at_all():
    m = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body name="target" mocap="true" pos="0 0 0.2"/>
    <body><joint axis="0 1 0"/><geom size="0.02"/><body name="hand" pos="0.2 0 0"><joint axis="0 1 0"/>
    <geom size="0.02"/></body></body></worldbody>
    <equality><weld body1="target" body2="hand"/></equality></mujoco>""")
    away = np.array([[0.3, 0.0]])
    assert close_loops(m, away, np.array([1])) is None  # its orientation alone depends on the last joint
