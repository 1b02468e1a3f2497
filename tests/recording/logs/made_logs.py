"""Logs of one made-up robot in the formats of others, written by their own packages, with what is in them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from concent_warp.render.dataset.layout import EpisodeLayout
from concent_warp.render.dataset.lerobot import LeRobotWriter

SCENE = """
<mujoco>
  <worldbody>
    <geom name="table" type="plane" size="2 2 0.1"/>
    <body name="arm" pos="0 0 0.5">
      <joint name="elbow" type="hinge" axis="0 1 0" range="-170 170"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0"/>
      <body name="finger" pos="0.3 0 0"><joint name="grip" type="slide" range="0 0.04"/><geom size="0.01"/></body>
    </body>
    <body name="block" pos="0.4 0.3 0.05"><freejoint name="block"/><geom type="box" size="0.05 0.05 0.05"/></body>
  </worldbody>
  <actuator>
    <position name="elbow" joint="elbow" kp="20"/>
    <position name="grip" joint="grip" kp="20"/>
  </actuator>
  <sensor>
    <jointpos name="elbow_position" joint="elbow"/>
    <jointvel name="elbow_velocity" joint="elbow"/>
    <jointpos name="grip_position" joint="grip"/>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""
SIZE = (32, 48)
INTRINSICS = np.array([[40.0, 0, 23.5], [0, 40.0, 15.5], [0, 0, 1]])
EPOCH = 1_764_000_000.0
"""Seconds since 1970 at which the logs begin [s]."""


def camera_pose() -> np.ndarray:
    """Return the pose of a camera that looks at the block from an oblique angle, shape (4, 4)."""
    place, target = np.array([0.9, 0.9, 0.7]), np.array([0.4, 0.3, 0.0])
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = place
    return pose


