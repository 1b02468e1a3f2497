"""Poses of a body that were measured by a marker, a geom or its centre of mass, which are not the body's own frame."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import concent_warp as cw
from concent_warp.effects.select import shown_free_joint
from concent_warp.estimation.body_signals import spline_bodies
from concent_warp.estimation.object_tracks import frame_channel
from concent_warp.estimation.partial_state import partial_state
from concent_warp.estimation.smoothing_spline import SmoothingSplineCfg
from concent_warp.estimation.state_estimator import StateEstimator
from concent_warp.fit.effects.observation import start_spread
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.report.motion_data import _measured_poses
from concent_warp.scene.scene import Scene
from concent_warp.scene.sensor_frame import sensor_frame
from concent_warp.simulate.replay import initial_state

POSITION, ORIENTATION = mujoco.mjtSensor.mjSENS_FRAMEPOS, mujoco.mjtSensor.mjSENS_FRAMEQUAT
FRAMES = {
    "xbody": "box",
    "body": "box",
    "geom": "edge",
    "site": "marker",
    "camera": "eye",
}
KINDS = (*FRAMES, "lens")
"""Frames on the box, and a marker on it in the frame of a camera that stands."""
SENSORS = "".join(
    f'<framepos name="{kind}_p" objtype="{kind}" objname="{name}"/>'
    f'<framequat name="{kind}_q" objtype="{kind}" objname="{name}"/>'
    for kind, name in FRAMES.items()
)
SCENE = f"""
<mujoco>
  <option timestep="0.001"/>
  <worldbody>
    <body name="stand" pos="0.4 -1 0.2" euler="0 0 50">
      <geom size="0.01"/>
      <camera name="lens" pos="0.1 0 0.3" euler="70 20 0"/>
    </body>
    <body name="box" pos="0 0 1">
      <freejoint/>
      <inertial mass="0.2" pos="0.01 0.02 -0.01" quat="0.9 0.1 0.3 -0.2" diaginertia="1e-4 2e-4 3e-4"/>
      <geom name="edge" type="box" size="0.02 0.03 0.04" pos="0 0.03 0.01" euler="20 30 0"/>
      <site name="marker" pos="0.05 -0.02 0.04" euler="0 0 70"/>
      <camera name="eye" pos="0 0.1 0" euler="10 0 40"/>
    </body>
  </worldbody>
  <sensor>{SENSORS}
    <framepos name="lens_p" objtype="site" objname="marker" reftype="camera" refname="lens"/>
    <framequat name="lens_q" objtype="site" objname="marker" reftype="camera" refname="lens"/>
    <framepos name="seen" objtype="site" objname="marker" reftype="camera" refname="eye"/>
  </sensor>
</mujoco>"""


@pytest.fixture(scope="module")
def tumbling() -> tuple[Scene, dict[str, Channel], np.ndarray, np.ndarray]:
    """Return a scene, what its sensors read of a thrown box, and the true states qpos (T, 7) and qvel (T, 6)."""
    scene = Scene(SCENE)
    m = scene.model
    d = mujoco.MjData(m)
    d.qpos[3:] = np.array([0.8, 0.3, -0.4, 0.2]) / np.linalg.norm([0.8, 0.3, -0.4, 0.2])
    d.qvel[:] = [1.0, 0.3, 2.0, 4.0, -3.0, 5.0]
    rows, states = [], []
    for _ in range(301):
        mujoco.mj_forward(m, d)
        rows.append(d.sensordata.copy())
        states.append(np.concatenate([d.qpos, d.qvel]))
        mujoco.mj_step(m, d)
    values, every = np.array(rows)[::5], np.array(states)[::5]
    time = 0.005 * np.arange(len(values))
    channels = {}
    for i in range(m.nsensor):
        part = slice(m.sensor_adr[i], m.sensor_adr[i] + m.sensor_dim[i])
        channels[m.sensor(i).name] = Channel(time, values[:, part], 1e-3)
    return scene, channels, every[:, :7], every[:, 7:]


def demonstration(channels: dict[str, Channel], *names: str) -> Demonstration:
    return Demonstration("throw", measured={name: channels[name] for name in names})


def same_turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return how far quaternions are from turning alike, shape (T,)."""
    return 1 - np.abs((a * b).sum(axis=-1))


@pytest.mark.parametrize("kind", KINDS)
def test_poses_of_any_frame_on_a_body_are_those_of_the_body(tumbling, kind):
    scene, channels, qpos, _ = tumbling
    seen = demonstration(channels, f"{kind}_p", f"{kind}_q")
    place = frame_channel(scene.model, seen, "box", POSITION)
    turned = frame_channel(scene.model, seen, "box", ORIENTATION)
    assert place is not None
    assert turned is not None
    np.testing.assert_allclose(place.value, qpos[:, :3], atol=1e-9)
    assert same_turn(turned.value, qpos[:, 3:]).max() < 1e-12
    assert place.noise_std == 1e-3
    if kind != "xbody":  # the measured frames do differ
        assert np.abs(channels[f"{kind}_p"].value - qpos[:, :3]).max() > 0.01


