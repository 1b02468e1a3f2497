"""A rig: a small experiment in Reality, and its recording.

A rig has the nominal scene of the user's model, the physics of Reality, and commanded motions. Recordings have sensor
readings, never the truth; the recorded initial state has the error of an estimate from the first readings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import mujoco
import numpy as np

from concent_warp.reality.sensors.instruments import Instruments, instrument_reading
from concent_warp.reality.world import HiddenEffect
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

START_STD = (1e-4, 1e-3, 2e-3, 1e-2)
"""Standard deviations of the errors of a recorded initial state: position [m], orientation [rad], velocity [m/s],
angular velocity [rad/s]."""


@dataclass(frozen=True)
class RigTrial:
    """Initial state and commands of one motion."""

    duration: float
    """Duration [s]."""
    action: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    """Commands by actuator: times [s] and values, shapes (T,); each constant until the next."""
    qpos: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """Positions at time 0 by joint, if they differ from the nominal ones."""
    qvel: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """Velocities at time 0 by joint, set after settling."""
    settling_time: float = 0.0
    """Time before time 0 for which the first command acts, so that bodies come to rest [s]."""


@dataclass(frozen=True)
class WorldPhysics:
    """Differences of Reality from the nominal scene, without hidden effects."""

    timestep: float = 0.0005
    """Step [s]."""
    impratio: float | None = None
    """Stiffness of the friction against that of the normal force [-]; None for the nominal one."""
    lead: float = 0.0
    """Time by which commands act earlier than recorded [s], see `of_coarser_step`."""
    armature: Mapping[str, float] = field(default_factory=dict)
    """Inertia added to driven joints [kg m^2 or kg], see `of_coarser_step`."""
    edit: Callable[[mujoco.MjSpec], None] | None = None
    """Anything else, such as exact convex shapes."""
    force: Callable[[mujoco.MjModel, mujoco.MjData], None] | None = None
    """Forces computed by Reality, as in `HiddenEffect`."""


def of_coarser_step(scene: Scene, **rest: Any) -> WorldPhysics:
    """Return physics with a third of the nominal time step, in which the nominal parameters hold.

    Nominal parameters are meant for the nominal time step dt. With it commands act dt/2 too early (from the beginning
    of a step, not its middle), and a drive's damping kv is evaluated at the end of the step, which amounts to an
    inertia of kv dt/2. Physics with a shorter step compensate both, otherwise recordings without hidden effects would
    show the nominal time step. With a third of it, the lead is exactly one step of Reality.
    """
    m = scene.model
    timestep = m.opt.timestep / 3
    short = (m.opt.timestep - timestep) / 2
    driven = [a for a in range(m.nu) if m.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT]
    damping = {m.joint(m.actuator_trnid[a, 0]).name: -m.actuator_biasprm[a, 2] for a in driven}
    return WorldPhysics(
        timestep=timestep, lead=short, armature={j: kv * short for j, kv in damping.items() if kv > 0}, **rest
    )


@dataclass(frozen=True)
class Rig:
    """A small experiment."""

    name: str
    scene: Scene
    """Nominal scene: MJCF with the recorded sensors."""
    plan: Callable[[np.random.Generator, int], RigTrial]
    """Returns the k-th motion, sampled with the demonstration's generator."""
    physics: WorldPhysics = field(default_factory=WorldPhysics)
    instruments: Instruments = field(default_factory=Instruments)
    throws: int = 1
    """Motions per demonstration; throws last about a second, so several form one demonstration."""
    start: Literal["unknown", "resting", "flying"] = "unknown"
    """Recorded estimate of the state at time 0: none; of bodies at rest on a surface, whose height, roll and pitch are
    exact; or of bodies in flight."""

    body: str = ""
    """The body under test: the sliding, falling or grasped object, or the arm's last link."""
    surface: str = ""
    """The geom on which it slides or lands."""
    grippers: tuple[str, ...] = ()
    """Actuators of a gripper."""
    pads: tuple[str, ...] = ()
    """Geoms that touch the grasped object."""
    recorder: Callable[[Sequence[HiddenEffect], int, int], Recording] | None = None
    """Records demonstrations from effects, their number and a seed, for a rig without `plan`."""

    @property
    def slides(self) -> bool:
        """Whether all driven joints are slide joints."""
        m = self.scene.model
        joints = [m.actuator_trnid[a, 0] for a in range(m.nu) if m.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT]
        kinds = {int(m.jnt_type[j]) for j in joints}
        return kinds == {int(mujoco.mjtJoint.mjJNT_SLIDE)}

    @property
    def body_tracked(self) -> bool:
        """Whether the scene has a free body, which is tracked."""
        return int(mujoco.mjtJoint.mjJNT_FREE) in self.scene.model.jnt_type

    def world(self, effects: Sequence[HiddenEffect] = ()) -> mujoco.MjSpec:
        """Return Reality with hidden effects, ready to be compiled."""
        spec = self.scene.spec()
        spec.option.timestep = self.physics.timestep
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        if self.physics.impratio is not None:
            spec.option.impratio = self.physics.impratio
        spec.option.iterations = 100
        spec.option.ls_iterations = 50
        for joint, armature in self.physics.armature.items():
            spec.joint(joint).armature += armature
        if self.physics.edit is not None:
            self.physics.edit(spec)
        for effect in effects:
            if effect.edit is not None:
                effect.edit(spec)
        return spec


