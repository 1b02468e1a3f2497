"""Recordings of the scripted expert in Reality."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated

import mujoco
import numpy as np

from concent_warp.checks import Bounds, check_seed, check_settings
from concent_warp.reality.expert.inverse_kinematics import solve_path
from concent_warp.reality.expert.plan import ExpertCfg, Task, plan
from concent_warp.reality.expert.steering import aligned, arm_joints, deflection, finger_joints
from concent_warp.reality.fingers import pad_geoms
from concent_warp.reality.run import WorldLog, simulate, simulate_to_rest
from concent_warp.reality.sensors.camera import CAMERA, record_depth_images
from concent_warp.reality.sensors.footage import FootageCfg, footage
from concent_warp.reality.sensors.sensing import SensingCfg, measure, reading_steps
from concent_warp.reality.variation import VariationCfg
from concent_warp.reality.world import HiddenEffect, WorldCfg
from concent_warp.recording.recording import Channel, Demonstration, ImageStream, PointTrack, Recording
from concent_warp.scene.scene import Scene
from concent_warp.scene.shape_sorter import ShapeSorterCfg, home
from concent_warp.scene.tabletop import yaw_quaternion


@dataclass(frozen=True)
class RealityCfg:
    """Settings of recordings in Reality: a task demonstrated by the scripted expert, by default the shape sorter."""

    task: ShapeSorterCfg = field(default_factory=ShapeSorterCfg)
    """Nominal positions and sizes; the block's pose is sampled around these for each demonstration."""
    expert: ExpertCfg = field(default_factory=ExpertCfg)
    """Settings of the scripted expert."""
    world: WorldCfg = field(default_factory=WorldCfg)
    """Differences of Reality from the nominal scene."""
    sensing: SensingCfg = field(default_factory=SensingCfg)
    """Noise and rates of encoders, pose tracker and depth camera."""
    footage: FootageCfg = field(default_factory=FootageCfg)
    """Colour cameras."""
    place_spread: Annotated[float, Bounds(0, 10)] = 0.02
    """Half width of the square in which the position of object 1 is sampled [m]."""
    yaw_spread: Annotated[float, Bounds(0, math.pi)] = 0.15
    """Half width of its rotation about the vertical [rad]."""
    settling_time: Annotated[float, Bounds(0, 3600)] = 0.3
    """Time simulated before the recording starts, so that objects and arm come to rest [s]."""


@dataclass(frozen=True)
class Truth:
    """True states and contacts of a recording, for benchmarks that score a fit."""

    time: np.ndarray
    """Times [s], one each step, shape (T,)."""
    qpos: np.ndarray
    """Positions, shape (T, nq); the joints are those of the scene."""
    block_position: np.ndarray
    """Origin of object 1, the block [m], world frame, shape (T, 3)."""
    contacts: dict[tuple[str, str], np.ndarray]
    """Whether two bodies were in contact, by body pair in alphabetical order, shape (T,) bool."""
    box_force: np.ndarray
    """Force of object 2, the box, on object 1 [N], shape (T, 3)."""
    success: bool
    """Whether object 1 came to rest in its place."""


