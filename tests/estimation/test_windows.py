import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from concent_warp.errors import RecordingError
from concent_warp.estimation.local_polynomial import LocalPolynomial, LocalPolynomialCfg, LocalPolynomialOrientation
from concent_warp.estimation.object_tracks import whole_demonstration
from concent_warp.estimation.state_estimator import StateEstimator
from concent_warp.estimation.windows import cut_windows, mark_held_out
from concent_warp.fit.fit_geometry import FitCfg, cut_segments, fit_geometry
from concent_warp.fit.geometry.evolution import EvolutionCfg
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, PointTrack, Recording
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.simulate.replay import step_count
from tests.scenes.tossing import EDGE, PERIOD, toss_scene, tosses

LENGTH = 0.1


@pytest.fixture(scope="module")
def recording() -> Recording:
    return tosses(12)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(toss_scene(EDGE))


def truth(scene: Scene, demonstration: Demonstration) -> dict[float, np.ndarray]:
    """Return qpos and qvel at the times of the samples, from the same simulation without noise."""
    m, d = scene.model, mujoco.MjData(scene.model)
    d.qpos[:], d.qvel[:] = demonstration.qpos, demonstration.qvel
    result = {}
    for _ in range(step_count(demonstration, m.opt.timestep)):
        result[round(d.time, 6)] = np.concatenate([d.qpos, d.qvel])
        mujoco.mj_step(m, d)
    return result


def test_windows_start_in_the_state_that_was_measured(scene, recording):
    place, speed, spin = [], [], []
    for demonstration in recording.demonstrations:
        states = truth(scene, demonstration)
        known = np.array(list(states))
        for window in cut_windows(scene, demonstration, ("cube",), LENGTH, only_contact=False):
            start = float(window.name.split("@")[1])
            near = states[known[np.abs(known - start).argmin()]]
            place.append(np.abs(window.qpos[:3] - near[:3]).max())
            speed.append(np.abs(window.qvel[:3] - near[7:10]).max())
            spin.append(np.abs(window.qvel[3:] - near[10:]).max())
    assert np.median(place) < 1e-3  # the clocks differ by up to a millisecond
    assert np.median(speed) < 0.01
    assert np.median(spin) < 0.05
    assert np.percentile(speed, 90) < 0.05
    assert np.percentile(spin, 80) < 0.3


def test_windows_lie_within_the_demonstration_and_keep_its_observations(scene, recording):
    demonstration = recording.demonstrations[0]
    full = whole_demonstration(scene, demonstration, ("cube",)).targets[0]
    found = cut_windows(scene, demonstration, ("cube",), LENGTH, only_contact=False)
    starts = np.array([float(w.name.split("@")[1]) for w in found])
    assert len(found) >= 4
    assert np.all(np.abs(np.diff(starts) - LENGTH) <= LENGTH / 2 + 1e-9)
    assert starts[-1] + LENGTH <= demonstration.duration + 1e-6
    for window, start in zip(found, starts, strict=True):
        target = window.targets[0]
        assert target.time[0] > 0
        assert target.time[-1] <= LENGTH + 1e-9
        rows = np.searchsorted(full.time, target.time + start - 1e-4)
        np.testing.assert_allclose(target.points, full.points[rows])
        assert len(window.ctrl) == round(LENGTH / scene.model.opt.timestep)


def test_windows_of_free_flight_are_left_out(scene):
    flight = Demonstration(
        "demo_0",
        qpos=np.array([0, 0, 3.0, 1, 0, 0, 0]),
        measured={
            "position": Channel(t := PERIOD * np.arange(60), np.stack([0.3 * t, 0 * t, 3 - 9.81 / 2 * t**2], axis=1)),
            "orientation": Channel(t, Rotation.from_rotvec(t[:, None] * [2, 1, 0]).as_quat(scalar_first=True)),
        },
    )
    assert cut_windows(scene, flight, ("cube",), LENGTH) == []
    assert len(cut_windows(scene, flight, ("cube",), LENGTH, only_contact=False)) == 4
    model = Model(scene, ContactGeometryCfg(count=30).build(scene))
    with pytest.raises(RecordingError, match="no window shows contact"):
        cut_segments(model, [flight], FitCfg(window=LENGTH))


