"""Let the expert perform in the stand-in world and write down what its instruments saw."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np

from concent_warp.reality.expert import ExpertCfg, Path, plan
from concent_warp.reality.inverse_kinematics import solve_path
from concent_warp.reality.sensing import SensingCfg, noisy_quaternion, seen, surface_points
from concent_warp.reality.world import HiddenEffect, WorldCfg
from concent_warp.recording.recording import Channel, Demonstration, PointTrack, Recording
from concent_warp.scene.scene import Scene
from concent_warp.scene.shape_sorter import ShapeSorterCfg, home


@dataclass(frozen=True)
class RealityCfg:
    """A day in the stand-in laboratory: the shape sorter shown by the scripted expert."""

    task: ShapeSorterCfg = field(default_factory=ShapeSorterCfg)
    """Nominal places and sizes; the places are drawn anew around these for each demonstration."""
    expert: ExpertCfg = field(default_factory=ExpertCfg)
    world: WorldCfg = field(default_factory=WorldCfg)
    sensing: SensingCfg = field(default_factory=SensingCfg)
    place_spread: float = 0.02
    """Half width of the square in which the block is placed [m]."""
    yaw_spread: float = 0.15
    """Half width of the block's and the box's rotation [rad]."""


@dataclass(frozen=True)
class Truth:
    """What no instrument saw; for benchmarks that judge a fit."""

    time: np.ndarray
    """Times [s], one each step, shape (T,)."""
    block_position: np.ndarray
    """Block origin [m], world frame, shape (T, 3)."""
    contacts: dict[tuple[str, str], np.ndarray]
    """Whether two bodies were in contact, by body pair in alphabetical order, shape (T,) bool."""
    box_force: np.ndarray
    """Force of the box on the block [N], shape (T, 3)."""
    success: bool
    """Whether the block came to rest in the hole."""


@dataclass
class Log:
    """Raw readings, one list entry per step or per frame."""

    time: list[float] = field(default_factory=list)
    qpos: list[np.ndarray] = field(default_factory=list)
    sensordata: list[np.ndarray] = field(default_factory=list)
    pairs: list[dict[tuple[str, str], np.ndarray]] = field(default_factory=list)
    frames: list[float] = field(default_factory=list)
    points: dict[str, list[np.ndarray]] = field(default_factory=dict)
    visible: dict[str, list[np.ndarray]] = field(default_factory=dict)


def record(
    cfg: RealityCfg,
    seeds: list[int],
    *,
    effects: tuple[HiddenEffect, ...] = (),
    progress: Callable[[float], None] | None = None,
) -> tuple[Recording, list[Truth]]:
    """Record one demonstration per seed, all in the same scene, and return what happened besides.

    The box stands where the configuration has it, in every demonstration; the block's place and the expert's offsets
    are drawn from the seed. `progress` is called with the share done, 0..1.
    """
    scene = cfg.task.build()
    demonstrations, truths = [], []
    for k, seed in enumerate(seeds):
        demonstration, truth = perform(
            cfg,
            scene,
            f"demo_{k}",
            np.random.default_rng(seed),
            effects,
            None if progress is None else lambda share, k=k: progress((k + share) / len(seeds)),
        )
        demonstrations.append(demonstration)
        truths.append(truth)
    return Recording(scene.xml, tuple(demonstrations), source="reality"), truths


def perform(
    cfg: RealityCfg,
    scene: Scene,
    name: str,
    rng: np.random.Generator,
    effects: tuple[HiddenEffect, ...],
    progress: Callable[[float], None] | None,
) -> tuple[Demonstration, Truth]:
    """Run one demonstration."""
    block = np.array(cfg.task.block_position) + rng.uniform(-cfg.place_spread, cfg.place_spread, 2)
    task = replace(
        cfg.task, block_position=tuple(block), block_yaw=cfg.task.block_yaw + rng.uniform(-1, 1) * cfg.yaw_spread
    )
    model = cfg.world.build(scene, effects)
    data = mujoco.MjData(model)
    data.qpos[:] = home(model)
    block_joint = model.joint("block_joint").qposadr[0]
    data.qpos[block_joint : block_joint + 2] = block
    data.qpos[block_joint + 3 : block_joint + 7] = [np.cos(task.block_yaw / 2), 0, 0, np.sin(task.block_yaw / 2)]
    for joint in finger_joints(model, task):
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
    angles += deflection(model, task.robot.tcp_site, arm, data.qpos, angles, path.force)
    action = np.zeros((len(path.time), model.nu))
    for column in range(model.nu):
        if column in gripper:
            action[:, column] = path.opening
        else:
            action[:, column] = angles[:, arm.index(int(model.actuator_trnid[column, 0]))]
    settle(model, data, action[0])
    qpos, qvel = data.qpos.copy(), data.qvel.copy()
    log = simulate(cfg, scene, model, data, path.time, action, effects, rng, progress)

    truth = judge(model, log, task)
    actions = {model.actuator(i).name: Channel(path.time, action[:, i]) for i in range(model.nu)}
    measured = measure(cfg.sensing, model, log, rng)
    points = {
        body: PointTrack(np.array(log.frames), np.array(log.points[body]), np.array(log.visible[body]))
        for body in log.points
    }
    for effect in effects:
        if effect.measure is not None:
            for channel, stream in measured.items():
                time, value = effect.measure(channel, stream.time, stream.value)
                measured[channel] = replace(stream, time=time, value=value)
    demonstration = Demonstration(
        name, "put the block into the hole of the box", truth.success, qpos, qvel, actions, measured, points
    )
    return demonstration, truth


def finger_joints(model: mujoco.MjModel, task: ShapeSorterCfg) -> list[int]:
    """Return the slide joints of the gripper: those no arm actuator drives directly."""
    return [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE and model.jnt_limited[j]]


def arm_joints(model: mujoco.MjModel, gripper: list[int]) -> list[int]:
    """Return the hinge joints that the other actuators drive, in the order of the actuators."""
    return [int(model.actuator_trnid[a, 0]) for a in range(model.nu) if a not in gripper]


def deflection(
    model: mujoco.MjModel, site: str, joints: list[int], qpos: np.ndarray, angles: np.ndarray, force: np.ndarray
) -> np.ndarray:
    """Return by how much the commands lie beyond `angles` (T, J) [rad] to exert `force` (T, 3) [N], shape (T, J).

    A position-controlled joint yields by torque over proportional gain: dq = K^-1 J^T f.
    """
    gain = np.array(
        [
            model.actuator_gainprm[a, 0]
            for j in joints
            for a in range(model.nu)
            if model.actuator_trnid[a, 0] == j and model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
        ]
    )
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    jacobian = np.zeros((3, model.nv))
    result = np.zeros_like(angles)
    for t in range(len(angles)):
        data.qpos[model.jnt_qposadr[joints]] = angles[t]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacSite(model, data, jacobian, None, model.site(site).id)
        result[t] = jacobian[:, model.jnt_dofadr[joints]].T @ force[t] / gain
    return result


def aligned(path: Path, start_rotation: np.ndarray) -> Path:
    """Turn the planned orientations by quarter turns so that they begin nearest to where the tool is."""
    best, turn = -np.inf, np.eye(3)
    for k in range(4):
        a = k * np.pi / 2
        candidate = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        match = float(np.trace(start_rotation.T @ candidate @ path.rotation[0]))
        if match > best + 1e-9:
            best, turn = match, candidate
    return replace(path, rotation=turn @ path.rotation)


def settle(model: mujoco.MjModel, data: mujoco.MjData, ctrl: np.ndarray) -> None:
    """Let the objects come to rest before the recording starts."""
    data.ctrl[:] = ctrl
    for _ in range(round(0.3 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    data.time = 0.0


def simulate(
    cfg: RealityCfg,
    scene: Scene,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    time: np.ndarray,
    action: np.ndarray,
    effects: tuple[HiddenEffect, ...],
    rng: np.random.Generator,
    progress: Callable[[float], None] | None,
) -> Log:
    """Step the world along the commands and log every step and every camera frame."""
    sensing, log = cfg.sensing, Log()
    camera = np.array(sensing.camera_position)
    track = {body: visible_points(scene, model, data, body, camera, sensing, rng) for body in scene.objects()}
    log.points, log.visible = {body: [] for body in track}, {body: [] for body in track}
    steps = round(time[-1] / model.opt.timestep)
    wander = np.zeros(model.nu)
    keep = np.exp(-model.opt.timestep / sensing.tracking_time)
    kick = sensing.tracking_std * np.sqrt(1 - keep**2)
    next_frame = 0.0
    for k in range(steps + 1):
        now = k * model.opt.timestep
        ctrl = action[np.searchsorted(time, now + 1e-9, side="right") - 1]
        for effect in effects:
            if effect.command is not None:
                ctrl = effect.command(now, ctrl)
        wander = keep * wander + kick * rng.normal(size=model.nu)
        data.ctrl[:] = ctrl + wander
        data.qfrc_applied[:] = 0
        data.xfrc_applied[:] = 0
        for effect in effects:
            if effect.force is not None:
                effect.force(model, data)
        qpos = data.qpos.copy()
        mujoco.mj_step(model, data)  # sensors, poses and contacts are those of the state before the step
        log.time.append(now)
        log.qpos.append(qpos)
        log.sensordata.append(data.sensordata.copy())
        log.pairs.append(touching(model, data))
        if now >= next_frame - 1e-9:
            next_frame += 1 / sensing.point_rate
            log.frames.append(now)
            for body, local in track.items():
                place = data.body(body)
                points = place.xpos + local @ place.xmat.reshape(3, 3).T
                log.visible[body].append(seen(model, data, camera, points, 2e-3))
                noisy = points + rng.normal(0, sensing.point_std, points.shape)
                log.points[body].append(np.where(log.visible[body][-1][:, None], noisy, np.nan))
        if progress is not None and k % 200 == 0:
            progress(k / steps)
    return log


def visible_points(
    scene: Scene,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    body: str,
    camera: np.ndarray,
    sensing: SensingCfg,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return surface points of a body that the camera sees at time 0, body frame [m], shape (point_count, 3)."""
    local = surface_points(scene, body, 40 * sensing.point_count, rng)
    place = data.body(body)
    points = place.xpos + local @ place.xmat.reshape(3, 3).T
    local = local[seen(model, data, camera, points, 2e-3)]
    return local[rng.choice(len(local), sensing.point_count, replace=False)]


