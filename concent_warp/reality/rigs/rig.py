"""A rig: a small experiment in the stand-in world, and how it is run and written down.

A rig has the drawing that its user's model is made from, the world that stands in for the real one, and the motions
that are asked for. What is recorded is what instruments read, never the truth; the start of a motion too is told only
as well as one can tell it from the first readings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import mujoco
import numpy as np

from concent_warp.reality.sensors.instruments import Instruments, read
from concent_warp.reality.world import HiddenEffect
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

START_STD = (1e-4, 1e-3, 2e-3, 1e-2)
"""How well the start of a moving body is told: position [m], orientation [rad], velocity [m/s], turning [rad/s]."""


@dataclass(frozen=True)
class RigTrial:
    """What is done in one demonstration."""

    duration: float
    """[s]."""
    action: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    """Commands by actuator: times [s] and values, shapes (T,); each held until the next."""
    qpos: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """Positions at time 0 by joint, where they are not those of the drawing."""
    qvel: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """Velocities at time 0 by joint; they are given after settling."""
    settle: float = 0.0
    """How long everything is left to come to rest under the first command before time 0 [s]."""


@dataclass(frozen=True)
class WorldPhysics:
    """How the world of a rig differs from the drawing, nothing hidden."""

    timestep: float = 0.0005
    """Step [s]."""
    impratio: float | None = None
    """Stiffness of the friction against that of the normal force [-]; None for the drawing's."""
    lead: float = 0.0
    """By how much commands act earlier than told [s], see `of_coarser_step`."""
    armature: Mapping[str, float] = field(default_factory=dict)
    """Inertia added to driven joints [kg m^2 or kg], see `of_coarser_step`."""
    edit: Callable[[mujoco.MjSpec], None] | None = None
    """Anything else, such as exact convex shapes."""
    force: Callable[[mujoco.MjModel, mujoco.MjData], None] | None = None
    """Forces by laws of the world's own, as in `HiddenEffect`."""


def of_coarser_step(scene: Scene, **rest: Any) -> WorldPhysics:
    """Return the physics of a world with a third of a drawing's step, in which the numbers of the drawing hold.

    The drawing's numbers are those with which its own steps come true. Steps of dt hold a command dt/2 too early (they
    act at the step's beginning, as if in its middle) and take a drive's damping kv at its end, which counts as inertia
    of kv dt/2. The finer world makes up for the difference, or null data would show the drawing's time step. With a
    third of the step that is one step of the world, so that it takes no rounding.
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
    """The drawing: plain MJCF with the sensors that are recorded."""
    plan: Callable[[np.random.Generator, int], RigTrial]
    """Returns the k-th motion; the source of chance is that of the demonstration."""
    physics: WorldPhysics = field(default_factory=WorldPhysics)
    instruments: Instruments = field(default_factory=Instruments)
    throws: int = 1
    """Motions that make one demonstration: a throw is over in a second, so several belong together."""
    start: Literal["untold", "resting", "flying"] = "untold"
    """What the recording tells of the state at time 0, as estimated from the first readings: nothing; the state of
    bodies that stand on something, so that height, roll and pitch are those of standing; or of bodies in flight."""

    body: str = ""
    """The body under test: what slides, falls or is held, or the arm's last link."""
    surface: str = ""
    """The geom on which it slides or lands."""
    grippers: tuple[str, ...] = ()
    """Actuators that hold something."""
    pads: tuple[str, ...] = ()
    """Geoms that they hold it with."""
    recorder: Callable[[Sequence[HiddenEffect], int, int], Recording] | None = None
    """Records effects, so many demonstrations, from a seed, where the experiment is not one of trials."""

    @property
    def slides(self) -> bool:
        """Whether it is slides that are driven, not hinges."""
        m = self.scene.model
        joints = [m.actuator_trnid[a, 0] for a in range(m.nu) if m.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT]
        kinds = {int(m.jnt_type[j]) for j in joints}
        return kinds == {int(mujoco.mjtJoint.mjJNT_SLIDE)}

    @property
    def body_tracked(self) -> bool:
        """Whether the body under test is loose, and the tracker follows it."""
        return int(mujoco.mjtJoint.mjJNT_FREE) in self.scene.model.jnt_type

    def world(self, effects: Sequence[HiddenEffect] = ()) -> mujoco.MjSpec:
        """Return the world, hidden effects included, ready to be compiled."""
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
    """What truly happened, step by step."""

    time: np.ndarray
    """[s], shape (K,)."""
    sensordata: np.ndarray
    """What perfect sensors read, shape (K, nsensordata)."""


