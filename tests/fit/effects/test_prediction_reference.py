"""Predictions against simulations with MuJoCo alone: initial states, commands with a history, what is kept."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.fading import (
    ReferenceSimulation,
    _has_faded,
    is_long,
    residuals_near,
)
from concent_warp.fit.effects.prediction import (
    Course,
    Prediction,
    PredictionCfg,
    SensorReader,
    SimulationRequest,
    of_similar_length,
    turn,
)
from concent_warp.simulate.mujoco_engine import MujocoEngine
from tests.scenes.swinging import DAMPING, NOISE, drawing, swung, windows_of

AFTER, FADED, LONG = 1.0, 1e-3, 3.0
WATCHED = (0.75, 0.85, 0.95, 1.0)
BEYOND, LOST = 0.05, 1e3
NONE = np.zeros(0)


@pytest.fixture(scope="module")
def recording():
    return swung(seconds=1.0, quaternion=True)


@pytest.fixture(scope="module")
def windows(recording):
    return windows_of(recording, 0.4)


def simulated(recording: Any, window: Any, offset: np.ndarray, *, delay: float = 0.0, damping: float = 0.0) -> Any:
    """Return times, angles and orientations of the pendulum from a window's start, by MuJoCo alone."""
    m = mujoco.MjModel.from_xml_string(recording.scene)
    m.dof_damping[0] += damping
    d = mujoco.MjData(m)
    d.qpos[0], d.qvel[0] = window.qpos[0] + offset[0], window.qvel[0] + offset[1]
    action = recording[0].action["servo"]
    rows = []
    for k in range(round((window.end - window.start) / m.opt.timestep) + 1):
        asked = window.start + k * m.opt.timestep - delay + 1e-9
        d.ctrl[0] = np.ravel(action.value)[max(np.searchsorted(action.time, asked, side="right") - 1, 0)]
        mujoco.mj_forward(m, d)
        rows.append(d.sensordata.copy())
        mujoco.mj_step(m, d)
    rows = np.array(rows)
    return m.opt.timestep * np.arange(len(rows)), rows[:, 0], rows[:, 1:5]


@pytest.mark.parametrize("delay", [0.0, 0.05])
def test_residuals_are_measured_less_simulated_over_noise(recording, windows, delay):
    effects = [effect_class("joint_damping")("hinge"), effect_class("actuator_delay")("servo")]
    prediction = Prediction(drawing(recording), effects, windows)
    values, offset = np.array([DAMPING, delay]), np.array([0.02, -0.3])
    requests = [SimulationRequest(w, values, offset) for w in range(len(windows))]
    for window, residual in zip(windows, prediction.residuals(requests), strict=True):
        time, angle, turned = simulated(recording, window, offset, delay=delay, damping=DAMPING)
        assert len(residual) == window.count
        for reading in window.readings:
            mine = residual[reading.rows]
            rows = np.searchsorted(time, reading.time - 1e-9)
            inside = rows < len(time)
            if reading.orientation:
                mine = mine.reshape(-1, 3)[inside]
                simulated_turn = Rotation.from_quat(turned[rows[inside]], scalar_first=True)
                seen = Rotation.from_quat(reading.value[inside], scalar_first=True)
                expected = (simulated_turn.inv() * seen).as_rotvec()
            else:
                mine = mine[inside]
                expected = reading.value[inside, 0] - angle[rows[inside]]
            np.testing.assert_allclose(mine, expected / reading.std, atol=2e-4 / NOISE * 1e-3)


def test_the_time_that_was_simulated_counts_whole_steps(recording, windows):
    prediction = Prediction(drawing(recording), (), windows, threads=1)
    assert prediction.simulated == 0
    span = windows[0].end - windows[0].start
    steps = round(span / 0.005)
    assert prediction._steps(0, None) == steps
    assert prediction._steps(0, 0.0501) == 11
    assert prediction._steps(0, 0.05) == 10
    assert prediction._steps(0, 1e-9) == 1
    assert prediction._steps(0, 100.0) == steps
    trials = [SimulationRequest(0, NONE), SimulationRequest(0, NONE, np.array([0.1, 0.0]))]
    courses = prediction.courses(trials, 0.05)
    assert prediction.simulated == pytest.approx(2 * 10 * 0.005)
    assert [c.qpos.shape for c in courses] == [(11, 1)] * 2
    assert courses[1].qpos[0, 0] - courses[0].qpos[0, 0] == pytest.approx(0.1)
    assert courses[0].size == 11 * 5 * 8


