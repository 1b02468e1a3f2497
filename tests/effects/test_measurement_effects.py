import numpy as np
import pytest
from small_worlds import BLOCK, PENDULUM, G, world

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


def test_ruler_scales_positions_and_leaves_what_it_does_not_measure():
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
