"""Recordings of the world on MuJoCo."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.independent.data_set import Data, DataSet, Truth
from benchmarks.independent.instruments import Instrument, Instruments
from benchmarks.independent.lugre import Level, bristles, constant
from benchmarks.independent.mujoco_effects import Cause, causes_of
from benchmarks.independent.mujoco_rigs import EXPERIMENTS, STEP, Experiment, draw_tolerances
from benchmarks.independent.plane_contact import PlaneContact
from concent_warp.reality.expert.plan import ExpertCfg
from concent_warp.reality.record import RealityCfg, record
from concent_warp.reality.rigs.insertion import TASK
from concent_warp.reality.rigs.rig import WorldPhysics, perform
from concent_warp.reality.sensors.sensing import SensingCfg
from concent_warp.reality.world import HiddenEffect, WorldCfg
from concent_warp.recording.recording import Channel, Demonstration, Recording

SENSOR = mujoco.mjtSensor
HEAD = 0.02
"""Time from a launch to the first sample [s]: bodies move when the recording begins."""
TAIL = {"drop": 0.4}
"""Time by which trials of a rig are shorter than planned [s]."""
START_STD = (2e-4, 2e-3, 5e-3, 3e-2)
"""Standard deviations of the errors of a recorded initial state: position [m], orientation [rad], velocity [m/s],
angular velocity [rad/s]."""
VIDEO = ("drop", "tumble")
"""Rigs whose throws are tracked in a large volume."""
OTHER_MOTIONS = 50_000
"""Added to the seed of the motions of held-out recordings."""
PERFECT = SensingCfg(
    encoder_std=1e-12, encoder_rate=0.5 / STEP, position_std=1e-12, orientation_std=1e-12, pose_rate=0.5 / STEP,
    point_rate=5.0, point_count=16, tracking_std=5e-5,
)  # fmt: skip
"""Instruments of the scripted expert's recordings: readings of every step, to be read again by `Instruments`."""


def make_mujoco(case: DataSet) -> Data:
    """Return the recordings of a data set; the same each time."""
    experiment = EXPERIMENTS[case.rig]
    causes = causes_of(experiment, case)
    recording = _record(experiment, causes, case, case.demonstrations, case.seed)
    held_out = _record(experiment, causes, case, 1, case.seed + OTHER_MOTIONS)
    if not case.noise_stated:
        recording = _without_noise(recording)
    truth = tuple(Truth(c.name, dict(c.parameters), c.target, c.known) for c in causes)
    return Data(recording, held_out, experiment.rig.scene, truth)


def _without_noise(recording: Recording) -> Recording:
    """Return a recording whose noise is not stated."""
    return replace(
        recording,
        demonstrations=tuple(
            replace(d, measured={name: replace(c, noise_std=None) for name, c in d.measured.items()})
            for d in recording.demonstrations
        ),
    )


def _record(
    experiment: Experiment, causes: Sequence[Cause], case: DataSet, demonstrations: int, seed: int
) -> Recording:
    """Return a recording with motions of a seed in the world of a data set."""
    rig = experiment.rig
    instruments = Instruments.of(case.seed, video=case.rig in VIDEO)
    effects = [c.effect for c in causes]
    if rig.recorder is not None:
        return _inserted(experiment, effects, instruments, case, demonstrations, seed)
    contact = experiment.contact
    for cause in causes:
        if cause.contact is not None and contact is not None:
            contact = cause.contact(contact)
    edits = [e.edit for e in effects if e.edit is not None]
    model = experiment.world(case.seed, contact, edits).compile()
    physics = WorldPhysics(timestep=STEP, force=_forces(experiment, contact, causes))
    begin = HEAD if experiment.launched else 0.0
    taken = []
    for k in range(demonstrations * rig.throws):
        rng = np.random.default_rng([seed, k, 5])
        trial = rig.plan(rng, k)
        trial = replace(trial, duration=trial.duration + begin - TAIL.get(rig.name, 0.0))
        motion, qpos, _ = perform(model, trial, effects, physics)
        motion = replace(motion, time=motion.time - begin)
        seen = signals(rig.scene.model, model, motion.sensordata)
        start = (None, None)
        if rig.start != "unknown":
            start = _estimated_start(experiment, motion.time + instruments.position.latency, seen, qpos, effects, rng)
        for cause in causes:
            if cause.observe is not None:
                seen = {name: cause.observe(name, motion.time, signal) for name, signal in seen.items()}
        measured = {
            name: instrument_of(instruments, model, name).read(motion.time, signal, rng)
            for name, signal in seen.items()
        }
        action = {name: Channel(time, value) for name, (time, value) in trial.action.items()}
        demonstration = Demonstration(f"demo_{k}", rig.name, None, *start, action=action, measured=measured)
        taken.append(_misread(demonstration, effects))
    return Recording(rig.scene.xml, tuple(taken), source=f"world on MuJoCo, {rig.name}")


