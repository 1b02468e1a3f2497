"""Poses of bodies whose position and orientation were read at different times."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from concent_warp.estimation.object_tracks import measured_pose
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene

SCENE = """
<mujoco>
  <worldbody><body name="ball"><freejoint/><geom size="0.1"/></body></worldbody>
  <sensor>
    <framepos name="position" objtype="xbody" objname="ball"/>
    <framequat name="orientation" objtype="xbody" objname="ball"/>
  </sensor>
</mujoco>"""
MODEL = Scene(SCENE).model
AXIS, SPIN = np.array([0.6, 0.0, 0.8]), 30.0
TIME = 0.01 * np.arange(20)


def turned(time: np.ndarray) -> np.ndarray:
    """Return quaternions wxyz (T, 4) of a steady spin."""
    return Rotation.from_rotvec(SPIN * time[:, None] * AXIS).as_quat(scalar_first=True)


def found_turns(orientation: Channel, time: np.ndarray = TIME) -> Rotation:
    """Return the rotations that belong to positions at some times (T,)."""
    position = Channel(time, np.outer(time, [1.0, 2.0, 3.0]))
    measured = {"position": position, "orientation": orientation}
    pose = measured_pose(MODEL, Demonstration("demo_0", measured=measured), "ball")
    assert pose is not None
    np.testing.assert_array_equal(pose[0], position.time)
    np.testing.assert_array_equal(pose[1], position.value)
    return pose[2]


def away(found: Rotation, time: np.ndarray) -> np.ndarray:
    """Return the angles (T,) [rad] between rotations and those of the spin at some times."""
    return (found * Rotation.from_quat(turned(time), scalar_first=True).inv()).magnitude()


@pytest.mark.parametrize("late", [0.002, 0.005, 0.008])
def test_orientations_are_interpolated_at_the_times_of_the_positions(late):
    time = TIME - 0.01 + late  # from before the first position until after the last one
    time = np.append(time, TIME[-1] + late)
    np.testing.assert_allclose(away(found_turns(Channel(time, turned(time))), TIME), 0.0, atol=1e-7)


def test_orientations_are_interpolated_along_the_shorter_way_whatever_the_signs_of_quaternions():
    time = 0.02 * np.arange(-1, 12)
    sign = np.random.default_rng(0).choice([-1.0, 1.0], len(time))[:, None]
    np.testing.assert_allclose(away(found_turns(Channel(time, sign * turned(time))), TIME), 0.0, atol=1e-7)


def test_before_the_first_and_after_the_last_reading_an_orientation_stays():
    time = TIME[5:15] + 0.004
    found = found_turns(Channel(time, turned(time)))
    np.testing.assert_allclose(away(found, np.clip(TIME, time[0], time[-1])), 0.0, atol=1e-7)


def test_missing_orientations_are_passed_over():
    value = turned(TIME)
    value[[0, 7, 8, 12]] = np.nan
    expected = TIME.copy()
    expected[0] = TIME[1]  # there is none before
    np.testing.assert_allclose(away(found_turns(Channel(TIME, value)), expected), 0.0, atol=1e-7)
    value[1:] = np.nan
    value[4] = turned(TIME[[4]])[0]
    np.testing.assert_allclose(away(found_turns(Channel(TIME, value)), np.full(20, TIME[4])), 0.0, atol=1e-7)


def test_a_body_without_both_sensors_has_no_pose():
    position = Channel(TIME, np.zeros((20, 3)))
    assert measured_pose(MODEL, Demonstration("demo_0", measured={"position": position}), "ball") is None
    orientation = Channel(TIME, turned(TIME))
    assert measured_pose(MODEL, Demonstration("demo_0", measured={"orientation": orientation}), "ball") is None