def touching(model: mujoco.MjModel, data: mujoco.MjData) -> dict[tuple[str, str], np.ndarray]:
    """Return the body pairs in contact, in alphabetical order, with the force on the second [N], world frame."""
    pairs: dict[tuple[str, str], np.ndarray] = {}
    force = np.zeros(6)
    for i, contact in enumerate(data.contact):
        if contact.efc_address < 0:
            continue
        first, second = (model.body(model.geom_bodyid[g]).name for g in contact.geom)
        mujoco.mj_contactForce(model, data, i, force)
        vector = contact.frame.reshape(3, 3).T @ force[:3]
        pair, vector = ((first, second), vector) if first <= second else ((second, first), -vector)
        pairs[pair] = pairs.get(pair, np.zeros(3)) + vector
    return pairs


def measure(sensing: SensingCfg, model: mujoco.MjModel, log: Log, rng: np.random.Generator) -> dict[str, Channel]:
    """Return every sensor's readings with the noise and the rate of its instrument."""
    time, readings = np.array(log.time), np.array(log.sensordata)
    channels = {}
    for i in range(model.nsensor):
        name, address, dim = model.sensor(i).name, model.sensor_adr[i], model.sensor_dim[i]
        joint = int(model.sensor_type[i]) in (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_TENDONPOS)
        rate = sensing.encoder_rate if joint else sensing.pose_rate
        rows = np.unique(np.round(np.arange(0, time[-1], 1 / rate) / model.opt.timestep).astype(int))
        value = readings[rows, address : address + dim]
        if model.sensor_type[i] == mujoco.mjtSensor.mjSENS_FRAMEQUAT:
            std = sensing.orientation_std
            value = noisy_quaternion(value, std, rng)
        else:
            std = sensing.encoder_std if joint else sensing.position_std
            value = value + rng.normal(0, std, value.shape)
        channels[name] = Channel(time[rows], value, noise_std=std)
    return channels


def judge(model: mujoco.MjModel, log: Log, task: ShapeSorterCfg) -> Truth:
    """Return what truly happened."""
    address = model.sensor_adr[model.sensor("block_position").id]
    position = np.array(log.sensordata)[:, address : address + 3]
    names = {pair for pairs in log.pairs for pair in pairs}
    contacts = {pair: np.array([pair in pairs for pairs in log.pairs]) for pair in sorted(names)}
    force = np.array([-pairs.get(("block", "box"), np.zeros(3)) for pairs in log.pairs])
    seat = np.array([*task.box_position, task.floor + task.block_size / 2])
    success = bool(np.abs(position[-1] - seat).max() < 0.003)
    return Truth(np.array(log.time), position, contacts, force, success)
