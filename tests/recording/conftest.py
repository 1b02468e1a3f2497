import numpy as np
import pytest

from concent_warp.recording.recording import Channel, Demonstration, ImageStream, PointTrack, Recording

SCENE = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body name="arm" pos="0 0 0.5">
      <joint name="elbow" type="hinge" axis="0 1 0" range="-170 170"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0"/>
      <body name="finger" pos="0.3 0 0"><joint name="grip" type="slide" range="0 0.04"/><geom size="0.01"/></body>
    </body>
    <body name="block" pos="0.4 0 0.02"><freejoint name="block"/><geom type="box" size="0.02 0.02 0.02"/></body>
  </worldbody>
  <tendon><fixed name="opening"><joint joint="grip" coef="2"/></fixed></tendon>
  <actuator>
    <position name="opening" tendon="opening" kp="20"/>
    <position name="elbow" joint="elbow" kp="20"/>
    <position name="left/grip" joint="grip" kp="20"/>
    <motor name="push" joint="grip"/>
  </actuator>
  <sensor>
    <jointpos name="elbow_angle" joint="elbow"/>
    <jointpos name="grip_width" joint="grip"/>
    <tendonpos name="opening" tendon="opening"/>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
    <framelinvel name="block_velocity" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""
TIME = np.arange(50) * 0.01


def sound_recording() -> Recording:
    rng = np.random.default_rng(0)
    angle = 0.5 * np.sin(3 * TIME)
    position = [0.4, 0.0, 0.02] + 1e-3 * rng.normal(size=(len(TIME), 3))
    position[7] = np.nan
    quaternion = np.tile([1.0, 0, 0, 0], (len(TIME), 1))
    points = position[:, None] + 0.02 * rng.normal(size=(1, 5, 3))
    camera = ImageStream(
        time=TIME[:3],
        rgb=rng.integers(0, 255, (3, 6, 8, 3), dtype=np.uint8),
        depth=rng.uniform(0, 2, (3, 6, 8)).astype(np.float32),
        intrinsics=np.array([[8.0, 0, 4], [0, 8, 3], [0, 0, 1]]),
        pose=np.eye(4),
    )
    first = Demonstration(
        name="demo_0",
        task="push the block",
        success=True,
        qpos=np.array([0.1, 0.02, 0.4, 0, 0.02, 1, 0, 0, 0]),
        qvel=np.zeros(8),
        action={
            "elbow": Channel(TIME, angle),
            "left/grip": Channel(TIME[:1], np.array([0.03])),
            "opening": Channel(TIME, 0 * TIME + 0.06),
        },
        measured={
            "elbow_angle": Channel(TIME + 0.002, angle[:, None], noise_std=1e-3),
            "grip_width": Channel(TIME, np.full((len(TIME), 1), 0.03)),
            "opening": Channel(TIME, np.full((len(TIME), 1), 0.06)),
            "block_position": Channel(TIME, position, frame="table"),
            "block_orientation": Channel(TIME, quaternion),
            "block_velocity": Channel(TIME, np.zeros((len(TIME), 3))),
        },
        points={"block": PointTrack(TIME, points, ~np.isnan(points[..., 0]))},
        image={"wrist": camera},
    )
    second = Demonstration(name="demo_10", measured={"elbow_angle": Channel(TIME, angle[:, None])})
    third = Demonstration(name="demo_2", success=False, measured={"elbow_angle": Channel(TIME, angle[:, None])})
    return Recording(SCENE, (first, third, second))


@pytest.fixture
def recording() -> Recording:
    return sound_recording()