def test_a_bounce_between_two_flights_counts_as_contact(scene):
    time = PERIOD * np.arange(60) - 0.2
    height = 0.05 + 1.5 * np.abs(time) - 9.81 / 2 * time**2 + np.random.default_rng(0).normal(0, 5e-5, len(time))
    bounce = Demonstration(
        "demo_0",
        qpos=np.array([0, 0, height[0], 1, 0, 0, 0]),
        measured={
            "position": Channel(time + 0.2, np.stack([0 * time, 0 * time, height], axis=1)),
            "orientation": Channel(time + 0.2, np.tile([1.0, 0, 0, 0], (60, 1))),
        },
    )
    found = [float(w.name.split("@")[1]) for w in cut_windows(scene, bounce, ("cube",), LENGTH)]
    assert any(start < 0.2 < start + LENGTH for start in found)
    assert len(found) <= 2  # the other two are free flight


def test_a_body_at_rest_counts_as_in_contact(scene):
    time = PERIOD * np.arange(60)
    rest = Demonstration(
        "demo_0",
        qpos=np.array([0, 0, EDGE / 2, 1, 0, 0, 0]),
        measured={
            "position": Channel(time, np.tile([0, 0, EDGE / 2], (60, 1))),
            "orientation": Channel(time, np.tile([1.0, 0, 0, 0], (60, 1))),
        },
    )
    assert len(cut_windows(scene, rest, ("cube",), LENGTH)) == 4


def _polynomials(scene: Scene, demonstration: Demonstration) -> tuple[LocalPolynomial, LocalPolynomialOrientation]:
    """Return the signals of the only free body."""
    (body,) = StateEstimator.of(Model(scene), demonstration).bodies
    assert isinstance(body.position, LocalPolynomial)
    assert isinstance(body.orientation, LocalPolynomialOrientation)
    return body.position, body.orientation


def test_the_more_precise_of_velocity_sensor_and_positions_is_used(scene, recording):
    demonstration = recording.demonstrations[0]
    position, orientation = _polynomials(scene, demonstration)
    assert position.velocity is not None  # it was recorded without noise
    assert orientation.velocity is not None
    rng = np.random.default_rng(0)
    poor = {
        name: Channel(c.time, c.value + 2.0 * rng.standard_normal(c.value.shape)) if name in ("velocity", "gyro") else c
        for name, c in demonstration.measured.items()
    }
    position, orientation = _polynomials(scene, Demonstration("demo_0", measured=poor))
    assert position.velocity is None
    assert orientation.velocity is None


def test_tracked_points_serve_as_well_as_poses(scene, recording):
    demonstration = recording.demonstrations[0]
    target = whole_demonstration(scene, demonstration, ("cube",)).targets[0]
    visible = np.ones(target.points.shape[:2], dtype=bool)
    visible[::3, :20] = False
    track = PointTrack(target.time, np.where(visible[:, :, None], target.points, np.nan), visible)
    kept = {name: c for name, c in demonstration.measured.items() if name in ("velocity", "gyro")}
    pointed = Demonstration(
        "demo_0", qpos=demonstration.qpos, qvel=demonstration.qvel, measured=kept, points={"cube": track}
    )
    for posed, tracked in zip(
        cut_windows(scene, demonstration, ("cube",), LENGTH),
        cut_windows(scene, pointed, ("cube",), LENGTH),
        strict=True,
    ):
        np.testing.assert_allclose(tracked.qpos[:3], posed.qpos[:3], atol=1.5e-3)


