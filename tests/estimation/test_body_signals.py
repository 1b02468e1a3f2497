"""Motion of a body that spins fast and whose position and orientation are read at different times."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from concent_warp.errors import RecordingError
from concent_warp.estimation.state_estimator import StateEstimator, StateEstimatorCfg
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene

SCENE = """
<mujoco>
  <worldbody><body name="ball"><freejoint/><geom size="0.1" contype="0" conaffinity="0"/></body></worldbody>
  <sensor>
    <framepos name="position" objtype="xbody" objname="ball"/>
    <framequat name="orientation" objtype="xbody" objname="ball"/>
  </sensor>
</mujoco>"""
SPIN = 30.0 * np.array([0.6, 0.0, 0.8])
"""Angular velocity [rad/s]; the same in world and body frame."""
GRAVITY = np.array([0.0, 0.0, -9.81])
SPEED = np.array([1.0, -0.5, 2.0])
SPLINE = StateEstimatorCfg("smoothing_spline")


def turn(time: np.ndarray) -> Rotation:
    """Return the ball's orientation at times (T,)."""
    return Rotation.from_rotvec(time[:, None] * SPIN)


def place(time: np.ndarray) -> np.ndarray:
    """Return its position [m] at times (T,), shape (T, 3)."""
    return time[:, None] * SPEED + time[:, None] ** 2 / 2 * GRAVITY


def flown(place_time: np.ndarray, turn_time: np.ndarray) -> Demonstration:
    """Return exact readings at some times."""
    orientation = turn(turn_time).as_quat(scalar_first=True)
    measured = {
        "position": Channel(place_time, place(place_time), 1e-4),
        "orientation": Channel(turn_time, orientation, 1e-3),
    }
    return Demonstration("demo_0", measured=measured)


def errors(demonstration: Demonstration, cfg: StateEstimatorCfg | None = None) -> dict[str, float]:
    """Return the largest errors of the states between 0.1 and 0.4 s, angles [rad] among them."""
    time = np.linspace(0.1, 0.4, 31)
    states = StateEstimator.of(Model(Scene(SCENE)), demonstration, cfg).states(time)
    apart = turn(time).inv() * Rotation.from_quat(states.qpos[:, 3:], scalar_first=True)
    return {
        "position": np.abs(states.qpos[:, :3] - place(time)).max(),
        "velocity": np.abs(states.qvel[:, :3] - SPEED - time[:, None] * GRAVITY).max(),
        "orientation": apart.magnitude().max(),
        "spin": np.abs(states.qvel[:, 3:] - SPIN).max(),
    }


EXACT = {"position": 1e-4, "velocity": 0.01, "orientation": 0.005, "spin": 0.1}
"""A reading that is 2 ms off shows another orientation by 0.06 rad."""
TICKS = 0.01 * np.arange(51)


@pytest.mark.parametrize("cfg", [None, SPLINE])
@pytest.mark.parametrize(
    "turn_time",
    [TICKS, TICKS + 0.008, TICKS[:-1] + 0.0025, np.arange(0.003, 0.5, 0.0167), np.arange(0.0, 0.5, 0.004)],
    ids=["together", "8 ms later", "2.5 ms later", "at 60 Hz", "at 250 Hz"],
)
def test_a_fast_spin_is_estimated_from_orientations_at_their_own_times(turn_time, cfg):
    found = errors(flown(TICKS, turn_time), cfg)
    assert {name: value for name, value in found.items() if value > EXACT[name]} == {}


def test_positions_that_are_missing_take_no_orientation_away():
    demonstration = flown(TICKS, TICKS)
    value = demonstration.measured["position"].value
    value[15:25] = np.nan
    found = errors(demonstration)
    assert found["orientation"] < EXACT["orientation"]
    assert found["spin"] < EXACT["spin"]


def test_an_orientation_that_was_hardly_read_is_no_measured_motion():
    demonstration = flown(TICKS, TICKS)
    demonstration.measured["orientation"].value[3:] = np.nan
    with pytest.raises(RecordingError, match="a free body was not seen"):
        StateEstimator.of(Model(Scene(SCENE)), demonstration)