def test_windows_that_differ_by_few_steps_are_simulated_in_one_call_the_longest_first():
    steps = [50, 100, 99, 97, 30]
    assert of_similar_length(range(5), steps, 4) == [[1, 2, 3], [0], [4]]
    assert of_similar_length(range(5), steps, 3) == [[1, 2], [3], [0], [4]]
    assert of_similar_length([4, 0], steps, 100) == [[0, 4]]
    assert of_similar_length([1, 1, 2], steps, 0) == [[1, 1], [2]]
    assert of_similar_length([], steps, 4) == []


def test_what_is_simulated_beyond_a_window_is_left_out(recording, windows):
    one, other = windows[0], replace(windows[1], end=windows[1].end - 0.02)
    prediction = Prediction(drawing(recording), (), [one, other])
    both = prediction.courses([SimulationRequest(0, NONE), SimulationRequest(1, NONE)])
    for w, course in enumerate(both):
        (alone,) = prediction.only([w]).courses([SimulationRequest(0, NONE)])
        assert course.qpos.shape == alone.qpos.shape
        assert course.size == alone.size
        late = np.array([course.qpos.shape[0] * 0.005 + 0.02])
        np.testing.assert_allclose(course.reader("angle", late), alone.reader("angle", late), atol=1e-12)


def test_trials_of_several_windows_and_lengths_come_back_in_order(recording, windows):
    effects = [effect_class("joint_damping")("hinge")]
    prediction = Prediction(drawing(recording), effects, windows)
    trials = [SimulationRequest(w, np.array([v])) for w, v in ((1, 0.0), (0, 0.1), (1, 0.1), (0, 0.0))]
    together = prediction.courses(trials)
    for trial, found in zip(trials, together, strict=True):
        (alone,) = prediction.courses([trial])
        np.testing.assert_allclose(found.qpos, alone.qpos, atol=1e-12)
        assert found.qpos[0, 0] == windows[trial.window].qpos[0]


def test_only_some_windows_are_predicted_with_a_memory_of_their_own(recording, windows):
    prediction = Prediction(drawing(recording), (), windows)
    prediction.residuals([SimulationRequest(0, NONE)])
    part = prediction.only([1])
    assert part.windows == [windows[1]]
    assert prediction.windows == windows
    assert part._kept == {}
    (mine,) = part.residuals([SimulationRequest(0, NONE)])
    (whole,) = prediction.residuals([SimulationRequest(1, NONE)])
    np.testing.assert_array_equal(mine, whole)
    assert len(prediction._kept) == 2


def test_a_simulation_is_asked_for_by_window_values_and_offset(recording, windows):
    effects = [effect_class("joint_damping")("hinge"), effect_class("sensor_bias")("angle")]
    prediction = Prediction(drawing(recording), effects, windows)
    assert prediction.measured_only.tolist() == [False, True]
    base = prediction._key(SimulationRequest(0, np.array([0.1, 0.2])))
    assert base == prediction._key(SimulationRequest(0, np.array([0.1, 0.3])))
    others = [
        SimulationRequest(1, np.array([0.1, 0.2])),
        SimulationRequest(0, np.array([0.2, 0.2])),
        SimulationRequest(0, np.array([0.1, 0.2]), np.zeros(2)),
    ]
    assert all(prediction._key(other) != base for other in others)
    prediction.readers([SimulationRequest(0, np.array([0.1, v])) for v in (0.0, 0.1)])
    assert prediction.simulated == pytest.approx(windows[0].end - windows[0].start)