@dataclass(frozen=True)
class TrueMotion:
    """The true motion, step by step."""

    time: np.ndarray
    """Times [s], shape (K,)."""
    sensordata: np.ndarray
    """Noise-free sensor readings, shape (K, nsensordata)."""
    qpos: np.ndarray
    """Generalised positions of Reality, shape (K, nq)."""


def record_rig(rig: Rig, effects: Sequence[HiddenEffect] = (), demonstrations: int = 1, seed: int = 0) -> Recording:
    """Return a recording of a rig with hidden effects.

    Args:
        rig: The experiment.
        effects: Hidden effects.
        demonstrations: Number of demonstrations, each of `rig.throws` motions.
        seed: Seed of initial states, commands, clocks and noise. Those of motion k depend on neither later motions
            nor hidden effects.
    """
    if rig.recorder is not None:
        return rig.recorder(effects, demonstrations, seed)
    model = rig.world(effects).compile()
    taken = []
    for k in range(demonstrations * rig.throws):
        rng = np.random.default_rng([seed, k])
        trial = rig.plan(rng, k)
        taken.append(recorded_trial(rig, model, trial, effects, rng, f"demo_{k}"))
    return Recording(rig.scene.xml, tuple(taken), source=f"reality rig {rig.name}")


def recorded_trial(
    rig: Rig,
    model: mujoco.MjModel,
    trial: RigTrial,
    effects: Sequence[HiddenEffect],
    rng: np.random.Generator,
    name: str,
) -> Demonstration:
    """Return what a rig's instruments record of one motion in Reality."""
    motion, qpos, qvel = perform(model, trial, effects, rig.physics)
    estimate = _estimated_start(rig, model, qpos, qvel, rng) if rig.start != "unknown" else (None, None)
    measured = sensor_channels(rig, model, motion, effects, rng)
    action = {name: Channel(time, value) for name, (time, value) in trial.action.items()}
    return Demonstration(name, rig.name, None, *estimate, action=action, measured=measured)


def perform(
    model: mujoco.MjModel, trial: RigTrial, effects: Sequence[HiddenEffect], physics: WorldPhysics
) -> tuple[TrueMotion, np.ndarray, np.ndarray]:
    """Return the true motion of a trial and the state at time 0, qpos (nq,) and qvel (nv,)."""
    data = mujoco.MjData(model)
    _place(model, data.qpos, trial.qpos, model.jnt_qposadr)
    dt = model.opt.timestep
    before = round(trial.settling_time / dt)
    steps = round(trial.duration / dt)
    forces = [f for f in (physics.force, *(effect.force for effect in effects)) if f is not None]
    ctrl = _commands_at(model, trial, np.maximum(np.arange(-before, steps + 1) * dt + physics.lead, 0))
    readings, states = np.empty((steps + 1, model.nsensordata)), np.empty((steps + 1, model.nq))
    qpos, qvel = data.qpos.copy(), data.qvel.copy()
    data.time = -before * dt
    for k in range(before + steps + 1):
        now = (k - before) * dt
        if k == before:
            _place(model, data.qvel, trial.qvel, model.jnt_dofadr)
            qpos, qvel = data.qpos.copy(), data.qvel.copy()
        act = ctrl[k]
        for effect in effects:
            if effect.command is not None:
                act = effect.command(now, act)
        data.ctrl[:] = act
        data.qfrc_applied[:] = 0
        data.xfrc_applied[:] = 0
        for force in forces:
            force(model, data)
        if k >= before:
            states[k - before] = data.qpos
        mujoco.mj_step(model, data)  # sensors are those of the state before the step
        if k >= before:
            readings[k - before] = data.sensordata
    if not np.isfinite(readings).all() or data.warning.number.any():
        raise RuntimeError(f"Reality diverged at {data.time:.3f} s")
    return TrueMotion(np.arange(steps + 1) * dt, readings, states), qpos, qvel