def _misread(demonstration: Demonstration, effects: Sequence[HiddenEffect]) -> Demonstration:
    """Return a demonstration as hidden effects of the measurement change it."""
    measured = dict(demonstration.measured)
    for effect in effects:
        if effect.measure is not None:
            for name, channel in measured.items():
                gone = np.asarray(np.isnan(channel.value).any(axis=1))
                value = channel.value.copy()
                value[gone] = [1.0, 0, 0, 0] if value.shape[1] == 4 else 0.0
                time, value = effect.measure(name, channel.time, value)
                value = np.where(gone[:, None], np.nan, value)
                measured[name] = replace(channel, time=time, value=value)
    return replace(demonstration, measured=measured)


def signals(nominal: mujoco.MjModel, model: mujoco.MjModel, sensordata: np.ndarray) -> dict[str, np.ndarray]:
    """Return what there is to see of every nominal sensor at each step, shapes (K, dim)."""
    found = {}
    for i in range(nominal.nsensor):
        name = nominal.sensor(i).name
        k = model.sensor(name).id
        found[name] = sensordata[:, model.sensor_adr[k] :][:, : model.sensor_dim[k]]
    return found


def instrument_of(instruments: Instruments, model: mujoco.MjModel, sensor: str) -> Instrument:
    """Return the instrument that reads a sensor of the world."""
    i = model.sensor(sensor).id
    kind, target = SENSOR(int(model.sensor_type[i])), int(model.sensor_objid[i])
    if kind == SENSOR.mjSENS_FRAMEPOS:
        return instruments.position
    if kind == SENSOR.mjSENS_FRAMEQUAT:
        return instruments.orientation
    if kind == SENSOR.mjSENS_JOINTPOS and model.jnt_type[target] == mujoco.mjtJoint.mjJNT_HINGE:
        return instruments.fine_angle if model.njnt > 2 else instruments.angle
    if kind in (SENSOR.mjSENS_JOINTPOS, SENSOR.mjSENS_TENDONPOS):
        return instruments.travel
    raise ValueError(f"no instrument reads sensor {sensor!r} of type {kind.name}")


def _forces(
    experiment: Experiment, contact: PlaneContact | None, causes: Sequence[Cause]
) -> Callable[[mujoco.MjModel, mujoco.MjData], None]:
    """Return the force hook of contact with the plane and of joint friction, the nominal and the hidden one."""
    m = experiment.rig.scene.model
    levels: dict[str, list[Level]] = {}
    for j in range(m.njnt):
        nominal = float(m.dof_frictionloss[m.jnt_dofadr[j]])
        more = [c.levels[m.joint(j).name] for c in causes if m.joint(j).name in c.levels]
        if nominal or more:
            levels[m.joint(j).name] = [constant(nominal), *more]
    rub = bristles(levels)
    touch = None if contact is None else contact.force(experiment.rig.body)

    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        rub(model, data)
        if touch is not None:
            touch(model, data)

    return force


