"""Sound inputs of every kind, small ones, that the cases break."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np

from concent_warp.model import Model
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.recording import Channel, Demonstration, ImageStream, PointTrack, Recording
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

SCENE = """
<mujoco>
  <worldbody>
    <geom name="table" type="plane" size="1 1 0.1"/>
    <body name="arm" pos="0 0 0.5">
      <joint name="elbow" type="hinge" axis="0 1 0" range="-170 170"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0"/>
    </body>
    <body name="block" pos="0.4 0 0.02"><freejoint/><geom name="block" type="box" size="0.02 0.02 0.02"/></body>
  </worldbody>
  <actuator><position name="elbow" joint="elbow" kp="20" ctrlrange="-2.9 2.9"/></actuator>
  <sensor>
    <jointpos name="elbow_angle" joint="elbow"/>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""
TIME = np.arange(60) * 0.01
ANGLE = 0.5 * np.sin(3 * TIME)


def sound_recording() -> Recording:
    """Return a sound recording with every kind of channel."""
    position = np.tile([0.4, 0.0, 0.02], (len(TIME), 1))
    camera = ImageStream(
        TIME[:3],
        np.full((3, 6, 8, 3), 90, np.uint8),
        np.ones((3, 6, 8), np.float32),
        np.array([[8.0, 0, 4], [0, 8, 3], [0, 0, 1]]),
        np.eye(4),
    )
    demonstration = Demonstration(
        name="demo_0",
        task="push",
        qpos=np.array([0, 0.4, 0, 0.02, 1, 0, 0, 0]),
        qvel=np.zeros(7),
        action={"elbow": Channel(TIME, ANGLE)},
        measured={
            "elbow_angle": Channel(TIME, ANGLE[:, None].copy()),
            "block_position": Channel(TIME, position),
            "block_orientation": Channel(TIME, np.tile([1.0, 0, 0, 0], (len(TIME), 1))),
        },
        points={"block": PointTrack(TIME, np.tile(position[:, None], (1, 4, 1)), np.ones((len(TIME), 4), bool))},
        image={"wrist": camera},
    )
    return Recording(SCENE, (demonstration,))


def write_recording_and_model(folder: Path) -> tuple[Path, Path]:
    """Write a sound recording and a sound model, and return their paths."""
    write_hdf5(sound_recording(), folder / "recording.h5")
    geometry = ContactGeometry(
        bodies=("block",),
        body=np.zeros(2, int),
        position=np.array([[0.01, 0, 0], [-0.01, 0, 0]]),
        radius=np.full(2, 0.01),
        mass=np.full(2, 0.03),
        friction=np.full(2, 0.5),
    )
    Model(Scene(SCENE), geometry).save(folder / "model.toml")
    return folder / "recording.h5", folder / "model.toml"


def csv_text(header: str, values: np.ndarray) -> str:
    """Return a CSV file of numbers [T, C] at `TIME`."""
    rows = (",".join(f"{number:.9g}" for number in row) for row in np.column_stack([TIME, values]))
    return "\n".join([header, *rows]) + "\n"


def write_csv_folder(folder: Path) -> None:
    """Write the recording as a folder of CSV files."""
    folder.mkdir()
    (folder / "scene.xml").write_text(SCENE)
    still = np.ones((len(TIME), 1))
    (folder / "measured_elbow_angle.csv").write_text(csv_text("time,angle", ANGLE))
    (folder / "measured_block_position.csv").write_text(csv_text("time,x,y,z", still * [0.4, 0, 0.02]))
    (folder / "measured_block_orientation.csv").write_text(csv_text("time,w,x,y,z", still * [1, 0, 0, 0]))
    (folder / "action_elbow.csv").write_text(csv_text("time,command", ANGLE))


LOG_CAMERA = {"fx": 8.0, "fy": 8.0, "ppx": 3.5, "ppy": 2.5, "width": 8, "height": 6}
"""Intrinsics of the camera of the folder of images."""
LOG_MAP = """
[action.elbow]
source = "command/angle"
[measured.elbow_angle]
source = "joints/angle"
unit = "rad"
[image.wrist]
color = "color"
depth = "depth"
pose = [[1, 0, 0, 0.4], [0, -1, 0, 0.6], [0, 0, -1, 0.5], [0, 0, 0, 1]]
"""
"""Map from the folder of images to the scene: the camera looks down on the table."""