def depth_of_scene(pose: np.ndarray, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Return the depths of the scene in its reference state [m], shape (H, W)."""
    m = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(m)
    mujoco.mj_forward(m, data)
    geom = np.zeros((1, 1), np.int32)
    inverse = np.linalg.inv(INTRINSICS)
    found = np.zeros(size)
    for v in range(size[0]):
        for u in range(size[1]):
            ray = pose[:3, :3] @ inverse @ [u, v, 1.0]
            found[v, u] = max(mujoco.mj_ray(m, data, pose[:3, 3], ray, None, 1, -1, geom), 0)
    return found


@dataclass(frozen=True)
class Motion:
    """What the robot does: all SI, 3 s."""

    time: np.ndarray
    elbow: np.ndarray
    grip: np.ndarray
    block: np.ndarray
    """Positions of the block [m], shape (T, 3)."""
    frames: np.ndarray
    """Times of the frames [s]."""
    rgb: np.ndarray
    depth: np.ndarray
    """[mm], shape (F, H, W) uint16."""

    @property
    def speed(self) -> np.ndarray:
        """Speed of the elbow [rad/s]."""
        return np.gradient(self.elbow, self.time)


def motion() -> Motion:
    """Return the motion of the robot."""
    rng = np.random.default_rng(3)
    time = np.arange(0, 3, 0.02)
    frames = np.arange(0, 3, 0.25)
    depth = np.rint(1000 * depth_of_scene(camera_pose())).astype(np.uint16)
    depth[:2, :3] = 0
    block = np.array([0.4, 0.3, 0.05]) + 1e-3 * rng.normal(size=(len(time), 3))
    return Motion(
        time,
        0.8 * np.sin(2 * time),
        0.02 + 0.015 * np.cos(3 * time),
        block,
        frames,
        np.repeat(cv2.resize(rng.integers(0, 255, (4, 6, 3), np.uint8), SIZE[::-1])[None], len(frames), axis=0),
        np.repeat(depth[None], len(frames), axis=0),
    )


def write_calibration(path: Path, name: str, **more: Any) -> None:
    """Write a calibration of one camera, with entries of one's own."""
    camera = {"intrinsics": INTRINSICS.tolist(), "pose": camera_pose().tolist(), "height": SIZE[0], "width": SIZE[1]}
    path.write_text(json.dumps({"cameras": {name: camera | more}}))


def write_lerobot(folder: Path, episodes: int = 3, *, rate: int = 50) -> list[Motion]:
    """Write a data set with our own writer, joints in degrees and a percentage, and return the motions."""
    layout = EpisodeLayout(rate, ("front",), SIZE, ("elbow.pos", "grip.pos"), ("elbow.pos", "grip.pos"))
    writer = LeRobotWriter(folder, layout)
    found = []
    for number in range(episodes):
        made = motion()
        count = 100 + 10 * number
        made = Motion(
            made.time[:count], made.elbow[:count] + 0.1 * number, made.grip[:count], made.block, made.frames, made.rgb,
            made.depth,
        )  # fmt: skip
        episode = writer.begin(number, f"task {number % 2}")
        for t in range(count):
            state = np.array([np.rad2deg(made.elbow[t]), 100 * made.grip[t] / 0.04])
            episode.add(
                {"front": np.full((*SIZE, 3), 20 + 40 * number + t // 2, np.uint8)}, state, state + np.array([1, 0])
            )
        episode.save()
        found.append(made)
    assert writer.finish() == episodes
    return found


Message = tuple[str, str, float, dict[str, Any]]
"""Topic, type, time of reception since the start [s] and fields; `header` is a stamp [s] and a frame."""


def messages(made: Motion, *, late: float = 0.004) -> list[Message]:
    """Return the messages of a robot with a camera; the logger receives each `late` [s] after its stamp."""
    found: list[Message] = []
    for t, time in enumerate(made.time):
        stamp = {"header": (time, "")}
        joints = {
            "name": ["grip", "elbow"], "position": np.array([made.grip[t], made.elbow[t]]),
            "velocity": np.array([0.0, made.speed[t]]), "effort": np.zeros(0),
        }  # fmt: skip
        found.append(("/joint_states", "sensor_msgs/msg/JointState", time + late, stamp | joints))
        if t % 2 == 0:
            command = np.array([made.elbow[t], made.grip[t]])
            found.append(("/arm/commands", "std_msgs/msg/Float64MultiArray", time + late, {"data": command}))
        pose = {"position": made.block[t], "orientation": [1.0, 0, 0, 0]}
        found.append(("/block/pose", "geometry_msgs/msg/PoseStamped", time + late, stamp | {"pose": pose}))
    static = [("world", "camera_link", np.eye(4)), ("camera_link", "camera_optical", camera_pose())]
    found.append(("/tf_static", "tf2_msgs/msg/TFMessage", 0.0, {"transforms": static}))
    info = {"header": (0.0, "camera_optical"), "height": SIZE[0], "width": SIZE[1], "k": INTRINSICS.ravel()}
    found.append(("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo", 0.01, info))
    for f, time in enumerate(made.frames):
        header = {"header": (time, "camera_optical")}
        color = {"encoding": "bgr8", "image": made.rgb[f][..., ::-1]}
        found.append(("/camera/color/image_raw", "sensor_msgs/msg/Image", time + late, header | color))
        depth = {"header": (time + 0.001, "camera_optical"), "encoding": "16UC1", "image": made.depth[f]}
        found.append(("/camera/aligned_depth/image_raw", "sensor_msgs/msg/Image", time + late, depth))
    return sorted(found, key=lambda one: one[2])


ROS_MAP = """
[action.elbow]
source = "/arm/commands/data/0"
[action.grip]
source = "/arm/commands/data/1"
[measured."*_position"]
source = "/joint_states/position/*"
[measured.elbow_velocity]
source = "/joint_states/velocity/elbow"
[body.block]
source = "/block/pose"
[image.front]
color = "/camera/color/image_raw"
depth = "/camera/aligned_depth/image_raw"
reference = "world"
"""


def _fields(types: Any, kind: str, fields: Mapping[str, Any]) -> Any:
    """Return a message of rosbags' types."""

    def make(of: str, **values: Any) -> Any:
        return types[of](**values)

    def header(stamp: tuple[float, str]) -> Any:
        nanoseconds = round((EPOCH + stamp[0]) * 1e9)
        time = make("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        names = types["std_msgs/msg/Header"].__dataclass_fields__
        return make("std_msgs/msg/Header", stamp=time, frame_id=stamp[1], **({"seq": 0} if "seq" in names else {}))

    def pose(place: Any, turn: Any, name: str = "Pose") -> Any:
        w, x, y, z = map(float, turn)
        rotation = make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
        px, py, pz = map(float, place)
        if name == "Pose":
            point = make("geometry_msgs/msg/Point", x=px, y=py, z=pz)
            return make("geometry_msgs/msg/Pose", position=point, orientation=rotation)
        vector = make("geometry_msgs/msg/Vector3", x=px, y=py, z=pz)
        return make("geometry_msgs/msg/Transform", translation=vector, rotation=rotation)

    def transform(parent: str, child: str, matrix: np.ndarray) -> Any:
        turn = np.zeros(4)
        mujoco.mju_mat2Quat(turn, np.ascontiguousarray(matrix[:3, :3]).ravel())
        moved = pose(matrix[:3, 3], turn, "Transform")
        return make(
            "geometry_msgs/msg/TransformStamped", header=header((0, parent)), child_frame_id=child, transform=moved
        )

    values: dict[str, Any] = dict(fields)
    if "header" in values:
        values["header"] = header(values["header"])
    if kind.endswith("PoseStamped"):
        values["pose"] = pose(fields["pose"]["position"], fields["pose"]["orientation"])
    elif kind.endswith("TFMessage"):
        values["transforms"] = [transform(*one) for one in fields["transforms"]]
    elif kind.endswith("MultiArray"):
        values["layout"] = make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    elif kind.endswith("CameraInfo"):
        region = make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        values |= {"distortion_model": fields.get("distortion_model", "plumb_bob")}
        values |= {"d": np.asarray(fields.get("d", np.zeros(5)), float), "r": np.eye(3).ravel()}
        values |= {"p": np.zeros(12), "binning_x": 0, "binning_y": 0, "roi": region}
        if "K" in types[kind].__dataclass_fields__:
            values = {name.upper() if name in "dkrp" else name: value for name, value in values.items()}
    elif kind.endswith("/Image"):
        image = np.ascontiguousarray(values.pop("image"))
        step = image.nbytes // image.shape[0]
        values |= {"height": image.shape[0], "width": image.shape[1], "step": step, "is_bigendian": 0}
        values["data"] = np.frombuffer(image.tobytes(), np.uint8)
    return make(kind, **values)


def write_bag(path: Path, sent: Sequence[Message], kind: str) -> Path:
    """Write messages as ``mcap`` or ``sqlite`` of ROS 2, each in a folder, or ``ros1``; return what to import."""
    if kind == "ros1":
        store = get_typestore(Stores.ROS1_NOETIC)
        transforms = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(transforms, "tf2_msgs/msg/TFMessage"))
        path = path.with_suffix(".bag")
        writer: Any = Writer1(path)
        serialise = store.serialize_ros1
    else:
        store = get_typestore(Stores.ROS2_HUMBLE)
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer(path, version=9, storage_plugin=plugin)
        serialise = store.serialize_cdr
    with writer:
        connections: dict[str, Any] = {}
        for topic, msgtype, time, fields in sent:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=store)
            raw = serialise(_fields(store.types, msgtype, fields), msgtype)
            writer.write(connections[topic], round((EPOCH + time) * 1e9), raw)
    return path


def write_images(folder: Path, made: Motion, **intrinsics: Any) -> None:
    """Write a folder of images whose names are times in microseconds, with joints and commands as tables."""
    for name, frames in (("color", made.rgb), ("depth", made.depth)):
        (folder / name).mkdir(parents=True)
        for time, frame in zip(made.frames, frames, strict=True):
            image = frame[..., ::-1] if name == "color" else frame
            assert cv2.imwrite(str(folder / name / f"{name}_{round((EPOCH + time) * 1e6)}.png"), image)
    known = {"fx": 40.0, "fy": 40.0, "ppx": 23.5, "ppy": 15.5, "width": SIZE[1], "height": SIZE[0]}
    (folder / "intrinsics.json").write_text(json.dumps(known | intrinsics))
    for name, angle in (("joints", made.elbow), ("command", made.elbow + 0.01)):
        rows = [
            f"{EPOCH + t:.6f},{a!r},{g!r}"
            for t, a, g in zip(made.time, angle.tolist(), made.grip.tolist(), strict=True)
        ]
        (folder / f"{name}.csv").write_text("\n".join(["time,elbow,grip", *rows]) + "\n")
