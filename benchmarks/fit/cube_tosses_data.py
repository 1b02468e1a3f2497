"""Sphere cubes of a wrong size, and how well they reproduce measured tosses: for `cube_tosses.py`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.estimation.object_tracks import (
    BodyTarget,
    Segment,
    measured_pose,
    observed_poses,
    whole_demonstration,
)
from concent_warp.estimation.state_estimator import StateEstimator
from concent_warp.estimation.windows import cut_windows
from concent_warp.model import Model
from concent_warp.recording.formats.contactnets import EDGE
from concent_warp.recording.recording import Recording
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.scene.spheres.contact_geometry import ContactGeometry
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.replay import bracketing

BODY = "cube"
TIMESTEP = 0.002
"""[s]; halves the time of the reader's 1 ms and leaves the errors as they are."""
SPHERES = 128
FLIGHT = 12
"""Frames of free flight at least, for an estimate of the acceleration."""
SETTLE = 0.6
"""Time for a cube to come to rest [s]."""


@dataclass(frozen=True)
class Judgement:
    """Mean errors of G geometries on n tosses, each of shape (G, n); NaN for a toss without a window."""

    window: np.ndarray
    """Distance of points on the cube's surface, over windows that start from the measured state [m]."""
    position: np.ndarray
    """Distance of the cube's centre, over the whole toss simulated from its first state [m]."""
    rotation: np.ndarray
    """Angle between simulated and measured orientation, over the whole toss [rad]."""


def scene_of(recording: Recording, edge: float) -> Scene:
    """Return the scene of the tosses with the cube's box scaled to an edge [m]; mass and inertia stay."""
    spec = Scene(recording.scene).spec()
    spec.option.timestep = TIMESTEP
    spec.geom(BODY).size[:] = edge / 2
    return Scene.from_spec(spec, recording.source)


def sphere_cube(recording: Recording, edge: float) -> Model:
    """Return a model whose cube has an edge [m]: inset spheres of the default radius, friction as in the scene."""
    scene = scene_of(recording, edge)
    return Model(scene, ContactGeometryCfg(count=SPHERES).build(scene, [BODY]))


def standing_widths(geometry: ContactGeometry) -> np.ndarray:
    """Return the edge along each axis [m], shape (3,), between the planes on which the cube would stand.

    A face stands on the spheres that reach farthest: its plane is the mean, over the four quadrants of the face, of the
    farthest reach in each, so that a single bump counts a quarter and spheres that have sunk in do not count.
    """
    heights = np.zeros((3, 2))
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        quadrant = (geometry.position[:, others] > 0) @ [1, 2]
        for side, sign in enumerate((-1, 1)):
            reach = sign * geometry.position[:, axis] + geometry.radius
            heights[axis, side] = np.mean([reach[quadrant == q].max() for q in range(4)])
    return heights.sum(axis=1)


def rests_at(model: Model) -> float:
    """Return twice the mean height of the centre of the cube at rest on each of its faces [m]."""
    engine = MujocoEngine(model)
    axes = np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [2, 0, 0]])
    down = Rotation.from_rotvec(np.pi / 2 * axes)
    qpos = np.concatenate([np.tile([0, 0, 0.57 * EDGE], (6, 1)), down.as_quat(scalar_first=True)], axis=1)
    steps = round(SETTLE / engine.timestep)
    rollout = engine.run(Variants(6, qpos=qpos), np.zeros((steps, 0)), record=[steps], bodies=())
    return 2 * float(np.mean(rollout.qpos[:, 0, 2]))


class Judge:
    """Simulates tosses in windows and whole. The points compared are those of the true cube."""

    def __init__(self, recording: Recording, window: float) -> None:
        """Cut all tosses into windows of a length [s]."""
        self.scene = scene_of(recording, EDGE)
        self.windows = {d.name: cut_windows(self.scene, d, (BODY,), window) for d in recording.demonstrations}
        self.whole = {d.name: whole_demonstration(self.scene, d, (BODY,)) for d in recording.demonstrations}

    def __call__(self, geometries: Sequence[ContactGeometry], names: Sequence[str]) -> Judgement:
        """Return the errors of geometries on some tosses."""
        model = Model(self.scene, geometries[0])
        pieces = [self.windows[name] for name in names]
        distance, _, _ = errors(model, geometries, [s for group in pieces for s in group])
        toss = np.repeat(np.arange(len(names)), [len(group) for group in pieces])
        mean = np.full((len(geometries), len(names)), np.nan)
        for k in np.unique(toss):
            mean[:, k] = distance[:, toss == k].mean(axis=1)
        _, position, rotation = errors(model, geometries, [self.whole[name] for name in names])
        return Judgement(mean, position, rotation)


