from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.prediction import Prediction, PredictionCfg, SensorReader, SimulationRequest, turn
from tests.scenes.swinging import DAMPING, NOISE, drawing, swung, windows_of


@pytest.fixture(scope="module")
def recording():
    return swung()


@pytest.fixture(scope="module")
def windows(recording):
    return windows_of(recording, 1.0)


def damped(recording, windows):
    return Prediction(drawing(recording), (effect_class("joint_damping")("hinge"),), windows)


def test_residuals_at_the_truth_are_the_noise(recording, windows):
    prediction = damped(recording, windows[:1])
    (residual,) = prediction.residuals([SimulationRequest(0, np.array([DAMPING]))])
    assert len(residual) == windows[0].count
    assert np.std(residual) == pytest.approx(1.0, abs=0.2)
    (off,) = prediction.residuals([SimulationRequest(0, np.array([0.0]))])
    assert np.std(off) > 5


def test_an_effect_at_its_null_value_predicts_what_the_plain_model_does(recording, windows):
    prediction = damped(recording, windows)
    plain = Prediction(drawing(recording), (), windows)
    assert prediction.start.tolist() == [0.0]
    trials = [SimulationRequest(w, prediction.start) for w in range(len(windows))]
    bare = [replace(t, values=np.zeros(0)) for t in trials]
    for mine, other in zip(prediction.residuals(trials), plain.residuals(bare), strict=True):
        np.testing.assert_allclose(mine, other, atol=1e-6)


def test_effects_of_the_model_come_first_and_take_part(recording, windows):
    model = drawing(recording).add(effect_class("joint_friction")("hinge"), [0.004])
    prediction = Prediction(model, (effect_class("joint_damping")("hinge"),), windows)
    assert [p.name for p in prediction.parameters] == ["torque[hinge]", "damping[hinge]"]
    assert prediction.owned == 1
    assert prediction.start.tolist() == [0.004, 0.0]
    made = prediction.model(np.array([0.005, 0.01]), [(0.0, 1.0), (0.0, 2.0)])
    assert [(a.effect.name, a.values, a.intervals) for a in made.effects] == [
        ("joint_friction", (0.005,), ((0.0, 1.0),)),
        ("joint_damping", (0.01,), ((0.0, 2.0),)),
    ]


def test_a_simulation_that_begins_early_follows_commands_and_is_read_at_the_times_of_the_window(recording, windows):
    values, steps, w = np.array([DAMPING]), 7, windows[0]
    step = damped(recording, windows).compiled.opt.timestep
    (course,) = damped(recording, [w]).courses([SimulationRequest(0, values)])
    later = replace(w, start=w.start + steps * step, qpos=course.qpos[steps], qvel=course.qvel[steps])
    offset = np.concatenate([course.qpos[0] - course.qpos[steps], course.qvel[0] - course.qvel[steps]])
    early = SimulationRequest(0, values, offset, steps * step)
    prediction = damped(recording, [later])
    found, late = prediction.readers([early, replace(early, early=0.0)])
    time = np.linspace(0.0, w.end - later.start - steps * step, 60)
    np.testing.assert_allclose(found("angle", time), course.reader("angle", time + steps * step), atol=1e-9)
    # It is not taken for the one that begins in the same state at the window's start.
    assert np.abs(late("angle", time) - found("angle", time)).max() > 0.01
    assert prediction.readers([early])[0] is found


def test_what_was_simulated_lately_is_not_simulated_again(recording, windows):
    prediction = damped(recording, windows)
    first = prediction.residuals([SimulationRequest(0, np.array([DAMPING])), SimulationRequest(1, np.array([DAMPING]))])
    once = prediction.simulated
    again = prediction.residuals([SimulationRequest(1, np.array([DAMPING])), SimulationRequest(0, np.array([DAMPING]))])
    assert prediction.simulated == once
    for mine, other in zip(again, first[::-1], strict=True):
        np.testing.assert_array_equal(mine, other)
    prediction.residuals([SimulationRequest(0, np.array([DAMPING]), np.array([0.0, 1e-9]))])
    assert prediction.simulated > once


def test_one_simulation_serves_all_values_of_an_effect_of_measurement(recording, windows):
    prediction = Prediction(drawing(recording), (effect_class("latency")("angle"),), windows[:1])
    first, later = (prediction.residuals([SimulationRequest(0, np.array([delay]))])[0] for delay in (0.0, 0.01))
    assert prediction.simulated == pytest.approx(windows[0].end - windows[0].start, abs=0.01)
    assert np.std(later - first) > 1


