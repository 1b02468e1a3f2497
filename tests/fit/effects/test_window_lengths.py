"""How long windows are: how fast small differences grow in simulations that are written down."""

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from concent_warp.fit.effects import observe as observing
from concent_warp.fit.effects.observation import ObservedRecording
from concent_warp.fit.effects.observe import keeps_close
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from concent_warp.scene.scene import Scene
from tests.scenes.swinging import drawing, swing_scene, swung


def observed(recording: Recording, **noise: float) -> ObservedRecording:
    return ObservedRecording(drawing(recording), recording, noise)


class Simulated:
    """An engine whose sensors read what is written down."""

    def __init__(self, sensordata: Any) -> None:
        self.sensordata, self.calls = sensordata, []

    def run(self, variants: Any, ctrl: np.ndarray, *, record: np.ndarray, bodies: Any) -> Any:
        self.calls.append((variants, ctrl, record, bodies))
        found = SimpleNamespace(sensordata=self.sensordata(record)[: len(variants.qpos)])
        return SimpleNamespace(numpy=lambda: found)


BENDS = np.array([4.0, 1.0, 5.0, 2.0, 3.0, 0.5])
"""Curvature of each pair's mean; the 0.8 quantile of six is the second largest."""


def diverging(timestep: float, angle: float = 0.0, turn: float = 0.0, scatter: float = 0.0) -> Any:
    """Return readings of an angle and of a turn about x; pairs part evenly, and their means bend by `angle` and `turn`.

    From nearly the same initial state, where that is simulated, the angle is off by `scatter` either way.
    """

    def sensordata(record: np.ndarray) -> np.ndarray:
        time = record * timestep
        data, turned = np.zeros((19, len(record), 5)), np.zeros((19, len(record)))
        data[:, :, 0] = np.sin(time)
        for k, bend in enumerate(BENDS):
            for row, sign in ((1 + 2 * k, 1.0), (2 + 2 * k, -1.0)):
                data[row, :, 0] += sign * (k + 1.0) * time + bend * angle * time**2
                turned[row] = sign * 0.3 * (k + 1.0) * time + bend * turn * time**2
        data[13::2, :, 0] += scatter
        data[14::2, :, 0] -= scatter
        data[:, :, 1], data[:, :, 2] = np.cos(turned / 2), np.sin(turned / 2)
        data[3:9, :, 1:] *= -1.0  # the same orientations
        return data

    return sensordata


def reach(
    engine: Simulated,
    monkeypatch: Any,
    *,
    start: float = 0.5,
    last: float = 1.9,
    rebounds: bool = False,
    **noise: float,
) -> float:
    monkeypatch.setattr(observing, "make_engine", lambda *_: engine)
    monkeypatch.setattr(observing, "has_touchable_free_body", lambda _: rebounds)
    recording = swung(quaternion=True)
    return keeps_close(observed(recording, **noise), recording[0], start, last, "mujoco", 3)


def test_a_window_ends_where_what_opposite_errors_do_differs_by_some_noise(monkeypatch):
    # 0.004 * 4 t^2 / 1e-3 > 3 from t = 0.433 on; records are 0.01 s apart.
    engine = Simulated(diverging(0.005, angle=0.004))
    assert reach(engine, monkeypatch, angle=1e-3, turned=1e-3) == pytest.approx(0.44)
    # A turn about one axis is one of three components.
    turning = diverging(0.005, turn=0.004 * np.sqrt(3))
    assert reach(Simulated(turning), monkeypatch, turned=1e-3) == pytest.approx(0.44)
    assert reach(Simulated(diverging(0.005, angle=0.004)), monkeypatch, turned=1e-3) == pytest.approx(1.4)
    both = diverging(0.005, angle=0.004, turn=0.01 * np.sqrt(3))
    assert reach(Simulated(both), monkeypatch, angle=1e-3, turned=1e-3) == pytest.approx(0.28)
    assert reach(Simulated(both), monkeypatch, turned=1e-3, angle=1e-4) == pytest.approx(0.14)
    assert reach(Simulated(both), monkeypatch, turned=1e-5, angle=1e-3) == pytest.approx(0.12)


