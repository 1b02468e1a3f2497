from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.perception.configuration import configurations
from concent_warp.recording.recording import Channel, Demonstration

MODEL = mujoco.MjModel.from_xml_string("""
<mujoco>
  <worldbody>
    <body><joint name="hinge" type="hinge"/><geom size=".01"/>
      <body pos=".1 0 0"><joint name="left" type="slide"/><geom size=".01"/></body>
      <body pos=".2 0 0"><joint name="right" type="slide"/><geom size=".01"/></body>
      <body pos=".3 0 0"><joint name="driven" type="slide"/><geom size=".01"/></body>
      <body pos=".4 0 0"><joint name="follower" type="slide"/><geom size=".01"/></body>
      <body pos=".5 0 0"><joint name="loose" type="slide"/><geom size=".01"/></body>
    </body>
  </worldbody>
  <tendon><fixed name="grip"><joint joint="left" coef=".5"/><joint joint="right" coef=".5"/></fixed></tendon>
  <equality><joint joint1="follower" joint2="hinge" polycoef="0.1 2 0 0 0"/></equality>
  <actuator><position name="drive" joint="driven" kp="10"/></actuator>
  <sensor><jointpos name="angle" joint="hinge"/><tendonpos name="opening" tendon="grip"/></sensor>
</mujoco>""")


def test_joints_follow_sensors_tendons_couplings_and_commands():
    demonstration = Demonstration(
        "demo_0",
        action={"drive": Channel(np.array([0.0, 0.5]), np.array([0.01, 0.02]))},
        measured={
            "angle": Channel(np.array([0.0, 0.4, 1.0]), np.array([[0.0], [np.nan], [1.0]])),
            "opening": Channel(np.array([0.0, 1.0]), np.array([[0.04], [0.02]])),
        },
    )
    qpos, unknown = configurations(MODEL, demonstration, np.array([0.25, 0.75]))
    at = {MODEL.joint(j).name: qpos[:, MODEL.jnt_qposadr[j]] for j in range(MODEL.njnt)}
    np.testing.assert_allclose(at["hinge"], [0.25, 0.75])
    np.testing.assert_allclose(at["left"], [0.035, 0.025])
    np.testing.assert_allclose(at["right"], [0.035, 0.025])
    np.testing.assert_allclose(at["driven"], [0.01, 0.02])
    np.testing.assert_allclose(at["follower"], 0.1 + 2 * np.array([0.25, 0.75]))
    assert unknown == ["loose"]


def test_positions_that_are_given_lead_the_others_and_commands_can_be_left_out():
    time = np.array([0.0, 1.0])
    demonstration = Demonstration(
        "demo_0",
        action={"drive": Channel(time, np.array([0.01, 0.02]))},
        measured={"angle": Channel(time, np.array([[0.0], [1.0]]))},
    )
    hinge = MODEL.joint("hinge").id
    qpos, unknown = configurations(MODEL, demonstration, time, {hinge: np.array([0.5, 0.6])}, commanded=False)
    at = {MODEL.joint(j).name: qpos[:, MODEL.jnt_qposadr[j]] for j in range(MODEL.njnt)}
    np.testing.assert_allclose(at["hinge"], [0.5, 0.6])
    np.testing.assert_allclose(at["follower"], 0.1 + 2 * np.array([0.5, 0.6]))
    np.testing.assert_array_equal(at["driven"], 0)
    assert unknown == ["left", "right", "driven", "loose"]