def _estimated_start(
    experiment: Experiment,
    stamp: np.ndarray,
    seen: dict[str, np.ndarray],
    qpos: np.ndarray,
    effects: Sequence[HiddenEffect],
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the recorded initial state with the errors of an estimate: qpos (nq,) and qvel (nv,).

    Free bodies are where the tracker shows them at time 0; launched ones have velocities over 4 ms, others rest. What
    lies on a surface has the height, roll and pitch of the nominal geometry. Joints are where they are.

    Args:
        experiment: The experiment.
        stamp: The tracker's time stamps of all steps [s], shape (K,).
        seen: Signals by sensor, shapes (K, dim).
        qpos: Positions of the world at time 0, whose first ones are the nominal scene's.
        effects: Hidden effects, some of the measurement.
        rng: Source of the errors.
    """
    rig, nominal = experiment.rig, experiment.rig.scene.model
    estimate, rate = nominal.qpos0.copy(), np.zeros(nominal.nv)
    position, orientation, velocity, turning = START_STD
    box = nominal.geom_type[nominal.body_geomadr[nominal.body(rig.body).id]] == mujoco.mjtGeom.mjGEOM_BOX
    lies = np.array([0, 0, 1]) if rig.start == "resting" else np.zeros(3)
    for j in range(nominal.njnt):
        p, v = nominal.jnt_qposadr[j], nominal.jnt_dofadr[j]
        if nominal.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE:
            estimate[p] = qpos[p] + rng.normal(0, 2e-4)
            continue
        place, turn = tracked(rig.body, stamp, seen, effects)
        span = 0.002
        pose = np.concatenate([place(0.0), turn(0.0)])
        if experiment.launched:
            before, after = Rotation.from_quat([turn(-span), turn(span)], scalar_first=True)
            rate[v : v + 3] = (place(span) - place(-span)) / (2 * span) + rng.normal(0, velocity, 3)
            rate[v + 3 : v + 6] = (before.inv() * after).as_rotvec() / (2 * span) + rng.normal(0, turning, 3)
            rate[v : v + 3] *= 1 - lies
            if lies.any() and box:
                rate[v + 3 : v + 5] = 0.0
        pose[:3] += rng.normal(0, position, 3)
        pose[:3] = np.where(lies, nominal.qpos0[p : p + 3], pose[:3])
        if lies.any():  # about the vertical only
            w, _, _, z = pose[3:]
            pose[3:] = np.array([w, 0, 0, z]) / np.hypot(w, z)
            if not box:
                pose[3:] = turn(0.0)
        mujoco.mju_quatIntegrate(pose[3:], np.where(lies.any(), lies, 1.0) * rng.normal(0, orientation, 3), 1.0)
        estimate[p : p + 7] = pose
    return estimate, rate


def tracked(
    body: str, stamp: np.ndarray, seen: dict[str, np.ndarray], effects: Sequence[HiddenEffect]
) -> tuple[Callable[[float], np.ndarray], Callable[[float], np.ndarray]]:
    """Return position (3,) [m] and orientation (4,) of a body that a tracker shows without noise at a time [s]."""
    found = []
    for name in (f"{body}_position", f"{body}_orientation"):
        near = slice(0, int(np.searchsorted(stamp, 0.15)))
        time, value = stamp[near], seen[name][near]
        for effect in effects:
            if effect.measure is not None:
                time, value = effect.measure(name, time, value)
        found.append((time, value))
    (t, x), (s, q) = found

    def place(at: float) -> np.ndarray:
        return np.array([np.interp(at, t, column) for column in x.T])

    def turn(at: float) -> np.ndarray:
        value = np.array([np.interp(at, s, column) for column in q.T])
        return value / np.linalg.norm(value)

    return place, turn


def _inserted(
    experiment: Experiment,
    effects: Sequence[HiddenEffect],
    instruments: Instruments,
    case: DataSet,
    demonstrations: int,
    seed: int,
) -> Recording:
    """Return a recording of the scripted expert."""

    def tolerances(spec: mujoco.MjSpec) -> None:
        draw_tolerances(spec, case.seed)
        experiment.edit(spec)

    cfg = RealityCfg(
        task=TASK,
        expert=ExpertCfg(speed=0.7),
        world=WorldCfg(timestep=2 * STEP, solref=(0.004, 1.1), chamfer=0.001),
        sensing=PERFECT,
    )
    seeds = [(1000 * seed + k) % 2**31 for k in range(demonstrations)]
    unread = [replace(e, measure=None) for e in effects]
    recording, _ = record(cfg, seeds, effects=(HiddenEffect("tolerances", edit=tolerances), *unread))
    model = experiment.rig.scene.model
    taken = []
    for k, d in enumerate(recording.demonstrations):
        rng = np.random.default_rng([seed, k, 5])
        measured = {
            name: instrument_of(instruments, model, name).read(channel.time, channel.value, rng)
            for name, channel in d.measured.items()
        }
        taken.append(_misread(replace(d, measured=measured, points={}, success=None), effects))
    return Recording(experiment.rig.scene.xml, tuple(taken), source="world on MuJoCo, insertion")