def test_no_more_simulations_are_kept_than_memory_allows(recording, windows):
    effects = (effect_class("joint_damping")("hinge"),)
    prediction = Prediction(drawing(recording), effects, windows[:1], cfg=PredictionCfg(cache_bytes=5000))
    for _ in range(2):
        before = prediction.simulated
        prediction.residuals([SimulationRequest(0, np.array([value])) for value in np.linspace(0.0, 0.1, 20)])
        assert prediction.simulated - before > 15 * (windows[0].end - windows[0].start)


def test_an_offset_moves_the_start_of_the_simulation(recording, windows):
    prediction = damped(recording, windows[:1])
    at_rest, moved = prediction.readers(
        [SimulationRequest(0, prediction.start), SimulationRequest(0, prediction.start, np.array([0.02, 0.5]))]
    )
    first = np.array([0.0, 0.005])
    difference = (moved("angle", first) - at_rest("angle", first))[:, 0]
    assert difference[0] == pytest.approx(0.02, abs=1e-9)
    assert difference[1] == pytest.approx(0.0225, abs=2e-4)


def test_effects_of_measurement_alone_shift_readings_without_a_simulation_of_their_own(recording, windows):
    prediction = Prediction(drawing(recording), (effect_class("sensor_bias")("angle"),), windows[:1])
    assert prediction.measured_only.tolist() == [True]
    assert not damped(recording, windows).measured_only.any()
    at_null, shifted = prediction.residuals(
        [SimulationRequest(0, np.array([0.0])), SimulationRequest(0, np.array([0.005]))]
    )
    np.testing.assert_allclose(at_null - shifted, 0.005 / NOISE, rtol=1e-9)


def test_an_orientation_has_three_residuals_in_units_of_its_noise():
    recording = swung(quaternion=True)
    window = windows_of(recording, 1.0)[0]
    sizes = {r.channel: r.rows.stop - r.rows.start for r in window.readings}
    assert sizes["turned"] == 3 * sizes["angle"]
    prediction = Prediction(drawing(recording), (effect_class("joint_damping")("hinge"),), [window])
    (residual,) = prediction.residuals([SimulationRequest(0, np.array([DAMPING]))])
    for r in window.readings:
        assert np.std(residual[r.rows]) == pytest.approx(1.0, abs=0.25)


def test_a_reader_is_linear_between_records_and_a_little_beyond():
    m = mujoco.MjModel.from_xml_string(swung_scene := swung().scene)
    assert swung_scene
    time = 0.1 * np.arange(4)
    read = SensorReader(m, time, (2 * time)[:, None])
    asked = np.array([-0.02, 0.05, 0.23, 0.32, 9.0])
    np.testing.assert_allclose(
        read("angle", asked)[:, 0], [-0.04, 0.1, 0.46, 0.64, 2 * (0.3 + PredictionCfg().extrapolation)]
    )


def test_a_reader_of_orientations_takes_the_short_way_and_keeps_the_norm():
    m = mujoco.MjModel.from_xml_string(swung(quaternion=True).scene)
    ends = Rotation.from_rotvec([[0, 0.2, 0], [0, 0.4, 0]]).as_quat(scalar_first=True)
    ends[1] *= -1
    read = SensorReader(m, np.array([0.0, 1.0]), np.column_stack([np.zeros(2), ends]))
    value = read("turned", np.array([0.5]))
    assert np.linalg.norm(value) == pytest.approx(1.0)
    np.testing.assert_allclose(turn(ends[:1], value)[0], [0, 0.1, 0], atol=1e-9)


def test_turn_is_the_rotation_vector_in_the_frame_of_the_start():
    start = Rotation.from_rotvec([[0.3, 0, 0], [0, 0, 0]])
    step = Rotation.from_rotvec([[0, 0, 0.1], [0, 0, 0]])
    found = turn(start.as_quat(scalar_first=True), (start * step).as_quat(scalar_first=True))
    np.testing.assert_allclose(found[0], [0, 0, 0.1], atol=1e-12)
    lost = turn(np.full((1, 4), np.nan), np.array([[1.0, 0, 0, 0]]))
    assert np.isnan(lost).all()
