"""Actuators with a state of their own begin where the first command would have left them."""

import mujoco
import numpy as np
import pytest

from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.simulate.activation import initial_activation
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.warp_engine import WarpEngine

SCENE = """<mujoco><option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/><worldbody>
<body><joint name="one" axis="0 0 1" damping="1"/><geom size="0.1" mass="1"/></body>
<body pos="1 0 0"><joint name="two" axis="0 0 1" damping="1"/><geom size="0.1" mass="1"/></body>
</worldbody><actuator>
<position name="filtered" joint="one" kp="20" timeconst="0.3"/>
<intvelocity name="moved" joint="two" kp="20" gear="2"/>
<motor name="plain" joint="two"/>
</actuator></mujoco>"""


@pytest.mark.parametrize("engine", [MujocoEngine, WarpEngine])
def test_a_servo_with_a_filter_or_an_integrator_holds_the_pose_that_it_begins_in(engine):
    simulator = engine(Model(Scene(SCENE)))
    qpos = np.array([[0.8, -0.5], [0.3, 0.2]])
    ctrl = np.zeros((2, 100, 3))
    ctrl[:, :, 0] = qpos[:, :1]
    found = simulator.run(Variants(2, qpos=qpos), ctrl).numpy()
    np.testing.assert_allclose(found.qpos, np.repeat(qpos[:, None], 101, axis=1), atol=1e-5)


def test_activations_keep_within_their_ranges_and_others_are_zero():
    m = mujoco.MjModel.from_xml_string("""<mujoco><worldbody>
    <body><joint name="j" range="-2 2"/><geom size="0.1"/></body></worldbody><actuator>
    <general joint="j" dyntype="filter" dynprm="0.1" ctrlrange="-1 1" ctrllimited="true"/>
    <muscle joint="j"/><general joint="j" dyntype="integrator"/>
    <general joint="j" dyntype="filterexact" dynprm="0.1" actrange="-0.2 0.2" actlimited="true"/>
    </actuator></mujoco>""")
    np.testing.assert_allclose(
        initial_activation(m, mujoco.MjData(m), np.array([3.0, 0.4, 5.0, 0.7])), [1, 0.4, 0, 0.2]
    )


def test_an_integrator_of_a_servo_with_an_offset_begins_without_a_force():
    m = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body><joint name="j"/><geom size="0.1"/></body>
    </worldbody>
    <actuator><general joint="j" dyntype="integrator" gainprm="5" biastype="affine" biasprm="2 -10 0"/>
    <general joint="j" dyntype="integrator" gainprm="0" biastype="affine" biasprm="2 -10 0"/></actuator></mujoco>""")
    d = mujoco.MjData(m)
    d.qpos[0] = 0.5
    d.act[:] = initial_activation(m, d, np.zeros(2))
    mujoco.mj_forward(m, d)
    assert d.actuator_force[0] == pytest.approx(0.0)
    assert d.act[1] == 0.0


@pytest.mark.parametrize("engine", [MujocoEngine, WarpEngine])
def test_an_integrator_of_a_servo_begins_where_it_holds_weight_and_spring(engine):
    scene = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
    <body><joint name="lift" axis="0 1 0" damping="1" stiffness="3" springref="20"/>
    <geom size="0.02" pos="0.3 0 0" mass="1"/></body></worldbody>
    <actuator><intvelocity name="servo" joint="lift" kp="20" kv="1" gear="2"/></actuator></mujoco>"""
    qpos = np.array([[0.4], [-0.2]])
    found = engine(Model(Scene(scene))).run(Variants(2, qpos=qpos), np.zeros((2, 200, 1))).numpy()
    np.testing.assert_allclose(found.qpos, np.repeat(qpos[:, None], 201, axis=1), atol=1e-4)


def test_an_integrator_pulls_no_more_than_it_can_and_not_where_another_drive_may_hold_the_joint():
    def force(limit: str, other: str) -> float:
        m = mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody><body><joint name="j" axis="0 1 0"/>
        <geom size="0.02" pos="0.3 0 0" mass="1"/></body></worldbody>
        <actuator><intvelocity joint="j" kp="20" {limit}/>{other}</actuator></mujoco>""")
        d = mujoco.MjData(m)
        d.act[:] = initial_activation(m, d, np.zeros(m.nu))
        mujoco.mj_forward(m, d)
        return float(d.actuator_force[0])

    assert force("", "") == pytest.approx(-0.3 * 9.81)
    assert force('forcerange="-1 1"', "") == pytest.approx(-1.0)
    assert force("", '<motor joint="j"/>') == pytest.approx(0.0)


def test_a_command_is_not_clipped_where_the_scene_says_so():
    m = mujoco.MjModel.from_xml_string("""<mujoco><option><flag clampctrl="disable"/></option><worldbody>
    <body><joint name="j"/><geom size="0.1"/></body></worldbody><actuator>
    <general joint="j" dyntype="filter" dynprm="0.1" ctrlrange="-1 1" ctrllimited="true"/></actuator></mujoco>""")
    assert initial_activation(m, mujoco.MjData(m), np.array([3.0])) == pytest.approx([3.0])
