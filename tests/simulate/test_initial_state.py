"""The state at time 0, where the recording does not say it: joints without sensors of their own."""

import mujoco
import numpy as np
import pytest

from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.simulate.replay import initial_state

GRIPPER = """
<mujoco>
  <worldbody>
    <body><joint name="left" type="slide" axis="0 1 0" range="0 0.04"/><geom size="0.01" mass="0.1"/></body>
    <body><joint name="right" type="slide" axis="0 -1 0" range="0 0.04"/><geom size="0.01" mass="0.1"/></body>
    <body name="rotor"><joint name="rotor" type="hinge" axis="0 0 1"/><geom size="0.01" mass="0.1"/></body>
  </worldbody>
  <tendon><fixed name="width"><joint joint="left" coef="1"/><joint joint="right" coef="1"/></fixed></tendon>
  <equality><joint joint1="right" joint2="left" polycoef="0.001 1 0 0 0"/></equality>
  <actuator><position name="width" tendon="width"/></actuator>
  <sensor>
    <jointpos name="left" joint="left"/><jointpos name="right" joint="right"/><tendonpos name="width" tendon="width"/>
    <actuatorpos name="servo" actuator="width"/>
  </sensor>
</mujoco>
"""
DRAWER = """
<mujoco>
  <compiler angle="degree"/>
  <worldbody>
    <body pos="0.5 0 0.1" euler="0 0 90">
      <body name="drawer"><joint type="slide" axis="-1 0 0" range="0 0.2"/><geom size="0.05" mass="1"/></body>
      <body name="lever" pos="0 0 0.3">
        <joint type="hinge" axis="0 1 0" range="-5 60"/><geom size="0.05" mass="1"/>
      </body>
    </body>
  </worldbody>
  <sensor>
    <framepos name="drawer" objtype="xbody" objname="drawer"/>
    <framequat name="lever" objtype="xbody" objname="lever"/>
  </sensor>
</mujoco>
"""


def started(xml: str, **first: list[float]) -> np.ndarray:
    measured = {name: Channel(np.array([0.0, 1.0]), np.tile(value, (2, 1))) for name, value in first.items()}
    return initial_state(mujoco.MjModel.from_xml_string(xml), Demonstration("demo_0", measured=measured))[0]


@pytest.mark.parametrize("first", [{"left": [0.02]}, {"right": [0.021]}, {"width": [0.041]}, {"servo": [0.041]}])
def test_the_other_finger_starts_where_the_coupling_holds_it(first: dict[str, list[float]]) -> None:
    np.testing.assert_allclose(started(GRIPPER, **first), [0.02, 0.021, 0.0], atol=1e-6)


def test_without_a_reading_joints_start_in_the_reference_pose_as_far_as_couplings_allow() -> None:
    left, right, rotor = started(GRIPPER)
    assert right == pytest.approx(left + 0.001, abs=1e-6)
    assert rotor == 0.0


def test_measured_poses_of_a_drawer_and_a_lever_tell_their_joints() -> None:
    model = mujoco.MjModel.from_xml_string(DRAWER)
    data = mujoco.MjData(model)
    data.qpos[:] = 0.07, 0.8
    mujoco.mj_forward(model, data)
    qpos = started(DRAWER, drawer=list(data.body("drawer").xpos), lever=list(data.body("lever").xquat))
    np.testing.assert_allclose(qpos, [0.07, 0.8], atol=1e-6)


def test_a_joint_that_was_measured_stays_as_measured() -> None:
    np.testing.assert_array_equal(started(GRIPPER, left=[0.02], right=[0.03])[:2], [0.02, 0.03])


def test_a_short_lever_is_told_by_its_place_beside_a_coupling_and_untold_joints_stay_out_of_their_range() -> None:
    bodies = """
    <body><joint name="wrist" axis="0 1 0" range="-90 -4"/><geom size="0.01" mass="0.1"/></body>
    <body><joint axis="0 1 0"/><geom size="0.01" mass="0.1"/><site name="tip" pos="0.05 0 0"/></body></worldbody>"""
    xml = GRIPPER.replace("</worldbody>", bodies).replace(
        "<sensor>", '<sensor><framepos name="tip" objtype="site" objname="tip"/>'
    )
    tip = [0.05 * np.cos(0.4), 0.0, -0.05 * np.sin(0.4)]
    np.testing.assert_allclose(started(xml, left=[0.02], tip=tip), [0.02, 0.021, 0.0, 0.0, 0.4], atol=1e-6)
