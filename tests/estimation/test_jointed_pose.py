"""Objects on joints of their own, which were measured instead of their pose."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.estimation.jointed_pose import jointed_pose
from concent_warp.estimation.object_tracks import whole_demonstration
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene

PLANAR = """
<mujoco>
  <custom><text name="concent_objects" data="tee"/></custom>
  <worldbody>
    <body name="agent"><joint name="agent" type="slide" axis="1 0 0"/><geom size="0.01" mass="0.1"/></body>
    <body name="tee" pos="0 0 0.01">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
      <joint name="turn" type="hinge" axis="0 0 1"/><geom type="box" size="0.05 0.01 0.01" mass="0.1"/>
    </body>
  </worldbody>
  <actuator><position name="agent" joint="agent" kp="10"/></actuator>
  <sensor>
    <jointpos name="x" joint="x"/><jointpos name="y" joint="y"/><jointpos name="turn" joint="turn"/>
    <jointpos name="agent" joint="agent"/>
  </sensor>
</mujoco>
"""
TIME = np.linspace(0, 1, 11)


def demonstration(*sensors: str) -> Demonstration:
    values = {"x": 0.1 * TIME, "y": 0.2 * TIME, "turn": TIME, "agent": TIME}
    measured = {name: Channel(TIME, values[name][:, None]) for name in sensors}
    return Demonstration("demo_0", action={"agent": Channel(TIME, TIME)}, measured=measured)


def test_pose_of_a_planar_object_follows_from_its_joints() -> None:
    found = jointed_pose(mujoco.MjModel.from_xml_string(PLANAR), demonstration("x", "y", "turn"), "tee")
    assert found is not None
    time, position, turn = found
    np.testing.assert_array_equal(time, TIME)
    np.testing.assert_allclose(position, np.stack([0.1 * TIME, 0.2 * TIME, np.full(11, 0.01)], axis=1), atol=1e-12)
    np.testing.assert_allclose(turn.as_rotvec()[:, 2], TIME, atol=1e-12)


def test_a_pose_is_known_as_long_as_all_of_its_joints_were_measured() -> None:
    model, whole = mujoco.MjModel.from_xml_string(PLANAR), demonstration("x", "y", "turn")
    late = Channel(TIME[4:9], whole.measured["y"].value[4:9])
    found = jointed_pose(model, replace(whole, measured={**whole.measured, "y": late}), "tee")
    assert found is not None
    np.testing.assert_array_equal(found[0], TIME[4:9])
    np.testing.assert_allclose(found[1][:, 1], 0.2 * TIME[4:9], atol=1e-12)
    never = Channel(TIME[-1:] + 1, np.zeros((1, 1)))
    assert jointed_pose(model, replace(whole, measured={**whole.measured, "y": never}), "tee") is None


def test_a_fit_aims_at_an_object_on_measured_joints() -> None:
    (target,) = whole_demonstration(Scene(PLANAR), demonstration("x", "y", "turn", "agent"), ("tee",)).targets
    assert target.points.shape == (11, len(target.anchor), 3)


def test_joints_that_are_driven_or_not_measured_tell_no_pose() -> None:
    model = mujoco.MjModel.from_xml_string(PLANAR)
    assert jointed_pose(model, demonstration("agent"), "agent") is None
    assert jointed_pose(model, demonstration("x", "turn"), "tee") is None
    with pytest.raises(RecordingError, match=r"nothing to fit to.*positions of the passive joints on which it moves"):
        whole_demonstration(Scene(PLANAR), demonstration("x", "turn"), ("tee",))