def record(
    cfg: RealityCfg,
    seeds: list[int],
    *,
    task: Task | None = None,
    effects: tuple[HiddenEffect, ...] = (),
    variation: VariationCfg | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[Recording, list[Truth]]:
    """Return a recording with one demonstration per seed in the same scene, and the truth of each.

    Object 2 has the configured pose in every demonstration; the pose of object 1 and the expert's offsets are sampled
    from the seed. With `variation`, so are friction, masses and gains; by default they are the nominal scene's.

    Args:
        cfg: Settings.
        seeds: One for each demonstration.
        task: What is demonstrated; the shape sorter `cfg.task` by default.
        effects: Hidden effects.
        variation: What varies between demonstrations.
        progress: Called with the share done, 0..1.

    Raises:
        ConcentError: A seed or a setting is out of bounds.
    """
    check_settings(cfg)
    if variation is not None:
        check_settings(variation)
    for seed in seeds:
        check_seed(seed)
    task = task or cfg.task
    check_settings(task)
    scene = task.build()
    demonstrations, truths = [], []
    for k, seed in enumerate(seeds):
        demonstration, truth = _perform(
            cfg,
            task,
            scene,
            f"demo_{k}",
            np.random.default_rng(seed),
            effects,
            variation,
            None if progress is None else lambda share, k=k: progress((k + share) / len(seeds)),
        )
        demonstrations.append(demonstration)
        truths.append(truth)
    return Recording(scene.xml, tuple(demonstrations), source="reality"), truths


def _perform(
    cfg: RealityCfg,
    nominal: Task,
    scene: Scene,
    name: str,
    rng: np.random.Generator,
    effects: tuple[HiddenEffect, ...],
    variation: VariationCfg | None,
    progress: Callable[[float], None] | None,
) -> tuple[Demonstration, Truth]:
    """Run one demonstration."""
    moved = scene.model.body(nominal.objects[0])
    place = moved.pos[:2] + rng.uniform(-cfg.place_spread, cfg.place_spread, 2)
    yaw = 2 * math.atan2(moved.quat[3], moved.quat[0]) + rng.uniform(-1, 1) * cfg.yaw_spread
    task = nominal.placed_at((float(place[0]), float(place[1])), yaw)
    world = cfg.world.build(scene, effects)
    model = world.compile()
    data = mujoco.MjData(model)
    if variation is not None:
        # A generator of its own, so that all else is the same with and without variation.
        pads = pad_geoms(model, task.robot.gripper_actuators)
        fields = variation.sample(model, scene.objects(), pads, 1, rng.spawn(1)[0])
        for field_name, values in fields.items():
            getattr(model, field_name)[:] = values[0]
        mujoco.mj_setConst(model, data)
    data.qpos[:] = home(model)
    joint = model.jnt_qposadr[model.body(task.objects[0]).jntadr[0]]
    data.qpos[joint : joint + 2] = place
    data.qpos[joint + 3 : joint + 7] = yaw_quaternion(yaw)
    for joint in finger_joints(model):
        data.qpos[model.jnt_qposadr[joint]] = model.jnt_range[joint, 1]
    gripper = [model.actuator(a).id for a in task.robot.gripper_actuators]
    open_width = float(model.actuator_ctrlrange[gripper[0], 1])
    mujoco.mj_forward(model, data)

    tcp = data.site(task.robot.tcp_site)
    start, start_rotation = tcp.xpos.copy(), tcp.xmat.reshape(3, 3).copy()
    path = plan(task, cfg.expert, start, open_width, rng)
    arm = arm_joints(model, gripper)
    path = aligned(path, start_rotation)
    angles = solve_path(model, task.robot.tcp_site, arm, data.qpos, path.position, path.rotation)
    # The expert knows the nominal drives, not the hidden effects in them.
    angles += deflection(scene.model, task.robot.tcp_site, arm, data.qpos, angles, path.force)
    action = np.zeros((len(path.time), model.nu))
    for column in range(model.nu):
        if column in gripper:
            action[:, column] = path.opening
        else:
            action[:, column] = angles[:, arm.index(int(model.actuator_trnid[column, 0]))]
    simulate_to_rest(model, data, action[0], effects, cfg.settling_time)
    qpos, qvel = data.qpos.copy(), data.qvel.copy()
    log = simulate(cfg.sensing, scene, model, data, path.time, action, effects, rng, progress)

    truth = _judge(model, log, task)
    actions = {model.actuator(i).name: Channel(path.time, action[:, i]) for i in range(model.nu)}
    sensed = sensed_motion(cfg, scene, world, model, log, effects, rng)
    return Demonstration(name, task.text, truth.success, qpos, qvel, actions, *sensed), truth


def sensed_motion(
    cfg: RealityCfg,
    scene: Scene,
    world: mujoco.MjSpec,
    model: mujoco.MjModel,
    log: WorldLog,
    effects: tuple[HiddenEffect, ...],
    rng: np.random.Generator,
) -> tuple[dict[str, Channel], dict[str, PointTrack], dict[str, ImageStream]]:
    """Return what the instruments show of a motion in Reality: readings, tracked points and images.

    Args:
        cfg: Settings.
        scene: The nominal scene.
        world: Reality, and `model` the same compiled.
        model: See `world`.
        log: The motion.
        effects: Hidden effects.
        rng: Random numbers of the noise.
    """
    measured = measure(cfg.sensing, model, np.array(log.time), np.array(log.sensordata), rng)
    points = {
        body: PointTrack(np.array(log.frames), np.array(log.points[body]), np.array(log.visible[body]))
        for body in log.points
    }
    image, time, states = {}, np.array(log.time), np.array(log.qpos)
    if cfg.sensing.images:
        rows = reading_steps(time, cfg.sensing.image_rate)
        # A generator of its own, so that all else is the same with and without images.
        image[CAMERA] = record_depth_images(
            cfg.sensing, world, scene.objects(), time[rows], states[rows], rng.spawn(1)[0]
        )
    if cfg.footage.cameras:
        rows = reading_steps(time, cfg.footage.rate)
        image |= footage(cfg.footage, world, scene.objects(), time[rows], states[rows], rng.spawn(1)[0])
    for effect in effects:
        if effect.measure is not None:
            for channel, stream in measured.items():
                at, value = effect.measure(channel, stream.time, stream.value)
                measured[channel] = replace(stream, time=at, value=value)
    return measured, points, image


def _judge(model: mujoco.MjModel, log: WorldLog, task: Task) -> Truth:
    """Return the true states and contacts of a log."""
    first, second = task.objects
    readings = np.array(log.sensordata)

    def reading(name: str) -> np.ndarray:
        sensor = model.sensor(name)
        return readings[:, sensor.adr[0] : sensor.adr[0] + sensor.dim[0]]

    position = reading(f"{first}_position")
    names = {pair for pairs in log.pairs for pair in pairs}
    contacts = {pair: np.array([pair in pairs for pairs in log.pairs]) for pair in sorted(names)}
    pair = (min(first, second), max(first, second))
    sign = 1.0 if pair[1] == first else -1.0
    force = np.array([sign * pairs.get(pair, np.zeros(3)) for pairs in log.pairs])
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, reading(f"{second}_orientation")[-1])
    place = rotation.reshape(3, 3).T @ (position[-1] - reading(f"{second}_position")[-1])
    success = bool(np.abs(place - task.goal()).max() < 0.003)
    return Truth(np.array(log.time), np.array(log.qpos), position, contacts, force, success)
