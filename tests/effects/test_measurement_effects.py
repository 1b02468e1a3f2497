import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_worlds import BLOCK, PENDULUM, G, world

from concent_warp.effects.effect import Effect
from concent_warp.effects.library.measurement import FrameOffset, Latency, LengthScale, SensorBias, SensorGain, TimeBase

HALF = np.pi / 2


def truth(sensor, time):
    """A body that falls from (1, 2, 10), turned by a quarter about z; an encoder that swings."""
    fall = 10 - 0.5 * G * time**2
    return {
        "position": np.stack([np.full_like(time, 1.0), np.full_like(time, 2.0), fall], axis=1),
        "orientation": np.tile([np.cos(HALF / 2), 0, 0, np.sin(HALF / 2)], (len(time), 1)),
        "encoder": np.sin(3 * time)[:, None],
    }[sensor]


TIME = np.linspace(0.2, 1.0, 9)


def reading(xml, effect, values, sensor):
    model = world(xml).add(effect, values)
    return effect.measure(model.compile(), truth, np.asarray(values, dtype=float))(sensor, TIME)


def test_clock_that_runs_fast_shows_a_fall_with_less_gravity():
    z = reading(BLOCK, TimeBase("position"), [0.05], "position")[:, 2]
    np.testing.assert_allclose(z, 10 - 0.5 * G / 1.05**2 * TIME**2)


def test_late_reading_shows_what_was_before():
    np.testing.assert_allclose(
        reading(PENDULUM, Latency("encoder"), [0.03], "encoder")[:, 0], np.sin(3 * (TIME - 0.03))
    )


def test_length_scale_scales_positions_and_no_other_readings():
    np.testing.assert_allclose(
        reading(BLOCK, LengthScale("position"), [0.1], "position"), 1.1 * truth("position", TIME)
    )
    np.testing.assert_array_equal(
        reading(BLOCK, LengthScale("position"), [0.1], "orientation"), truth("orientation", TIME)
    )


def test_frame_turns_and_shifts_positions_and_turns_orientations():
    effect, values = FrameOffset("position", "orientation"), [0.01, 0.02, 0.03, 0, 0, 0.4]
    c, s = np.cos(0.4), np.sin(0.4)
    x, y, z = truth("position", TIME).T
    expected = np.stack([c * x - s * y + 0.01, s * x + c * y + 0.02, z + 0.03], axis=1)
    np.testing.assert_allclose(reading(BLOCK, effect, values, "position"), expected)
    quaternion = reading(BLOCK, effect, values, "orientation")
    expected = [np.cos((HALF + 0.4) / 2), 0, 0, np.sin((HALF + 0.4) / 2)]
    np.testing.assert_allclose(np.abs(quaternion @ expected), 1)


def test_frame_leaves_gaps_as_gaps():
    effect = FrameOffset("position", "orientation")
    m = world(BLOCK).compile()
    lost = effect.measure(m, lambda s, t: np.full((len(t), m.sensor(s).dim[0]), np.nan), np.full(6, 0.1))
    assert np.isnan(lost("position", TIME)).all()
    assert np.isnan(lost("orientation", TIME)).all()


@pytest.mark.parametrize(
    ("effect", "expected"), [(SensorBias, np.sin(3 * TIME) + 0.05), (SensorGain, 1.05 * np.sin(3 * TIME))]
)
def test_bias_adds_and_gain_multiplies(effect, expected):
    np.testing.assert_allclose(reading(PENDULUM, effect("encoder"), [0.05], "encoder")[:, 0], expected)


def test_a_bias_is_in_the_unit_of_what_the_sensor_reads():
    xml = PENDULUM.replace("</sensor>", '<jointvel name="rate" joint="hinge"/><clock name="time"/></sensor>')
    units = [p.unit for p in SensorBias("encoder", "rate", "time").parameters(world(xml).compile())]
    assert units == ["rad", "rad/s", "SI unit"]


def seen(effect: Effect, values: list[float], xml: str, sensor: str) -> np.ndarray:
    """Return what an effect reads of a body at (t, 2 t, 3), an orientation about x by t, or an angle t^2."""

    def read(name: str, time: np.ndarray) -> np.ndarray:
        if name == "position":
            return np.stack([time, 2 * time, np.full_like(time, 3)], axis=1)
        if name == "orientation":
            return np.stack([np.cos(time / 2), np.sin(time / 2), 0 * time, 0 * time], axis=1)
        return (time**2)[:, None]

    return effect.measure(world(xml).compile(), read, np.array(values))(sensor, np.array([0.5, 1.0, 2.0]))


T = np.array([0.5, 1.0, 2.0])


def test_clocks_delays_scales_and_biases_change_the_reading_of_their_sensors_alone():
    plain = seen(Latency("other"), [0.1], PENDULUM, "encoder")[:, 0]
    np.testing.assert_array_equal(plain, T**2)
    for effect, value, expected in (
        (TimeBase, 0.25, (T / 1.25) ** 2),
        (Latency, 0.25, (T - 0.25) ** 2),
        (SensorBias, 0.25, T**2 + 0.25),
        (SensorGain, 0.25, T**2 * 1.25),
    ):
        np.testing.assert_allclose(seen(effect("encoder"), [value], PENDULUM, "encoder")[:, 0], expected)
        np.testing.assert_array_equal(seen(effect("other"), [value], PENDULUM, "encoder")[:, 0], plain)
    position = np.stack([T, 2 * T, np.full(3, 3.0)], axis=1)
    np.testing.assert_allclose(seen(LengthScale("position"), [0.25], BLOCK, "position"), 1.25 * position)
    np.testing.assert_array_equal(seen(LengthScale("position"), [0.25], BLOCK, "orientation")[:, 2:], 0)


