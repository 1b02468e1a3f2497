"""A two-joint arm over a table with a ball, seen by a fixed camera and by one on the arm, and a real world that looks
otherwise: the same shapes in other colours, under another light."""

import mujoco
import numpy as np
import torch

from concent_warp.recording.recording import Channel, Demonstration, ImageStream, Recording
from concent_warp.render.cameras import Camera
from concent_warp.render.raw import PosedWorlds, RawCamera
from concent_warp.render.splats.splats import Splats
from concent_warp.scene.scene import Scene

SIZE = 64
RATE = 10.0
XML = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <light pos="0.3 0 1.5" diffuse="0.6 0.6 0.6"/>
    <geom name="table" type="plane" size="1 1 0.1" rgba="0.8 0.8 0.8 1"/>
    <camera name="base" pos="0.9 -0.3 0.7" xyaxes="0.3 0.95 0 -0.55 0.17 0.82" fovy="45"/>
    <body name="ball" pos="0.4 0.05 0.05"><freejoint/><geom name="ball" size="0.05" rgba="0.9 0.1 0.1 1"/></body>
    <body name="turn" pos="0 0 0.25" gravcomp="1">
      <joint name="turn" axis="0 0 1" damping="3"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.04" rgba="0.5 0.5 0.5 1"/>
      <body name="fore" pos="0.3 0 0" gravcomp="1">
        <joint name="bend" axis="0 0 1" damping="3"/>
        <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.03" rgba="0.3 0.3 0.4 1"/>
        <camera name="wrist" pos="0.1 0 0.15" xyaxes="0 -1 0 0.7 0 0.7" fovy="70"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="turn" joint="turn" kp="60" kv="4"/>
    <position name="bend" joint="bend" kp="60" kv="4"/>
  </actuator>
  <sensor>
    <jointpos name="turn_position" joint="turn"/>
    <jointpos name="bend_position" joint="bend"/>
    <framepos name="ball_position" objtype="xbody" objname="ball"/>
  </sensor>
</mujoco>
"""
PAINT = {"table": (0.55, 0.35, 0.15), "ball": (0.1, 0.9, 0.1)}
ARM = (0.9, 0.75, 0.1)


def real_model() -> mujoco.MjModel:
    """Return the real world: its colours are nobody's drawing."""
    spec = Scene(XML).spec()
    for geom in spec.geoms:
        geom.rgba[:3] = PAINT.get(geom.name, ARM)
    return spec.compile()


def motion(seed: int, count: int) -> np.ndarray:
    """Return joint angles [rad], shape (count, 2), of a smooth motion."""
    rng = np.random.default_rng(seed)
    time = np.arange(count) / RATE
    waves = [
        a * np.sin(w * time + p)
        for a, w, p in zip(rng.uniform(0.4, 0.8, 2), rng.uniform(1, 2, 2), rng.uniform(0, 6, 2), strict=True)
    ]
    return np.stack(waves, axis=1)


def states(seed: int, count: int) -> np.ndarray:
    """Return states, shape (count, nq)."""
    qpos = np.tile(Scene(XML).model.qpos0, (count, 1))
    qpos[:, 7:9] = motion(seed, count)
    return qpos


def filmed(qpos: np.ndarray, cameras=("base", "wrist"), objects: bool = False) -> dict[str, np.ndarray]:
    """Return what the real cameras see, uint8, shape (T, SIZE, SIZE, 3) each."""
    model = real_model()
    stage = PosedWorlds(model, len(qpos))
    eye = RawCamera(stage, cameras, (SIZE, SIZE), leave_out=() if objects else ("ball",), shadows=True)
    stage.place(qpos)
    images = (255 * eye.render().rgb).round().to(torch.uint8).numpy()
    return {name: images[:, c].copy() for c, name in enumerate(cameras)}


def demonstration(seed: int, count: int, *, objects: bool = False) -> Demonstration:
    """Return a recording of a motion with the images of both cameras."""
    qpos = states(seed, count)
    time = np.arange(count) / RATE
    scene = Scene(XML)
    frames = filmed(qpos, objects=objects)
    image = {}
    for name, rgb in frames.items():
        camera = Camera.in_scene(scene, name)
        rotation, pose = np.zeros(9), np.eye(4)
        mujoco.mju_quat2Mat(rotation, np.array(camera.quaternion))
        pose[:3, :3] = rotation.reshape(3, 3) @ np.diag([1.0, -1.0, -1.0])
        pose[:3, 3] = camera.position
        focal = SIZE / 2 / np.tan(np.radians(camera.fovy) / 2)
        matrix = np.array([[focal, 0, (SIZE - 1) / 2], [0, focal, (SIZE - 1) / 2], [0, 0, 1.0]])
        image[name] = ImageStream(time, rgb, np.zeros(rgb.shape[:3], np.float32), matrix, pose, camera.body)
    angles = {"turn": qpos[:, 7], "bend": qpos[:, 8]}
    fine = np.arange(0, time[-1], 0.01)
    action = {name: Channel(fine, np.interp(fine, time, value)) for name, value in angles.items()}
    measured = {f"{name}_position": Channel(time, value[:, None], noise_std=1e-4) for name, value in angles.items()}
    measured["ball_position"] = Channel(time, np.tile(qpos[0, :3], (count, 1)), noise_std=1e-4)
    return Demonstration(f"demo_{seed}", "wave over the ball", True, qpos[0], np.zeros(8), action, measured, {}, image)


def recording(seeds, count: int, *, objects: bool = False) -> Recording:
    """Return several motions."""
    return Recording(XML, tuple(demonstration(seed, count, objects=objects) for seed in seeds), source="small arm")


def ball() -> Splats:
    """Return green splats over the ball of the scene."""
    rng = np.random.default_rng(0)
    side = rng.normal(size=(600, 3))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    colour = np.tile((np.array([0.1, 0.9, 0.1]) - 0.5) / 0.28209479, (600, 1, 1))
    values = (0.046 * side, np.tile([1.0, 0, 0, 0], (600, 1)), np.full((600, 3), 0.004), np.full(600, 0.98), colour)
    return Splats(*(torch.tensor(value, dtype=torch.float32) for value in values))