@pytest.mark.parametrize(
    ("rate", "noise", "rebounds", "end"),
    [
        (8.0, 1e-5, False, 0.46),  # exp(4 t) > 6 from t = 0.448 on; records are 0.01 s apart
        (4.0, 1e-5, False, 0.9),
        (8.0, 1e-3, False, 0.46),  # 40 x noise by then
        (8.0, 2e-3, False, 0.52),  # 32 x noise
        (2.0, 1e-5, False, 1.4),  # not within the time
        (8.0, 1e-5, True, 1.4),  # bodies that move freely have rules of their own
    ],
)
def test_a_window_ends_where_errors_have_grown_exponentially(monkeypatch, rate, noise, rebounds, end):
    def sensordata(record: np.ndarray) -> np.ndarray:
        data = np.zeros((19, len(record), 5))
        sign = np.resize([1.0, -1.0], 12)[:, None]
        data[1:13, :, 0] = sign * 1e-3 * np.exp(rate * record * 0.005)
        data[:, :, 1] = 1.0
        return data

    assert reach(Simulated(sensordata), monkeypatch, angle=noise, rebounds=rebounds) == pytest.approx(end)


def test_errors_that_grow_as_those_of_a_body_in_a_constant_field_end_no_window(monkeypatch):
    def sensordata(record: np.ndarray) -> np.ndarray:
        data = np.zeros((19, len(record), 5))
        data[1:13, :, 0] = np.resize([1.0, -1.0], 12)[:, None] * (record * 0.005) ** 2
        data[:, :, 1] = 1.0
        return data

    assert reach(Simulated(sensordata), monkeypatch, angle=1e-6) == pytest.approx(1.4)


def test_scatter_of_rebounds_from_nearly_the_same_state_counts_as_noise_up_to_a_limit(monkeypatch):
    # 0.004 * 4 t^2 > 3 * 1e-3 hypot(1, 2) from t = 0.648 on, and with the limit of 5 from 0.978 on.
    for scatter, end in ((0.0, 0.44), (2e-3, 0.65), (1.0, 0.98)):
        engine = Simulated(diverging(0.005, angle=0.004, scatter=scatter))
        assert reach(engine, monkeypatch, angle=1e-3, rebounds=True) == pytest.approx(end)
        assert reach(engine, monkeypatch, angle=1e-3) == pytest.approx(0.44)


def test_pairs_start_off_by_the_noise_on_either_side(monkeypatch):
    engine = Simulated(diverging(0.005))
    assert reach(engine, monkeypatch, angle=2e-3, turned=1e-3, other=1.0) == pytest.approx(1.4)
    ((variants, ctrl, record, bodies),) = engine.calls
    assert (len(variants.qpos), bodies) == (13, [])
    np.testing.assert_array_equal(record, np.arange(0, 281, 2))
    recording = swung(quaternion=True)
    source = observed(recording, angle=2e-3)
    state = source.state(recording[0], 0.5)
    qpos, qvel = state.qpos, state.qvel
    rng = np.random.default_rng(3)
    np.testing.assert_array_equal([variants.qpos[0], variants.qvel[0]], [qpos, qvel])
    for k in range(6):
        offset = rng.normal(size=2) * [2e-3, 2e-3 / 0.03]
        np.testing.assert_allclose(variants.qpos[1 + 2 * k], qpos + offset[0], rtol=1e-12)
        np.testing.assert_allclose(variants.qpos[2 + 2 * k], qpos - offset[0], rtol=1e-12)
        np.testing.assert_allclose(variants.qvel[1 + 2 * k], qvel + offset[1], rtol=1e-12)
        np.testing.assert_allclose(variants.qvel[2 + 2 * k], qvel - offset[1], rtol=1e-12)
    action = recording[0].action["servo"]
    time = 0.5 + 0.005 * np.arange(280)
    np.testing.assert_array_equal(ctrl[:, 0], np.ravel(action.value)[(time / 0.25 + 1e-9).astype(int)])


def test_where_bodies_may_rebound_some_start_off_by_a_small_share_of_the_spread(monkeypatch):
    engine = Simulated(diverging(0.005))
    reach(engine, monkeypatch, angle=2e-3, rebounds=True)
    variants = engine.calls[0][0]
    recording = swung(quaternion=True)
    state = observed(recording, angle=2e-3).state(recording[0], 0.5)
    offsets = np.random.default_rng(3).normal(size=(12, 2))[6:] * 0.02 * 3.0 * [2e-3, 2e-3 / 0.03]
    assert len(variants.qpos) == 19
    np.testing.assert_allclose(variants.qpos[13:], state.qpos + offsets[:, :1], rtol=1e-12)
    np.testing.assert_allclose(variants.qvel[13:], state.qvel + offsets[:, 1:], rtol=1e-12)


