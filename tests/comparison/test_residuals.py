from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.comparison.residuals import _rms_mean_distance, residuals
from concent_warp.errors import RecordingError
from concent_warp.estimation.noise_ratio import noise_ratio, rms_noise
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, PointTrack
from concent_warp.scene.scene import Scene
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.replay import replay

XML = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body name="cube"><freejoint name="cube"/><geom type="box" size=".1 .1 .1" mass="1"/></body>
    <body name="slide" pos="0 2 0"><joint name="slide" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body>
    <body name="hinge" pos="0 4 0"><joint name="hinge" type="hinge"/><geom size=".1" mass="1"/></body>
  </worldbody>
  <tendon><fixed name="cable"><joint joint="slide" coef="1"/></fixed></tendon>
  <sensor>
    <framepos name="cube_position" objtype="xbody" objname="cube"/>
    <framequat name="cube_orientation" objtype="xbody" objname="cube"/>
    <jointpos name="slide" joint="slide"/>
    <jointpos name="hinge" joint="hinge"/>
    <tendonpos name="cable" tendon="cable"/>
    <gyro name="gyro" site="imu"/>
  </sensor>
</mujoco>
""".replace('<geom type="box"', '<site name="imu"/><geom type="box"')
VELOCITY = np.array([0.3, 0.0, 0.1, 0.0, 0.0, 0.8, 0.2, 0.5])
TIME = np.linspace(0, 1, 41)


@pytest.fixture(scope="module")
def engine():
    return MujocoEngine(Model(Scene(XML)))


@pytest.fixture(scope="module")
def exact(engine):
    """A demonstration that measures exactly what the model does, with points on the cube."""
    m = engine.compiled
    turn = np.zeros((len(TIME), 4))
    for i, t in enumerate(TIME):
        mujoco.mju_axisAngle2Quat(turn[i], np.array([0, 0, 1.0]), 0.8 * t)
    position = TIME[:, None] * VELOCITY[:3]
    measured = {
        "cube_position": Channel(TIME, position, noise_std=1e-3),
        "cube_orientation": Channel(TIME, -turn),  # the same rotation
        "slide": Channel(TIME, 0.2 * TIME[:, None], noise_std=1e-3),
        "hinge": Channel(TIME, 0.5 * TIME[:, None]),
        "cable": Channel(TIME, 0.2 * TIME[:, None]),
        "gyro": Channel(TIME, np.tile([0, 0, 0.8], (len(TIME), 1))),
    }
    local = np.random.default_rng(0).uniform(-0.1, 0.1, (30, 3))
    rotation = np.zeros((len(TIME), 9))
    for i in range(len(TIME)):
        mujoco.mju_quat2Mat(rotation[i], turn[i])
    points = position[:, None] + np.einsum("tij,mj->tmi", rotation.reshape(-1, 3, 3), local)
    track = PointTrack(TIME, points, np.ones(points.shape[:2], dtype=bool))
    return Demonstration("demo_0", qpos=m.qpos0.copy(), qvel=VELOCITY, measured=measured, points={"cube": track})


def found(engine, demonstration):
    rollout = replay(engine.model, demonstration, engine)
    return {r.channel: r for r in residuals(engine.compiled, rollout, demonstration)}


def change(demonstration, name, **fields):
    return replace(
        demonstration,
        measured={**demonstration.measured, name: replace(demonstration.measured[name], **fields)},
    )


def test_an_exact_measurement_leaves_no_residual_in_any_channel(engine, exact):
    for residual in found(engine, exact).values():
        assert np.nanmax(residual.error) < 2e-5, residual.channel


def test_units_kinds_and_bodies_are_those_of_the_sensors(engine, exact):
    r = found(engine, exact)
    assert [(r[c].kind, r[c].unit, r[c].body) for c in r] == [
        ("position", "m", "cube"),
        ("orientation", "rad", "cube"),
        ("joint", "m", "slide"),
        ("joint", "rad", "hinge"),
        ("joint", "m", None),
        ("other", "rad/s", "cube"),
        ("points", "m", "cube"),
    ]


def test_position_error_is_the_euclidean_distance(engine, exact):
    off = change(exact, "cube_position", value=exact.measured["cube_position"].value + np.array([0.03, 0.04, 0]))
    assert found(engine, off)["cube_position"].error == pytest.approx(0.05, abs=1e-5)


def test_orientation_error_is_the_angle_and_its_value_the_rotation_vector(engine, exact):
    turned = np.zeros((len(TIME), 4))
    extra = np.array([np.cos(0.1), np.sin(0.1), 0, 0])
    for i, q in enumerate(exact.measured["cube_orientation"].value):
        mujoco.mju_mulQuat(turned[i], q, extra)
    r = found(engine, change(exact, "cube_orientation", value=turned))["cube_orientation"]
    assert r.error == pytest.approx(0.2, abs=1e-5)
    assert r.value == pytest.approx(np.tile([0.2, 0, 0], (len(TIME), 1)), abs=1e-5)


def test_missing_samples_have_no_error(engine, exact):
    value = exact.measured["cube_position"].value.copy()
    value[3:7] = np.nan
    error = found(engine, change(exact, "cube_position", value=value))["cube_position"].error
    assert np.isnan(error[3:7]).all()
    assert np.isfinite(np.delete(error, slice(3, 7))).all()


def test_components_are_missing_one_by_one(engine, exact):
    """A vector known in part has the error that it would have if what is missing were like what is not."""
    value = exact.measured["cube_position"].value + np.array([0.03, 0.03, 0.03])
    value[3:7, 1] = np.nan
    value[7] = [np.nan, np.nan, value[7, 2]]
    value[9] = np.nan
    r = found(engine, change(exact, "cube_position", value=value))["cube_position"]
    assert np.delete(r.error, 9) == pytest.approx(0.03 * np.sqrt(3), abs=1e-5)
    assert np.isnan(r.error[9])


def test_a_channel_of_heights_alone_has_the_error_and_the_noise_of_heights(engine, exact):
    value = exact.measured["cube_position"].value + np.array([0.5, 0.5, 0.03])
    rng = np.random.default_rng(0)
    value += 1e-3 * rng.normal(size=value.shape)
    value[:, :2] = np.nan
    r = found(engine, change(exact, "cube_position", value=value))["cube_position"]
    assert r.error == pytest.approx(np.full(len(TIME), 0.03), abs=5e-3)
    assert r.noise == pytest.approx(1e-3, rel=0.3)
    assert r.noise == r.std
    assert r.extent == pytest.approx(np.ptp(value[:, 2]))


def test_a_diverged_model_is_infinitely_off_and_not_left_out(engine, exact):
    rollout = replay(engine.model, exact, engine)
    for field in (rollout.sensordata, rollout.body_position, rollout.body_quaternion):
        field[0][60:] = np.nan
    for r in residuals(engine.compiled, rollout, exact):
        assert np.isinf(r.error[-1]), r.channel
        assert np.isfinite(r.error[:20]).all(), r.channel


def test_points_are_followed_as_material_points(engine, exact):
    track = exact.points["cube"]
    shifted = track.value.copy()
    shifted[20:] += [0, 0, 0.01]
    r = found(engine, replace(exact, points={"cube": replace(track, value=shifted)}))["cube points"]
    assert r.error[:20] == pytest.approx(0, abs=2e-5)
    assert r.error[20:] == pytest.approx(0.01, abs=2e-5)
    assert r.value[30] == pytest.approx([0, 0, 0.01], abs=2e-5)


def test_points_never_seen_at_the_start_take_no_part_and_unseen_frames_have_no_error(engine, exact):
    track = exact.points["cube"]
    visible, value = track.visible.copy(), track.value.copy()
    visible[:10, :5] = False
    value[10:, :5] += 1.0
    visible[15] = False
    r = found(engine, replace(exact, points={"cube": replace(track, value=value, visible=visible)}))["cube points"]
    assert np.isnan(r.error[15])
    assert np.nanmax(r.error) < 2e-5


def test_noise_floor_is_the_mean_error_that_noise_alone_leaves(engine, exact):
    rng = np.random.default_rng(1)
    position = exact.measured["cube_position"]
    noisy = change(exact, "cube_position", value=position.value + rng.normal(0, 1e-3, position.value.shape))
    track = exact.points["cube"]
    noisy = replace(noisy, points={"cube": replace(track, value=track.value + rng.normal(0, 1e-3, track.value.shape))})
    r = found(engine, noisy)
    assert r["cube_position"].noise == pytest.approx(1e-3 * np.sqrt(3))
    for name, tolerance in (("cube_position", 0.25), ("cube points", 0.15)):
        ratio = r[name].ratio
        assert ratio is not None
        assert noise_ratio(ratio[5:]) == pytest.approx(1, rel=tolerance)
    assert r["hinge"].noise is None


@pytest.mark.parametrize("dim", [1, 3, 4])
def test_noise_alone_is_one_times_the_noise_whether_by_components_or_by_lengths(dim):
    noise = 0.2 * np.random.default_rng(0).normal(size=(200_000, dim))
    assert noise_ratio(noise, 0.2) == pytest.approx(1, rel=5e-3)
    lengths = np.linalg.norm(noise, axis=1)
    assert noise_ratio(lengths, rms_noise(0.2, dim)) == pytest.approx(noise_ratio(noise, 0.2))
    assert noise_ratio(np.append(3 * lengths, np.nan), rms_noise(0.2, dim)) == pytest.approx(3, rel=5e-3)
    assert noise_ratio(np.append(lengths, np.inf), rms_noise(0.2, dim)) == np.inf
    assert np.isnan(noise_ratio(np.array([np.nan])))


@pytest.mark.parametrize("count", [1, 4])
def test_mean_distances_of_points_have_the_root_mean_square_of_the_maxwell_distribution(count):
    noise = np.random.default_rng(0).normal(size=(100_000, count, 3))
    mean = np.linalg.norm(noise, axis=2).mean(axis=1)
    assert _rms_mean_distance(np.full(10, count)) == pytest.approx(noise_ratio(mean), rel=5e-3)


def test_a_sensor_that_the_model_lacks_is_named(engine, exact):
    rollout = replay(engine.model, exact, engine)
    stranger = replace(exact, measured={"nose": Channel(TIME, np.zeros((len(TIME), 1)))})
    with pytest.raises(RecordingError, match=r"demo_0: .*'nose'.*cube_position"):
        residuals(engine.compiled, rollout, stranger)


def test_a_measurement_of_another_dimension_is_refused(engine, exact):
    rollout = replay(engine.model, exact, engine)
    with pytest.raises(RecordingError, match=r"'slide'.*expected 1, found 2"):
        residuals(engine.compiled, rollout, change(exact, "slide", value=np.zeros((len(TIME), 2))))


def test_points_of_an_unknown_body_are_refused(engine, exact):
    rollout = replay(engine.model, exact, engine)
    with pytest.raises(RecordingError, match="'ghost'"):
        residuals(engine.compiled, rollout, replace(exact, points={"ghost": exact.points["cube"]}))