@pytest.mark.parametrize("kind", KINDS)
def test_states_are_estimated_from_any_frame(tumbling, kind):
    scene, channels, qpos, qvel = tumbling
    seen = demonstration(channels, f"{kind}_p", f"{kind}_q")
    first, _ = initial_state(scene.model, seen)
    np.testing.assert_allclose(first[:3], qpos[0, :3], atol=1e-9)
    assert same_turn(first[3:], qpos[0, 3:]) < 1e-12
    found = StateEstimator.of(cw.Model(scene), seen).states(np.array([0.1, 0.15]))
    np.testing.assert_allclose(found.qpos[:, :3], qpos[[20, 30], :3], atol=1e-5)
    np.testing.assert_allclose(found.qvel, qvel[[20, 30]], atol=0.02)


def test_a_marker_without_orientation_tells_of_the_origin_only_where_it_is_there(tumbling):
    scene, channels, _, _ = tumbling
    assert frame_channel(scene.model, demonstration(channels, "site_p"), "box", POSITION) is None
    assert not partial_state(scene.model, demonstration(channels, "site_p"), 0.1).measured.any()
    ball = Scene(SCENE.replace('pos="0.05 -0.02 0.04"', 'pos="0 0 0"'))
    there = frame_channel(ball.model, demonstration(channels, "site_p"), "box", POSITION)
    assert there is not None
    np.testing.assert_allclose(there.value, channels["site_p"].value)


def test_smoothing_splines_take_any_frame_as_well(tumbling):
    scene, channels, qpos, _ = tumbling
    for kind in KINDS:
        seen = demonstration(channels, f"{kind}_p", f"{kind}_q")
        (body,) = spline_bodies(scene.model, seen, SmoothingSplineCfg())
        found = body.position.estimate(np.array([0.1, 0.15])).value
        np.testing.assert_allclose(found, qpos[[20, 30], :3], atol=1e-4, err_msg=kind)


@pytest.mark.parametrize("kind", KINDS)
def test_a_page_shows_the_body_where_it_was_measured(tumbling, kind):
    scene, channels, qpos, _ = tumbling
    seen = demonstration(channels, f"{kind}_p", f"{kind}_q")
    (body, pose), *rest = _measured_poses(scene.model, seen, np.array([0.1, 0.15])).items()
    assert (body, rest) == ("box", [])
    np.testing.assert_allclose(pose[:, :3], qpos[[20, 30], :3], atol=1e-9)
    assert same_turn(pose[:, 3:], qpos[[20, 30], 3:]).max() < 1e-12


def test_a_channel_of_no_sensor_is_of_no_body(tumbling):
    scene, channels, _, _ = tumbling
    seen = Demonstration("throw", measured={"nowhere": channels["xbody_p"]})
    assert frame_channel(scene.model, seen, "box", POSITION) is None


def test_the_orientation_may_be_of_another_frame_than_the_position(tumbling):
    scene, channels, qpos, _ = tumbling
    place = frame_channel(scene.model, demonstration(channels, "site_p", "geom_q"), "box", POSITION)
    assert place is not None
    np.testing.assert_allclose(place.value, qpos[:, :3], atol=1e-9)


def test_lost_orientations_leave_no_gap_in_positions(tumbling):
    scene, channels, qpos, _ = tumbling
    lost = channels["site_q"].value.copy()
    lost[10:12] = np.nan
    channels = channels | {"site_q": Channel(channels["site_q"].time, lost)}
    seen = demonstration(channels, "site_p", "site_q")
    place, turned = (frame_channel(scene.model, seen, "box", kind) for kind in (POSITION, ORIENTATION))
    assert place is not None
    assert turned is not None
    np.testing.assert_allclose(place.value, qpos[:, :3], atol=1e-4)
    assert np.isnan(turned.value[10:12]).all()
    assert np.isfinite(np.delete(turned.value, [10, 11], axis=0)).all()


def test_the_bodys_own_frame_comes_first(tumbling):
    scene, channels, _, _ = tumbling
    seen = demonstration(channels, "site_p", "site_q", "xbody_p", "xbody_q")
    assert frame_channel(scene.model, seen, "box", POSITION) is channels["xbody_p"]
    assert frame_channel(scene.model, seen, "box", ORIENTATION) is channels["xbody_q"]


@pytest.mark.parametrize("kind", KINDS)
def test_what_a_sensor_of_any_frame_shows_is_known_to_its_noise(tumbling, kind):
    m = tumbling[0].model
    spread, none = start_spread(m, {f"{kind}_p": 1e-3, f"{kind}_q": 1e-3}), start_spread(m, {})
    assert (spread != none).all()
    np.testing.assert_allclose(spread, start_spread(m, {"xbody_p": 1e-3, "xbody_q": 1e-3}))
    assert shown_free_joint(m, m.sensor(f"{kind}_p").id) == 0


def test_the_start_of_a_body_whose_marker_alone_was_seen_is_far_from_certain(tumbling):
    m, cfg, unseen = tumbling[0].model, ObservationCfg(), np.zeros(6, dtype=bool)
    found = start_spread(m, {"site_p": 1e-3}, measured=unseen)
    position, orientation = [cfg.unknown_position] * 3, [cfg.unknown_orientation] * 3
    velocity, spin = [cfg.unknown_velocity] * 3, [cfg.unknown_spin] * 3
    np.testing.assert_allclose(found, [*position, *orientation, *velocity, *spin])
    # Of a body that nothing shows at all, nothing is fitted that would explain anything.
    assert (start_spread(m, {}, measured=unseen) < found).all()


def test_a_frame_relative_to_one_that_moves_is_none_of_the_world(tumbling):
    m = tumbling[0].model
    assert sensor_frame(m, m.sensor("seen").id) is None
    assert shown_free_joint(m, m.sensor("seen").id) is None