def test_effects_reach_back_whole_steps_and_threads_are_those_asked_for(recording, windows):
    delayed = effect_class("actuator_delay")("servo")
    prediction = Prediction(drawing(recording), (delayed,), windows, threads=1)
    m = prediction.compiled
    assert prediction._before(m) == int(np.ceil(delayed.history / 0.005))
    assert Prediction(drawing(recording), (), windows)._before(m) == 0
    engine: Any = prediction._engine(prediction._engine_key(prediction.start))[0]
    assert engine.threads == 1
    free: Any = Prediction(drawing(recording), (delayed,), windows)._engine((tuple(prediction.start.tolist()), ()))[0]
    assert free.threads == MujocoEngine(drawing(recording)).threads


def test_the_oldest_simulations_are_forgotten_first(recording, windows):
    prediction = Prediction(drawing(recording), (effect_class("joint_damping")("hinge"),), windows)
    trials = [SimulationRequest(0, np.array([v])) for v in (0.0, 0.1, 0.2)]
    size = prediction.courses(trials[:1])[0].size
    prediction.cfg = PredictionCfg(cache_bytes=2 * size)
    prediction.readers(trials)
    assert list(prediction._kept) == [prediction._key(t) for t in trials[1:]]


def test_models_that_were_compiled_are_kept_up_to_nine(recording, windows):
    edited = effect_class("joint_damping")("hinge")
    prediction = Prediction(drawing(recording), (edited,), windows)
    prediction._edits = [0]  # as if the damping had to be compiled in
    keys = [prediction._engine_key(np.array([0.001 * k])) for k in range(10)]
    engines = [prediction._engine(key)[0] for key in keys[:9]]
    assert all(prediction._engine(key)[0] is e for key, e in zip(keys, engines, strict=False))
    prediction._engine(keys[9])
    assert list(prediction._engines) == keys[1:] == [((0.001 * k,), ()) for k in range(1, 10)]


def test_a_simulation_that_diverges_is_lost_by_a_large_residual(recording, windows):
    prediction = Prediction(drawing(recording), (), windows)
    window = windows[0]
    wide = [replace(r, value=r.value + (0.0 if r.orientation else 1e9)) for r in window.readings]
    prediction.windows[0] = replace(window, readings=tuple(wide))

    def at(value: float) -> np.ndarray:
        return prediction.observed(
            0, lambda sensor, time: np.full((len(time), 4 if sensor == "turned" else 1), value), NONE
        )

    angle, turned = (r.rows for r in window.readings)
    for value, sign in ((np.nan, 1.0), (-np.inf, 1.0), (np.inf, -1.0), (0.5, 1.0)):
        np.testing.assert_array_equal(at(value)[angle], sign * LOST)
    np.testing.assert_array_equal(at(np.nan)[turned], LOST)


def test_readings_count_from_the_start_of_the_recording_for_effects_of_measurement(recording, windows):
    later = windows[1]
    prediction = Prediction(drawing(recording), (), windows)
    asked: list[Any] = []

    def read(sensor: str, time: np.ndarray) -> np.ndarray:
        asked.append((sensor, time))
        return np.ones((len(time), 4 if sensor == "turned" else 1))

    prediction.observed(1, read, NONE)
    for (sensor, time), reading in zip(asked, later.readings, strict=True):
        assert sensor == reading.channel
        np.testing.assert_allclose(time, reading.time, atol=1e-12)


def test_a_model_with_values_and_intervals_is_made_part_by_part(recording, windows):
    effects = [effect_class("joint_damping")("hinge"), effect_class("sensor_bias")("angle")]
    prediction = Prediction(drawing(recording), effects, windows)
    made = prediction.model(np.array([0.1, 0.2]), [(0.0, 0.3), (0.1, 0.4)])
    assert [(a.values, a.intervals) for a in made.effects] == [((0.1,), ((0.0, 0.3),)), ((0.2,), ((0.1, 0.4),))]
    assert [a.intervals for a in prediction.model(np.array([0.1, 0.2])).effects] == [(), ()]
    assert prediction.split == [slice(0, 1), slice(1, 2)]
    assert prediction.compiled.nv == 1