def write_log(folder: Path) -> None:
    """Write a folder of images with tables, and its map beside it."""
    import cv2

    for kind, image in (("color", np.full((6, 8, 3), 90, np.uint8)), ("depth", np.full((6, 8), 500, np.uint16))):
        (folder / "log" / kind).mkdir(parents=True)
        for time in TIME[:30:10]:
            cv2.imwrite(str(folder / "log" / kind / f"{1_764_000_000_000 + round(1000 * time)}.png"), image)
    (folder / "log" / "intrinsics.json").write_text(json.dumps(LOG_CAMERA))
    rows = "\n".join(f"{1_764_000_000 + t:.3f},{a:.9g}" for t, a in zip(TIME, ANGLE, strict=True))
    for name in ("joints", "command"):
        (folder / "log" / f"{name}.csv").write_text(f"time,angle\n{rows}\n")
    (folder / "map.toml").write_text(LOG_MAP)


def write_dataset(folder: Path) -> None:
    """Write a LeRobot data set of two short episodes."""
    from concent_warp.render.dataset.layout import EpisodeLayout
    from concent_warp.render.dataset.lerobot import LeRobotWriter

    writer = LeRobotWriter(folder, EpisodeLayout(10, ("front",), (16, 16), ("elbow",), ("elbow",)))
    for key in range(2):
        episode = writer.begin(key, "swing")
        for angle in ANGLE[:3]:
            episode.add({"front": np.full((16, 16, 3), 90, np.uint8)}, np.array([angle]), np.array([angle]))
        episode.save()
    writer.finish()


def servo_log() -> dict[str, object]:
    """Return the log of a servo that swings a payload."""
    entries = [
        {"timestamp": float(t), "position": float(p), "goal_position": float(p), "torque_enable": True}
        for t, p in zip(TIME, ANGLE, strict=True)
    ]
    return {"mass": 0.1, "length": 0.1, "kp": 32, "vin": 7.5, "trajectory": "sine", "entries": entries}


def toss_rows() -> np.ndarray:
    """Return the rows of a cube that lies on the board, shape (60, 13)."""
    rows = np.zeros((60, 13))
    rows[:, 0], rows[:, 6] = 1, 0.0524
    return rows


def open_diagnosis(joint: str, size: float) -> dict[str, object]:
    """Return a diagnosis, as JSON has it, that cannot distinguish friction of a joint from damping.

    Args:
        joint: Name of the joint.
        size: Torque [N m] and damping [N m s/rad].
    """
    names = {"joint_friction": "torque", "joint_damping": "damping"}
    effects = [
        {
            "name": name,
            "target": [joint],
            "accepted": name == "joint_friction",
            "step": 0,
            "parameters": [
                {"name": f"{parameter}[{joint}]", "value": size, "interval": [size / 2, 2 * size], "null": 0.0}
            ],
        }
        for name, parameter in names.items()
    ]
    return {"verdict": "group", "groups": [list(names)], "effects": effects}


def write_all(folder: Path) -> None:
    """Write sound inputs of every kind into an empty folder."""
    import torch

    from concent_warp.train.policy.pretrained import FOLDER

    write_recording_and_model(folder)
    write_csv_folder(folder / "csv")
    write_log(folder)
    write_dataset(folder / "dataset")
    (folder / "scene.xml").write_text(SCENE)
    (folder / "found.json").write_text(json.dumps(open_diagnosis("elbow", 0.1)))
    (folder / "servo.json").write_text(json.dumps(servo_log()))
    torch.save(torch.from_numpy(toss_rows()).float(), folder / "toss.pt")
    policy = FOLDER / "shape_sorter"
    (folder / "policy").mkdir()
    for path in policy.iterdir():
        if path.name != "origin.toml":
            shutil.copy(path, folder / "policy")
    shutil.copy(policy / "events.json", folder)