def test_differences_that_are_not_finite_end_a_window_and_none_is_longer_than_the_longest(monkeypatch):
    def blown(record: np.ndarray) -> np.ndarray:
        data = diverging(0.005)(record)
        data[1:, record * 0.005 > 0.705] = np.inf
        return data

    assert reach(Simulated(blown), monkeypatch, angle=1e-3) == pytest.approx(0.71)
    assert reach(Simulated(diverging(0.005)), monkeypatch, last=100.0, angle=1e-3) == pytest.approx(20.0)
    engine = Simulated(diverging(0.005))
    assert reach(engine, monkeypatch, last=0.5021, angle=1e-3) == pytest.approx(0.0021)
    assert len(engine.calls[0][1]) == 1


@pytest.mark.parametrize(
    ("lasts", "rebounds", "free", "expected"),
    [(0.08, True, False, 1.4), (0.16, True, False, 0.4), (0.08, False, False, 0.4), (0.08, True, True, 0.4)],
)
def test_a_window_goes_on_after_a_rebound_that_one_start_has_earlier_than_its_opposite(
    monkeypatch, lasts, rebounds, free, expected
):
    def rebounding(record: np.ndarray) -> np.ndarray:
        data, time = diverging(0.005)(record), record * 0.005
        data[1:, (time > 0.395) & (time < 0.395 + lasts), 0] += 0.1
        return data

    monkeypatch.setattr(observing, "_may_rebound", lambda _: rebounds)
    assert reach(Simulated(rebounding), monkeypatch, rebounds=free, angle=1e-3) == pytest.approx(expected)


def test_what_drives_press_together_does_not_rebound_and_fly_on():
    driven = swing_scene()
    free = driven.replace('<actuator><position name="servo" joint="hinge" kp="1.0" kv="0.01"/></actuator>', "")
    alone = free.replace('mass="0.3"', 'mass="0.3" contype="0" conaffinity="0"')
    assert free != driven
    found = [observing._may_rebound(mujoco.MjModel.from_xml_string(xml)) for xml in (driven, free, alone)]
    assert found == [False, True, False]


@pytest.mark.parametrize(("second", "expected"), [(0.895, 0.67), (0.705, 0.4)])
def test_a_window_ends_midway_between_two_rebounds_and_at_the_first_of_several_in_a_row(monkeypatch, second, expected):
    def rebounding(record: np.ndarray) -> np.ndarray:
        data, time = diverging(0.005)(record), record * 0.005
        for begin in (0.395, second, 1.095):
            data[1:, (time > begin) & (time < begin + 0.05), 0] += 0.1
        return data

    monkeypatch.setattr(observing, "_may_rebound", lambda _: True)
    assert reach(Simulated(rebounding), monkeypatch, angle=1e-3) == pytest.approx(expected)


def test_a_window_goes_on_after_a_rebound_though_differences_grow_soon_after_it(monkeypatch):
    def growing(record: np.ndarray) -> np.ndarray:
        data, time = diverging(0.005)(record), record * 0.005
        data[1:, (time > 0.395) & (time < 0.445) | (time > 0.605), 0] += 0.1
        return data

    monkeypatch.setattr(observing, "_may_rebound", lambda _: True)
    assert reach(Simulated(growing), monkeypatch, angle=1e-3) == pytest.approx(0.53)


def test_a_window_ends_where_starts_differ_shortly_before_its_end(monkeypatch):
    def late(record: np.ndarray) -> np.ndarray:
        data = diverging(0.005)(record)
        data[1:, record * 0.005 > 1.345, 0] += 0.1
        return data

    monkeypatch.setattr(observing, "_may_rebound", lambda _: True)
    assert reach(Simulated(late), monkeypatch, angle=1e-3) == pytest.approx(1.35)


def test_records_are_every_step_where_steps_are_long(monkeypatch):
    engine = Simulated(diverging(0.02, angle=0.004))
    monkeypatch.setattr(observing, "make_engine", lambda *_: engine)
    recording = swung()
    model = Model(Scene(swing_scene().replace('timestep="0.005"', 'timestep="0.02"')))
    source = ObservedRecording(model, recording, {"angle": 1e-3})
    assert keeps_close(source, recording[0], 0.0, 1.0, "mujoco", 0) == pytest.approx(0.44)
    np.testing.assert_array_equal(engine.calls[0][2], np.arange(51))