@pytest.fixture(scope="module")
def sensors():
    return mujoco.MjModel.from_xml_string(swung(seconds=0.3, quaternion=True).scene)


def test_a_reader_interpolates_as_numpy_does(sensors):
    rng = np.random.default_rng(0)
    time = 1.5 + 0.04 * np.arange(12)
    data = rng.normal(size=(12, 5))
    read = SensorReader(sensors, time, data)
    asked = rng.uniform(1.5, 1.94, 200)
    np.testing.assert_allclose(read("angle", asked)[:, 0], np.interp(asked, time, data[:, 0]), atol=1e-12)
    np.testing.assert_allclose(read("angle", time)[:, 0], data[:, 0], atol=1e-7)
    slopes = (data[1, 0] - data[0, 0]) / 0.04, (data[-1, 0] - data[-2, 0]) / 0.04
    outside = read("angle", np.array([1.47, 1.5 - BEYOND, 0.0, 1.97, 1.94 + BEYOND, 5.0]))[:, 0]
    before, after = (0.03, BEYOND, BEYOND), (0.03, BEYOND, BEYOND)
    expected = [data[0, 0] - s * slopes[0] for s in before] + [data[-1, 0] + s * slopes[1] for s in after]
    np.testing.assert_allclose(outside, expected, atol=1e-9)
    assert read("angle", asked).shape == (200, 1)


def test_a_reader_of_one_record_repeats_it(sensors):
    read = SensorReader(sensors, np.array([2.0]), np.arange(5.0)[None])
    np.testing.assert_array_equal(read("angle", np.array([0.0, 2.0, 9.0])), np.zeros((3, 1)))
    np.testing.assert_array_equal(read("turned", np.array([0.0, 2.0])), [[1, 2, 3, 4]] * 2)


def test_a_reader_of_two_records_is_a_line(sensors):
    read = SensorReader(sensors, np.array([0.0, 0.5]), np.array([[1.0] * 5, [2.0] * 5]))
    np.testing.assert_allclose(read("angle", np.array([0.0, 0.25, 0.5]))[:, 0], [1.0, 1.5, 2.0])