def test_a_frame_turns_about_its_rotation_vector_and_shifts_then():
    values = [0.1, 0.2, 0.3, 0.4, -0.5, 0.6]
    turn = Rotation.from_rotvec(values[3:])
    position = np.stack([T, 2 * T, np.full(3, 3.0)], axis=1)
    both = FrameOffset("position", "orientation")
    np.testing.assert_allclose(seen(both, values, BLOCK, "position"), turn.apply(position) + values[:3])
    quaternions = seen(both, values, BLOCK, "orientation")
    expected = turn * Rotation.from_rotvec(np.outer(T, [1, 0, 0]))
    assert np.abs((quaternions * expected.as_quat(scalar_first=True)).sum(axis=1)) == pytest.approx(np.ones(3))
    np.testing.assert_array_equal(seen(FrameOffset("orientation"), values, BLOCK, "position"), position)


def test_a_frame_keeps_readings_that_are_no_orientation():
    rows = np.array([[1.0, 0, 0, 0], [0, 0, 0, 0], [np.nan, 0, 0, 0], [0, 0, -1.0, 0]])
    effect = FrameOffset("orientation")
    read = effect.measure(world(BLOCK).compile(), lambda _s, _t: rows, np.array([0, 0, 0, 0, 0, np.pi]))
    found = read("orientation", np.zeros(4))
    np.testing.assert_allclose(np.abs(found[0]), [0, 0, 0, 1], atol=1e-12)
    np.testing.assert_array_equal(found[1:3], rows[1:3])
    np.testing.assert_allclose(np.abs(found[3]), [0, 1, 0, 0], atol=1e-12)
    lost = effect.measure(world(BLOCK).compile(), lambda _s, _t: rows[1:3], np.full(6, 0.1))
    np.testing.assert_array_equal(lost("orientation", np.zeros(2)), rows[1:3])


@pytest.mark.parametrize("effect", [SensorBias, SensorGain])
def test_each_sensor_has_a_value_of_its_own(effect):
    with pytest.raises(ValueError, match="zip"):
        effect("encoder").measure(world(PENDULUM).compile(), truth, np.array([0.1, 0.2]))


CELL = """<mujoco><worldbody><body name="arm"><joint name="hinge" axis="0 1 0"/><geom type="capsule" size=".02"
fromto="0 0 0 .4 0 0" mass="1"/><body pos=".4 0 0"><site name="wrist"/><geom size=".05" mass="1"/></body></body>
</worldbody><actuator><motor name="drive" joint="hinge"/></actuator><sensor><jointpos name="encoder" joint="hinge"/>
<force name="cell" site="wrist"/><torque name="moments" site="wrist"/><actuatorfrc name="current" actuator="drive"/>
<gyro name="gyro" site="wrist"/><framepos name="place" objtype="site" objname="wrist"/></sensor></mujoco>"""


def test_zeros_gains_and_delays_of_force_cells_and_gyroscopes_are_candidates_of_their_own():
    m = world(CELL).compile()
    forces = ("cell", "moments", "current")
    assert SensorBias.targets(m) == (("encoder",), forces, ("gyro",))
    assert SensorGain.targets(m) == (("encoder",), forces, ("gyro",))
    assert Latency.targets(m) == (("place",), ("encoder",), forces, ("gyro",))
    assert TimeBase.targets(m) == (("place",), ("encoder",))
    assert set(Latency.single_targets(m)) == {("cell", "moments"), ("current",)}


def test_a_force_cell_has_a_zero_along_each_axis_in_proportion_to_the_weight():
    m, effect = world(CELL).compile(), SensorBias("encoder", "cell", "moments", "current", "gyro")
    found = effect.parameters(m)
    assert [p.name for p in found[:4]] == ["bias[encoder]", "bias_x[cell]", "bias_y[cell]", "bias_z[cell]"]
    assert [p.unit for p in found] == ["rad", *["N"] * 3, *["N m"] * 4, *["rad/s"] * 3]
    assert found[1].scale == pytest.approx(0.02 * 2 * 9.81)
    assert found[4].scale == found[7].scale == pytest.approx(0.002 * 2 * 9.81)
    values = np.arange(11.0)
    read = effect.measure(m, lambda s, t: np.zeros((len(t), m.sensor(s).dim[0])), values)
    np.testing.assert_array_equal(read("cell", TIME), np.tile([1.0, 2.0, 3.0], (len(TIME), 1)))
    np.testing.assert_array_equal(read("gyro", TIME)[0], [8.0, 9.0, 10.0])
    assert not read("place", TIME).any()
    qpos, _ = SensorBias("encoder", "cell").true_state(m, np.array([0.5]), np.zeros(1), values[1:5])
    assert qpos == pytest.approx([-0.5])  # the force cell's zero says nothing about the joint
    light = world(CELL.replace('mass="1"', 'mass="1e-3"')).compile()
    assert SensorBias("cell").parameters(light)[0].scale == pytest.approx(0.1)
    slide = world(CELL.replace('axis="0 1 0"', 'type="slide"')).compile()
    assert SensorBias("current").parameters(slide)[0].unit == "N"
