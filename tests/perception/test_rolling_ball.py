"""Balls: what turns is seen by texture alone, an orientation that nothing shows is not written, impacts stay sharp."""

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import concent_warp as cw
from concent_warp.perception.pinhole import Pinhole, pixel_grid
from concent_warp.perception.tracking.alignment.rows import _unexplained
from concent_warp.perception.tracking.cfg import AlignCfg, SmoothCfg
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.smooth import PoseMeasurement, smooth
from concent_warp.recording.recording import Demonstration, ImageStream, Recording
from concent_warp.scene.scene import Scene

RADIUS, SHAPE, RATE = 0.03, (140, 200), 60.0
SCENE = f"""<mujoco><worldbody>
  <geom name="table" type="plane" size="1 1 .1"/>
  <body name="ball" pos="0 0 {RADIUS}"><freejoint/><geom type="sphere" size="{RADIUS}" mass=".1"/></body>
</worldbody></mujoco>"""
WAVES = np.random.default_rng(1).normal(0, 450, (24, 3))
"""Wave vectors of the ball's pattern [rad/m]."""


def camera() -> Pinhole:
    """Return a camera 0.45 m from the ball, which looks down on it; the ball takes 40 pixels."""
    forward = np.array([0.0, 0.6, -0.8])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([[1.0, 0, 0], np.cross(forward, [1.0, 0, 0]), forward], axis=1)
    pose[:3, 3] = np.array([0, 0, RADIUS]) - 0.45 * forward
    return Pinhole(np.array([[300.0, 0, 99.5], [0, 300.0, 69.5], [0, 0, 1]]), pose)


def filmed(poses: Sequence[np.ndarray], *, pattern: bool) -> Recording:
    """Return a video of the ball at poses (4, 4)."""
    scene, view, rng = Scene(SCENE), camera(), np.random.default_rng(0)
    renderer, pixels = RayRenderer(scene.model), pixel_grid(*SHAPE).reshape(-1, 2)
    rays = view.rays(pixels) @ view.pose[:3, :3].T
    rgb, depth = np.zeros((len(poses), *SHAPE, 3), np.uint8), np.zeros((len(poses), *SHAPE), np.float32)
    for t, pose in enumerate(poses):
        renderer.place(1, pose)
        hits = renderer.cast(view, pixels)
        known = np.isfinite(hits.depth)
        points = view.position + np.where(known, hits.depth, 0)[:, None] * rays
        own = (points - pose[:3, 3]) @ pose[:3, :3]
        paint = 60 * np.tanh(np.cos(own @ WAVES.T).sum(axis=1) / 2) * pattern
        light = np.where(hits.body == 1, 110 + paint, 60 * known) + rng.normal(0, 2, len(pixels))
        rgb[t] = np.clip(light, 0, 255).reshape(*SHAPE, 1)
        depth[t] = np.where(known, hits.depth + rng.normal(0, 1e-3, len(pixels)), 0).reshape(SHAPE)
    stream = ImageStream(np.arange(len(poses)) / RATE, rgb, depth, view.intrinsics, view.pose)
    return cw.Recording(SCENE, (Demonstration("demo_0", image={"camera": stream}),))


def rolling(count: int, turn: float, height: float = RADIUS) -> list[np.ndarray]:
    """Return poses of a ball that rolls along x by an angle [rad] a frame."""
    poses = []
    for t in range(count):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec([0, turn * t, 0]).as_matrix()
        pose[:3, 3] = RADIUS * turn * (t - count / 2), 0, height
        poses.append(pose)
    return poses


def test_a_rolling_ball_is_seen_to_turn():
    poses = rolling(20, np.radians(9))
    (found,) = cw.track(filmed(poses, pattern=True), pose="none").tracks
    assert not found.lost.any()
    assert found.textured
    turned = found.pose[-1, :3, :3] @ found.pose[0, :3, :3].T
    true = poses[-1][:3, :3] @ poses[0][:3, :3].T
    assert np.degrees(Rotation.from_matrix(true.T @ turned).magnitude()) < 12  # of 171


def test_the_orientation_of_a_plain_ball_is_not_written():
    result = cw.track(filmed(rolling(4, np.radians(9)), pattern=False), pose="none")
    measured = result.recording[0].measured
    assert len(measured) == 1
    (position,) = measured.values()
    np.testing.assert_allclose(position.value, [pose[:3, 3] for pose in rolling(4, np.radians(9))], atol=1e-3)


def test_the_contour_of_a_ball_is_seen_and_says_where_it_is():
    poses = rolling(5, np.radians(9))
    (found,) = cw.track(filmed(poses, pattern=False), pose="none").tracks
    assert found.quality is not None
    assert np.isfinite(found.quality.edge_residual).all()
    across = (found.pose[:, :3, 3] - [pose[:3, 3] for pose in poses]) @ camera().pose[:3, :2]
    assert np.abs(across).max() < 3e-4  # a fifth of a pixel


def test_what_a_pose_that_is_off_shifts_all_edges_by_is_no_scatter_of_theirs():
    rng = np.random.default_rng(0)
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    jacobian = np.zeros((60, 6))
    jacobian[:, 0], jacobian[:, 1] = 600 * np.cos(angle), 600 * np.sin(angle)  # [px/m]
    noise = rng.normal(0, 0.1, 60)
    left = _unexplained(jacobian, jacobian @ np.array([2e-3, -1e-3, 0, 0, 0, 0]) + noise, AlignCfg())
    assert np.std(left) < 1.2 * np.std(noise)


@pytest.mark.parametrize(("depth", "followed"), [(0.015, True), (0.04, False)])
def test_a_ball_may_sink_in_but_not_through(depth, followed):
    poses = [rolling(1, 0.0, RADIUS - sunk)[0] for sunk in (0.0, 0.0, depth / 3, 2 * depth / 3, depth)]
    (found,) = cw.track(filmed(poses, pattern=False), pose="none").tracks
    assert not found.lost[:2].any()
    assert found.quality is not None
    assert (found.quality.state[-1] == "tracked") == followed


def test_a_bounce_is_not_smoothed_away():
    rng, time = np.random.default_rng(0), np.arange(60) / RATE
    height = np.abs(0.3 - 2.0 * time - 4.9 * time**2 * (time < 0.11)) + 0.05
    information = np.diag([1 / 0.001**2] * 3 + [1 / 0.01**2] * 3)
    measured = height + rng.normal(0, 0.001, len(time))
    shown = []
    for z in measured:
        pose = np.eye(4)
        pose[2, 3] = z
        shown.append(PoseMeasurement(pose, information, np.zeros(6)))
    smoothed = [smooth(time, shown, RADIUS, SmoothCfg(impact=impact))[0][:, 2, 3] for impact in (500.0, 20.0)]
    near = np.abs(height - height.min()) < 0.08
    error = [np.abs(one - height)[near].max() for one in smoothed]
    assert error[0] < 0.005
    assert error[1] > 2 * error[0]