def test_orientations_between_records_are_normalised_mixtures_of_one_hemisphere(sensors):
    rng = np.random.default_rng(1)
    quats = rng.normal(size=(6, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    read = SensorReader(sensors, np.arange(6.0), np.column_stack([np.zeros(6), quats]))
    asked = rng.uniform(0, 5, 60)
    for t, found in zip(asked, read("turned", asked), strict=True):
        k, share = int(t), t - int(t)
        mixed = (1 - share) * quats[k] + share * quats[k + 1] * np.sign(quats[k] @ quats[k + 1])
        np.testing.assert_allclose(found, mixed / np.linalg.norm(mixed), atol=1e-7)


def test_the_turn_between_orientations_is_lost_where_one_is():
    rng = np.random.default_rng(2)
    first, second = Rotation.random(5, rng=rng), Rotation.random(5, rng=rng)
    start = first.as_quat(scalar_first=True)
    start[2, 1] = np.nan
    found = turn(start, second.as_quat(scalar_first=True))
    expected = (first.inv() * second).as_rotvec()
    np.testing.assert_allclose(np.delete(found, 2, axis=0), np.delete(expected, 2, axis=0), atol=1e-12)
    assert np.isnan(found[2]).all()
    assert turn(np.full((2, 4), np.inf), np.ones((2, 4))).shape == (2, 3)


class Plain:
    """A prediction of one window of 4 s with two velocities, for `_has_faded` and `residuals_near`."""

    def __init__(self) -> None:
        self.compiled = mujoco.MjModel.from_xml_string(
            "<mujoco><worldbody><body><joint type='slide'/><geom size='1'/></body></worldbody></mujoco>"
        )
        clock = np.array([3.0, 3.5, 4.0, 4.5, 5.0])
        spread = np.array([0.1, 2.0])
        self.windows = [SimpleNamespace(spread=spread, start=3.0, end=3.0 + LONG, clock=clock)]
        self.asked: list[Any] = []

    def courses(self, trials: Any, time: float) -> list[Course]:
        assert time == AFTER
        return [self.course(t.offset) for t in trials]

    def course(self, offset: Any) -> Course:
        left = np.zeros(2) if offset is None else offset
        fading = np.where(np.arange(21) < 15, 1.0, 0.0)
        if left[0] > 0.5:
            fading = np.ones(21)
        away = fading[:, None] * left
        return Course(lambda _, t: left[0] + 0 * t, away[:, :1], away[:, 1:], 8)

    def observed(self, window: int, reader: Any, values: Any) -> np.ndarray:
        del values
        return reader("x", self.windows[window].clock)

    def residuals(self, trials: Any) -> list[np.ndarray]:
        self.asked += list(trials)
        return [np.full(5, -1.0 - (0 if t.offset is None else t.offset[0])) for t in trials]


def test_only_long_windows_may_fade():
    plain: Any = Plain()
    assert is_long(plain, 0)
    plain.windows[0].end -= 1e-6
    assert not is_long(plain, 0)


def test_residuals_change_within_the_time_that_is_simulated_where_errors_fade():
    plain: Any = Plain()
    known = {0: ReferenceSimulation(SimulationRequest(0, NONE, np.array([0.2, 0.0])), np.arange(5.0))}
    offsets = [np.array([0.3, 0.1]), np.array([0.8, 0.0]), np.array([0.1, 0.0])]
    trials = [SimulationRequest(0, NONE, offset) for offset in offsets]
    found, faded = residuals_near(plain, known, trials, [True, True, False])
    assert faded == [True, False, False]
    np.testing.assert_allclose(found[0], np.arange(5.0) + np.array([0.1, 0.1, 0.1, 0.0, 0.0]))
    np.testing.assert_allclose(found[1], -1.8)
    np.testing.assert_allclose(found[2], -1.1)
    assert plain.asked == trials[1:]
    found, faded = residuals_near(plain, {}, trials[2:], [False])
    assert faded == [False]


@pytest.mark.parametrize("share", WATCHED)
@pytest.mark.parametrize("component", [0, 1])
def test_an_error_has_faded_where_a_thousandth_is_left_in_the_last_quarter(share, component):
    plain: Any = Plain()
    spread = np.array([0.1, 2.0])
    first = Course(lambda *_: NONE, np.zeros((101, 1)), np.zeros((101, 1)), 8)
    for left, expected in ((0.99, True), (1.01, False), (np.nan, False)):
        course = Course(lambda *_: NONE, np.zeros((101, 1)), np.zeros((101, 1)), 8)
        (course.qpos, course.qvel)[component][round(share * 100), 0] = left * FADED * 3.0 * spread[component]
        for sign in (1.0, -1.0):
            trial = SimulationRequest(0, NONE, np.array([0.1, sign * 6.0]))  # 3 spreads off
            assert _has_faded(plain, trial, SimulationRequest(0, NONE, None), course, first) is expected
            other = SimulationRequest(0, NONE, np.array([0.1, -sign * 2.0]))
            half = SimulationRequest(0, NONE, np.array([0.1, sign * 4.0]))
            assert _has_faded(plain, half, other, course, first) is expected
            assert _has_faded(plain, SimulationRequest(0, NONE, None), trial, course, first) is expected


def test_an_error_in_the_first_part_does_not_count():
    plain: Any = Plain()
    first = Course(lambda *_: NONE, np.zeros((101, 1)), np.zeros((101, 1)), 8)
    course = Course(lambda *_: NONE, np.zeros((101, 1)), np.zeros((101, 1)), 8)
    course.qpos[:75] = 1.0
    trial = SimulationRequest(0, NONE, np.array([0.1, 0.0]))
    assert _has_faded(plain, trial, SimulationRequest(0, NONE, None), course, first)