def record_rig(rig: Rig, effects: Sequence[HiddenEffect] = (), demonstrations: int = 1, seed: int = 0) -> Recording:
    """Let a rig's experiment happen, with effects hidden in it, and return what was written down.

    Args:
        rig: The experiment.
        effects: What the drawing does not know of.
        demonstrations: How often; each is a set of `rig.throws` motions, recorded one by one.
        seed: All chance: starts, commands, clocks, noise. Motion k is the same whatever follows it, and the same with
            and without hidden effects, but for what these do.
    """
    if rig.recorder is not None:
        return rig.recorder(effects, demonstrations, seed)
    model = rig.world(effects).compile()
    taken = []
    for k in range(demonstrations * rig.throws):
        rng = np.random.default_rng([seed, k])
        trial = rig.plan(rng, k)
        motion, qpos, qvel = perform(model, trial, effects, rig.physics)
        told = _estimated_start(rig, model, qpos, qvel, rng) if rig.start != "untold" else (None, None)
        measured = _write_down(rig, model, motion, effects, rng)
        action = {name: Channel(time, value) for name, (time, value) in trial.action.items()}
        taken.append(Demonstration(f"demo_{k}", rig.name, None, *told, action=action, measured=measured))
    return Recording(rig.scene.xml, tuple(taken), source=f"reality rig {rig.name}")


def perform(
    model: mujoco.MjModel, trial: RigTrial, effects: Sequence[HiddenEffect], physics: WorldPhysics
) -> tuple[TrueMotion, np.ndarray, np.ndarray]:
    """Step the world through a trial; return it with the state at time 0, qpos (nq,) and qvel (nv,)."""
    data = mujoco.MjData(model)
    _place(model, data.qpos, trial.qpos, model.jnt_qposadr)
    dt = model.opt.timestep
    before = round(trial.settle / dt)
    steps = round(trial.duration / dt)
    forces = [f for f in (physics.force, *(effect.force for effect in effects)) if f is not None]
    ctrl = _held_commands(model, trial, np.maximum(np.arange(-before, steps + 1) * dt + physics.lead, 0))
    readings = np.empty((steps + 1, model.nsensordata))
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
        mujoco.mj_step(model, data)  # sensors are those of the state before the step
        if k >= before:
            readings[k - before] = data.sensordata
    if not np.isfinite(readings).all() or data.warning.number.any():
        raise RuntimeError(f"the stand-in world diverged at {data.time:.3f} s")
    return TrueMotion(np.arange(steps + 1) * dt, readings), qpos, qvel


def _held_commands(model: mujoco.MjModel, trial: RigTrial, time: np.ndarray) -> np.ndarray:
    """Return the commands that hold at times (K,) [s], shape (K, nu)."""
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
    """Return the start as told: qpos (nq,), qvel (nv,) of the drawing, with the error of an estimate."""
    drawn = rig.scene.model
    told, rate = drawn.qpos0.copy(), np.zeros(drawn.nv)
    position, orientation, velocity, turning = START_STD
    for j in range(drawn.njnt):
        k = model.joint(drawn.joint(j).name).id
        free = drawn.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE
        nq, nv = (7, 6) if free else (1, 1)
        p, v = drawn.jnt_qposadr[j], drawn.jnt_dofadr[j]
        told[p : p + nq] = qpos[model.jnt_qposadr[k] :][:nq]
        rate[v : v + nv] = qvel[model.jnt_dofadr[k] :][:nv]
        if not free:
            hinge = drawn.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE
            told[p] += rng.normal(0, rig.instruments.angle.std if hinge else rig.instruments.travel.std)
            continue
        moves = rate[v : v + 6].any()
        flying = rig.start == "flying"
        plane, upright = np.array([1, 1, flying]), np.array([flying, flying, 1])
        told[p : p + 3] += plane * rng.normal(0, position, 3)
        mujoco.mju_quatIntegrate(told[p + 3 : p + 7], upright * rng.normal(0, orientation, 3), 1.0)
        rate[v : v + 3] += moves * plane * rng.normal(0, velocity, 3)
        rate[v + 3 : v + 6] += moves * upright * rng.normal(0, turning, 3)
    return told, rate


def _write_down(
    rig: Rig, model: mujoco.MjModel, motion: TrueMotion, effects: Sequence[HiddenEffect], rng: np.random.Generator
) -> dict[str, Channel]:
    """Return the readings of every sensor of the drawing, distorted as hidden effects have it."""
    drawn = rig.scene.model
    channels = {}
    for i in range(drawn.nsensor):
        name = drawn.sensor(i).name
        sensor = model.sensor(name).id
        address, dim = model.sensor_adr[sensor], model.sensor_dim[sensor]
        quaternion = model.sensor_type[sensor] == mujoco.mjtSensor.mjSENS_FRAMEQUAT
        truth = motion.sensordata[:, address : address + dim]
        channel = read(rig.instruments.of(model, sensor), motion.time, truth, rng, quaternion=quaternion)
        for effect in effects:
            if effect.measure is not None:
                time, value = effect.measure(name, channel.time, channel.value)
                channel = replace(channel, time=time, value=value)
        channels[name] = channel
    return channels