def test_joints_without_sensors_follow_from_tendons_and_equalities():
    scene = Scene("""
    <mujoco>
      <worldbody>
        <body><joint name="left" type="slide" axis="1 0 0"/><geom size="0.01"/></body>
        <body><joint name="right" type="slide" axis="-1 0 0"/><geom size="0.01"/></body>
        <body><joint name="arm" type="hinge"/><geom size="0.01"/></body>
      </worldbody>
      <tendon><fixed name="grip"><joint joint="left" coef="0.5"/><joint joint="right" coef="0.5"/></fixed></tendon>
      <equality><joint joint1="left" joint2="right"/></equality>
      <sensor><tendonpos name="width" tendon="grip"/><jointpos name="angle" joint="arm"/></sensor>
    </mujoco>""")
    time = 0.01 * np.arange(50)
    both = {"width": Channel(time, (0.02 + 0.1 * time)[:, None]), "angle": Channel(time, (time**2)[:, None])}
    states = StateEstimator.of(Model(scene), Demonstration("demo_0", measured=both)).states(np.array([0.2]))
    np.testing.assert_allclose(states.qpos[0], [0.04, 0.04, 0.04], atol=1e-9)
    np.testing.assert_allclose(states.qvel[0], [0.1, 0.1, 0.4], atol=1e-9)
    np.testing.assert_allclose(states.qacc[0], [0, 0, 2], atol=1e-7)
    with pytest.raises(RecordingError, match=r"joints were not measured.*\['arm'\]"):
        StateEstimator.of(Model(scene), Demonstration("demo_0", measured={"width": both["width"]}))


def test_a_local_fit_gives_rate_and_curvature_of_a_parabola_at_either_end():
    time = 0.01 * np.arange(30)
    signal = LocalPolynomialCfg().signal(Channel(time, (3 + 2 * time - 4 * time**2)[:, None]))
    now = np.array([0.0, 0.15, time[-1]])
    estimate = signal.estimate(now)
    np.testing.assert_allclose(estimate.value[:, 0], 3 + 2 * now - 4 * now**2, atol=1e-9)
    np.testing.assert_allclose(estimate.rate[:, 0], 2 - 8 * now, atol=1e-7)
    np.testing.assert_allclose(estimate.second[:, 0], -8, atol=1e-5)


def test_windows_are_held_out_by_demonstration_where_there_are_enough(scene, recording):
    groups = [cut_windows(scene, d, ("cube",), LENGTH) for d in recording.demonstrations[:6]]
    marked = mark_held_out(groups, 0.2)
    held = {s.name.split("@")[0] for s in marked if s.held_out}
    used = {s.name.split("@")[0] for s in marked if not s.held_out}
    assert held == {"demo_4"}
    assert not held & used
    alone = mark_held_out(groups[:1], 0.5)
    assert [s.held_out for s in alone] == [i % 2 == 1 for i in range(len(alone))]


def test_a_length_that_is_no_time_is_refused(scene, recording):
    with pytest.raises(RecordingError, match="must be times"):
        cut_windows(scene, recording.demonstrations[0], ("cube",), 0.0)


@pytest.mark.parametrize("factor", [pytest.param(0.95, marks=pytest.mark.slow), 1.05])
def test_a_fit_to_tosses_recovers_the_edge_of_a_cube_whose_size_is_wrong(recording, factor):
    scene = Scene(toss_scene(factor * EDGE))
    start = Model(scene, ContactGeometryCfg(count=40, radius=0.0015).build(scene))
    evolution = EvolutionCfg(population=12, sigma=2e-4, swelling=5, length=0.03, swelling_length=2 * EDGE)
    cfg = FitCfg(evolution, generations=10, window=LENGTH, batch=16)
    fitted = fit_geometry(start, recording, cfg, engine="mujoco")
    geometry = fitted.model.geometry
    reach = geometry.position + geometry.radius[:, None] * np.sign(geometry.position)
    face = np.abs(start.geometry.position) > factor * EDGE / 2 - 0.0016
    edge = 2 * np.mean(np.abs(reach)[face])
    assert abs(factor - 1) > 3 * abs(edge / EDGE - 1)
    assert fitted.history[-1]["best"] < 0.85 * fitted.history[0]["held_out"]
