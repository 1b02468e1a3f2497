"""Readings that the model's range of a joint excludes are reported before the verdict."""

import numpy as np
import pytest

from concent_warp.diagnosis.check_data import check_data
from concent_warp.recording.recording import Channel, Demonstration, Recording

SCENE = """
<mujoco>
  <worldbody>
    <body name="carriage">
      <joint name="rail" type="slide" axis="1 0 0" {range}/>
      <geom type="box" size="0.05 0.05 0.05" mass="1"/>
    </body>
  </worldbody>
  <sensor><jointpos name="rail_pos" joint="rail"/></sensor>
</mujoco>
"""


def said_of(positions: np.ndarray, limits: str = 'range="-0.6 0.6"') -> list[str]:
    time = np.linspace(0.0, 2.0, len(positions))
    measured = {"rail_pos": Channel(time, positions[:, None], 1e-4)}
    return check_data(Recording(SCENE.format(range=limits), (Demonstration("demo_0", measured=measured),)))


def swing(size: float) -> np.ndarray:
    return size * np.sin(np.linspace(0.0, 7.0, 201))


@pytest.mark.parametrize("sign", [1, -1])
def test_positions_outside_the_range_of_a_joint_are_reported(sign):
    positions = sign * np.maximum(swing(0.83), -0.3)
    assert said_of(positions) == [
        f"demo_0, rail_pos: readings up to {0.83 * sign:.3g} m are outside"
        " the range of rail, -0.6 to 0.6 m, where the simulated joint stops. Correct the range, or the unit or zero of"
        " the readings."
    ]


def test_positions_at_a_stop_and_of_joints_without_a_range_are_not():
    assert said_of(swing(0.61)) == []
    assert said_of(swing(0.83), "") == []


def test_a_single_outlier_is_no_motion_outside_the_range():
    positions = swing(0.5)
    positions[50] = 2.0
    assert said_of(positions) == []


def test_a_range_in_radians_that_the_model_took_for_degrees_is_named():
    hinge = SCENE.replace('name="rail" type="slide"', 'name="rail"')
    assert "radian" not in " ".join(said_of(swing(0.83)))
    for limits, hinted in (('range="-2 2"', True), ('range="-0.7 0.7"', False)):
        time = np.linspace(0.0, 2.0, 201)
        measured = {"rail_pos": Channel(time, swing(1.5)[:, None], 1e-4)}
        (said,) = check_data(Recording(hinge.format(range=limits), (Demonstration("demo_0", measured=measured),)))
        assert "readings up to 1.5 rad are outside" in said
        assert (
            'They fit -2 to 2 rad: an MJCF states angles in degrees, unless it has <compiler angle="radian"/>.' in said
        ) == hinted