def _commands_at(model: mujoco.MjModel, trial: RigTrial, time: np.ndarray) -> np.ndarray:
    """Return the commands in force at times (K,) [s], shape (K, nu)."""
    ctrl = np.zeros((len(time), model.nu))
    for i in range(model.nu):
        at, value = trial.action[model.actuator(i).name]
        ctrl[:, i] = value[np.maximum(np.searchsorted(at, time + 1e-9, side="right") - 1, 0)]
    return ctrl


def _place(
    model: mujoco.MjModel, state: np.ndarray, values: Mapping[str, Sequence[float]], address: np.ndarray
) -> None:
    """Write values of joints, by name, into a state vector."""
    for name, value in values.items():
        start = address[model.joint(name).id]
        state[start : start + len(value)] = value


def _estimated_start(
    rig: Rig, model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return the recorded initial state, with the error of an estimate: qpos (nq,) and qvel (nv,)."""
    nominal = rig.scene.model
    estimate, rate = nominal.qpos0.copy(), np.zeros(nominal.nv)
    position, orientation, velocity, turning = START_STD
    for j in range(nominal.njnt):
        k = model.joint(nominal.joint(j).name).id
        free = nominal.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE
        nq, nv = (7, 6) if free else (1, 1)
        p, v = nominal.jnt_qposadr[j], nominal.jnt_dofadr[j]
        estimate[p : p + nq] = qpos[model.jnt_qposadr[k] :][:nq]
        rate[v : v + nv] = qvel[model.jnt_dofadr[k] :][:nv]
        if not free:
            hinge = nominal.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE
            estimate[p] += rng.normal(0, rig.instruments.angle.std if hinge else rig.instruments.travel.std)
            continue
        moves = rate[v : v + 6].any()
        flying = rig.start == "flying"
        plane, upright = np.array([1, 1, flying]), np.array([flying, flying, 1])
        estimate[p : p + 3] += plane * rng.normal(0, position, 3)
        mujoco.mju_quatIntegrate(estimate[p + 3 : p + 7], upright * rng.normal(0, orientation, 3), 1.0)
        rate[v : v + 3] += moves * plane * rng.normal(0, velocity, 3)
        rate[v + 3 : v + 6] += moves * upright * rng.normal(0, turning, 3)
    return estimate, rate


def sensor_channels(
    rig: Rig, model: mujoco.MjModel, motion: TrueMotion, effects: Sequence[HiddenEffect], rng: np.random.Generator
) -> dict[str, Channel]:
    """Return the readings of every nominal sensor with noise and hidden effects, by name."""
    nominal = rig.scene.model
    channels = {}
    for i in range(nominal.nsensor):
        name = nominal.sensor(i).name
        sensor = model.sensor(name).id
        address, dim = model.sensor_adr[sensor], model.sensor_dim[sensor]
        quaternion = model.sensor_type[sensor] == mujoco.mjtSensor.mjSENS_FRAMEQUAT
        truth = motion.sensordata[:, address : address + dim]
        channel = instrument_reading(rig.instruments.of(model, sensor), motion.time, truth, rng, quaternion=quaternion)
        for effect in effects:
            if effect.measure is not None:
                time, value = effect.measure(name, channel.time, channel.value)
                channel = replace(channel, time=time, value=value)
        channels[name] = channel
    return channels