def errors(
    model: Model, geometries: Sequence[ContactGeometry], segments: Sequence[Segment]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean errors of surface points [m], centre [m] and orientation [rad], each of shape (G, segments)."""
    engine = MujocoEngine(model)
    n, g = len(segments), len(geometries)
    steps = max(len(s.ctrl) for s in segments)
    record, _, _ = bracketing(np.concatenate([s.targets[0].time for s in segments]), engine.timestep, steps)
    variants = Variants(
        g * n,
        sphere_position=np.repeat([geometry.position for geometry in geometries], n, axis=0),
        sphere_radius=np.repeat([geometry.radius for geometry in geometries], n, axis=0),
        sphere_friction=np.repeat([geometry.friction for geometry in geometries], n, axis=0),
        qpos=np.tile([s.qpos for s in segments], (g, 1)),
        qvel=np.tile([s.qvel for s in segments], (g, 1)),
    )
    rollout = engine.run(variants, np.zeros((steps, 0)), record=record, bodies=[BODY])
    result = np.zeros((3, g, n))
    for k, segment in enumerate(segments):
        target = segment.targets[0]
        pose = observed_poses(target, np.arange(len(target.time)))
        turn = Rotation.from_quat(pose[:, 3:], scalar_first=True)
        for j in range(g):
            row = j * n + k
            place, rotation = at(
                rollout.time, rollout.body_position[row, :, 0], rollout.body_quaternion[row, :, 0], target
            )
            points = place[:, None] + np.einsum("tij,mj->tmi", rotation.as_matrix(), target.anchor)
            result[0, j, k] = np.linalg.norm(points - target.points, axis=2).mean()
            result[1, j, k] = np.linalg.norm(place - pose[:, :3], axis=1).mean()
            result[2, j, k] = (rotation.inv() * turn).magnitude().mean()
    return result[0], result[1], result[2]


def at(
    time: np.ndarray, position: np.ndarray, quaternion: np.ndarray, target: BodyTarget
) -> tuple[np.ndarray, Rotation]:
    """Return simulated positions [m] and orientations at a target's times."""
    later = np.clip(np.searchsorted(time, target.time, side="right"), 1, len(time) - 1)
    share = np.clip((target.time - time[later - 1]) / (time[later] - time[later - 1]), 0, 1)[:, None]
    first, second = (Rotation.from_quat(quaternion[row], scalar_first=True) for row in (later - 1, later))
    between = (first.inv() * second).as_rotvec()
    place = (1 - share) * position[later - 1] + share * position[later]
    return place, first * Rotation.from_rotvec(share * between)


def resting_height(recording: Recording, names: Sequence[str]) -> float:
    """Return the mean measured height of the cube's centre over the board at the ends of tosses [m]."""
    return float(np.mean([recording[name].measured["cube_position"].value[-1, 2] for name in names]))


def free_fall(recording: Recording, names: Sequence[str]) -> tuple[float, float]:
    """Return the measured acceleration of free fall before the first contact and its standard error [m/s^2]."""
    scene = Scene(recording.scene)
    found = []
    for name in names:
        demonstration = recording[name]
        pose = measured_pose(scene.model, demonstration, BODY)
        assert pose is not None
        time, position, _ = pose
        contact = StateEstimator.of(Model(scene), demonstration).in_contact((BODY,), time)
        frames = int(np.argmax(contact)) - 3 if contact.any() else len(time)
        if frames >= FLIGHT:
            found.append(-2 * np.polyfit(time[:frames], position[:frames, 2], 2)[0])
    return float(np.mean(found)), float(np.std(found, ddof=1) / np.sqrt(len(found)))
