"""A small robot of six joints whose hand goes anywhere, and pictures of tags by homographies."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from concent_warp.recording.recording import Channel, Demonstration, ImageStream, Recording

JOINTS = ("x", "y", "z", "roll", "pitch", "yaw")
AXES = ("1 0 0", "0 1 0", "0 0 1") * 2
SIZE = 0.05
WIDTH, HEIGHT = 320, 240
MATRIX = np.array([[330.0, 0, 158.0], [0, 328.0, 121.0], [0, 0, 1]])


def scene() -> str:
    """Return a robot of three slides and three hinges, in this order from the world to the hand."""
    bodies = "".join(
        f"<body name='{'hand' if name == 'yaw' else name + '_link'}'>"
        f"<joint name='{name}' type='{'slide' if i < 3 else 'hinge'}' axis='{AXES[i]}'/>"
        "<geom type='box' size='.03 .02 .04' mass='1'/>"
        for i, name in enumerate(JOINTS)
    )
    sensors = "".join(f"<jointpos name='{name}' joint='{name}'/>" for name in JOINTS)
    return (
        "<mujoco><compiler angle='radian'/><worldbody><geom type='plane' size='1 1 .1'/>"
        f"{bodies}{'</body>' * 6}</worldbody><sensor>{sensors}</sensor></mujoco>"
    )


def pose_of(rotation: Rotation, position: np.ndarray | list[float]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), position
    return pose


@dataclass(frozen=True)
class Filming:
    """How a recording is made."""

    camera_on_hand: bool = True
    frames: int = 20
    seed: int = 0
    offset: float = 0.03
    """Time to be added to those of the frames [s]."""
    size: float = SIZE
    dictionary: int = cv2.aruco.DICT_APRILTAG_36h11
    mirrored: bool = False
    depth_scale: float = 1.0
    moved_from: float | None = None
    """Time from which the tag lies 6 cm aside [s]."""
    turning: tuple[float, float, float] = (0.5, 0.5, 0.6)
    """Amplitude of the tag's rotation in view [rad]."""
    radial: float = 0.0
    """Coefficient k1 of the lens."""
    matrix: np.ndarray = field(default_factory=lambda: MATRIX)
    """What the recording has for the pinhole matrix [px]."""


CAMERA_ON_HAND = pose_of(Rotation.from_euler("xyz", [0.05, -0.04, 0.3]), [0.04, -0.02, 0.05])
TAG_IN_WORLD = pose_of(Rotation.from_euler("x", np.pi), [0.02, 0.03, 0.4])
CAMERA_IN_WORLD = pose_of(Rotation.from_euler("xyz", [0.1, 0.2, 0.3]), [0.1, -0.05, -0.1])
TAG_ON_HAND = pose_of(Rotation.from_euler("xyz", [np.pi, 0.1, 0.5]), [0.01, 0.02, -0.03])


def film(how: Filming) -> Recording:
    """Return a recording of a tag; encoders read 0.1 mm and 0.5 mrad off, at 100 Hz."""
    rng = np.random.default_rng(how.seed)
    duration, knots = 10.0, np.linspace(0, 10, 13)
    camera, tag = (CAMERA_ON_HAND, TAG_IN_WORLD) if how.camera_on_hand else (CAMERA_IN_WORLD, TAG_ON_HAND)
    path = CubicSpline(knots, np.array([joints_that_show(how, camera, tag, rng) for _ in knots]))
    time = np.sort(rng.uniform(0.3, duration - 0.3, how.frames))
    family = cv2.aruco.getPredefinedDictionary(how.dictionary)
    cells = family.markerSize + 2
    picture = np.pad(cv2.aruco.generateImageMarker(family, 5, 20 * cells), 40, constant_values=255)
    half = how.size / 2 * (picture.shape[0] / (20 * cells))
    corners = half * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.0]])
    side = picture.shape[0] - 0.5
    source = np.array([[-0.5, -0.5], [side, -0.5], [side, side], [-0.5, side]])
    rgb = np.zeros((how.frames, HEIGHT, WIDTH, 3), np.uint8)
    depth = np.zeros((how.frames, HEIGHT, WIDTH), np.float32)
    for t, instant in enumerate(time):
        hand = hand_pose(path(instant))
        placed = tag.copy()
        if how.moved_from is not None and instant > how.moved_from:
            placed[0, 3] += 0.06
        seen = np.linalg.inv(hand @ camera) @ placed if how.camera_on_hand else np.linalg.inv(camera) @ hand @ placed
        pixels, _ = cv2.projectPoints(
            corners,
            Rotation.from_matrix(seen[:3, :3]).as_rotvec(),
            seen[:3, 3],
            MATRIX,
            np.array([how.radial, 0, 0, 0]),
        )
        # Four times as fine, so that edges are soft.
        fine = cv2.getPerspectiveTransform(source.astype(np.float32), (4 * pixels[:, 0] + 1.5).astype(np.float32))
        image = cv2.warpPerspective(
            picture, fine, (4 * WIDTH, 4 * HEIGHT), borderValue=(120.0,), flags=cv2.INTER_LINEAR
        )
        image = cv2.resize(cv2.GaussianBlur(image, (0, 0), 2.0), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
        image = np.clip(0.7 * image + 20 + rng.normal(0, 2, image.shape), 0, 255)
        rgb[t] = (image[:, ::-1] if how.mirrored else image)[..., None]
        v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
        rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(MATRIX).T
        plane = (seen[:3, 2] @ seen[:3, 3]) / (rays @ seen[:3, 2])
        depth[t] = np.clip(how.depth_scale * plane + rng.normal(0, 1e-3, plane.shape), 0, 3)
    measured = {}
    for i, name in enumerate(JOINTS):
        reading = np.arange(0, duration, 0.01)
        value = path(reading)[:, i : i + 1] + rng.normal(0, 1e-4 if i < 3 else 5e-4, (len(reading), 1))
        value[rng.random(len(reading)) < 0.03] = np.nan
        measured[name] = Channel(reading, value)
    wrong = pose_of(Rotation.from_euler("xyz", [0.03, -0.04, 0.05]), [0.01, 0.02, -0.015])
    image = ImageStream(
        time - how.offset, rgb, depth, how.matrix, wrong @ camera, "hand" if how.camera_on_hand else None
    )
    return Recording(scene(), (Demonstration("demo_0", measured=measured, image={"eye": image}),), source="film.h5")


def joints_that_show(how: Filming, camera: np.ndarray, tag: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return joint positions (6,) at which the camera sees the tag."""
    turn = Rotation.from_euler("x", np.pi) * Rotation.from_rotvec(how.turning * rng.uniform(-1, 1, 3))
    seen = pose_of(turn, [*rng.uniform(-0.04, 0.04, 2), rng.uniform(0.22, 0.34)])
    back = np.linalg.inv(seen)
    hand = tag @ back @ np.linalg.inv(camera) if how.camera_on_hand else camera @ seen @ np.linalg.inv(tag)
    return np.array([*hand[:3, 3], *Rotation.from_matrix(hand[:3, :3]).as_euler("XYZ")])


def hand_pose(joints: np.ndarray) -> np.ndarray:
    """Return the pose of the hand (4, 4) at joint positions (6,)."""
    return pose_of(Rotation.from_euler("XYZ", joints[3:]), joints[:3])


def with_stream(recording: Recording, **changes: object) -> Recording:
    """Return a recording whose stream is changed."""
    demonstration = recording[0]
    stream = replace(demonstration.image["eye"], **changes)
    return replace(recording, demonstrations=(replace(demonstration, image={"eye": stream}),))
