"""The world on Drake: bodies and contacts by `MultibodyPlant`, drives, gears and hidden forces step by step.

Drake's MJCF parser reads bodies, joints, masses and inertias of the text with the world's values. It drops friction
losses, sites, sensors, time step and solver parameters, and turns position actuators into implicit controllers; so
actuators and sensors are removed before, and what they stand for is done here:

- Drives are sampled at 1 kHz, their torque is held in between. Rotors are Drake's reflected inertia; with play or a
  spring in the gear, a motor-side body on a joint of its own.
- Coulomb friction of joints is LuGre friction [Canudas de Wit et al., IEEE Trans. Automat. Control 40(3), 1995].
- Blocks stand on four small feet, so that their support is known. Feet and balls touch the table at points, the finger
  pushes a block by hydroelastic contact [Elandt et al., IROS 2019], all with the SAP solver [Castro, Permenter, Han,
  IEEE Trans. Robot. 39(2), 2023]. Friction and normal force are lagged [Castro et al., arXiv 2312.03908], for a sliding
  block glides above the table in the convex approximation. The bouncing ball uses that one: its contact is then a
  linear spring and damper. Implicit integration adds sqrt(k / m) dt / 2 to its damping ratio; the damper has so much
  less.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any
from xml.etree import ElementTree

import numpy as np

from benchmarks.independent.foreign.drives import (
    CONTROL_PERIOD,
    GEAR_DAMPING,
    RECORD_PERIOD,
    Bristle,
    setpoints,
)
from benchmarks.independent.foreign.rig import (
    ENCODERS,
    BodyState,
    Drive,
    DriveState,
    ForeignMotion,
    ForeignRig,
    ForeignTrial,
    Physics,
)

try:
    drake: Any = import_module("pydrake.all")  # Any, for its stubs declare arrays otherwise than NumPy
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("the world on Drake needs the extra: pip install 'concent-warp[benchmarks]'") from error

GEAR_RATIO = 50.0
"""Rotor turns per turn of a joint [-]."""
PLAY_STIFFNESS = 200.0
"""Stiffness of teeth at either end of the play [N m/rad]."""
MODULUS = 1e7
"""Hydroelastic modulus of blocks [Pa]."""
DISSIPATION = 5.0
"""Dissipation of contacts after Hunt and Crossley, but for the bouncing ball's [s/m]."""
FOOT = 1e-3
"""Radius of a block's feet [m]."""
FOOT_STIFFNESS = 1e6
"""Stiffness of each [N/m]."""
ROLLING_STIFFNESS = 1e5
"""Stiffness of a ball that does not bounce [N/m]."""
SLOSH_FREQUENCY = 2.0
"""Frequency of mass that swings in a body [Hz]."""
SLOSH_PLACE = 0.02
"""Where that mass rests, along the body's x [m]."""


@dataclass
class _Axis:
    """A driven joint in the simulation."""

    drive: Drive
    state: DriveState
    kp: float
    kv: float
    setpoint: np.ndarray
    """Command after delay and lag, by control period."""
    q: int
    v: int
    motor_q: int
    motor_v: int
    stiffness: float = 0.0
    """Of the gear; 0 where motor and link move as one."""
    gear_damping: float = 0.0
    torque: float = 0.0
    """Torque that is held [N m or N]."""


@dataclass
class _World:
    plant: Any
    simulator: Any
    context: Any
    motor_joints: dict[str, Any] = field(default_factory=dict)


def simulate(rig: ForeignRig, physics: Physics, trial: ForeignTrial) -> ForeignMotion:
    """Return the true motion of a trial.

    Raises:
        RuntimeError: The simulation diverged.
    """
    world = build(rig, physics)
    plant, context = world.plant, world.context
    _place(rig, physics, trial, plant, context)
    dt = rig.step
    before = round(trial.before / dt)
    steps = before + round(trial.duration / dt)
    axes = [_axis(rig, physics, trial, d, world, before + steps) for d in rig.drives]
    frictions = [(_dof(plant, joint), Bristle(f, dt)) for joint, f in physics.friction.items()]
    forces = [(_dof(plant, joint), fs) for joint, fs in physics.joint_forces.items()]
    body = plant.GetBodyByName(rig.body)
    reference = plant.CreateDefaultContext() if physics.compensation else None
    port = plant.get_applied_generalized_force_input_port()
    nq, nv = plant.num_positions(), plant.num_velocities()
    seen = sorted({s.target for s in rig.sensors if s.kind not in ENCODERS})
    bodies = [plant.GetBodyByName(name) for name in seen]
    every, control = max(1, round(RECORD_PERIOD / dt)), max(1, round(CONTROL_PERIOD / dt))
    times, states, poses = [], [], []
    compensation, acting = np.zeros(nv), np.full(nv, np.nan)
    for k in range(steps + 1):
        now = (k - before) * dt
        state = plant.GetPositionsAndVelocities(context)
        q, v = state[:nq], state[nq:]
        if k % every == 0:
            times.append(now)
            states.append(state)
            poses.append([_pose(plant.EvalBodyPoseInWorld(context, b)) for b in bodies])
        if k == steps:
            break
        if k % control == 0:
            for a in axes:
                error = a.setpoint[k // control] - (q[a.motor_q] - a.state.offset)
                torque = a.state.gain * (a.kp * error - a.kv * v[a.motor_v])
                a.torque = min(max(torque, -a.state.limit), a.state.limit)
            if reference is not None:
                plant.SetPositions(reference, q)
                compensation = -physics.compensation * plant.CalcGravityGeneralizedForces(reference)
        tau = compensation.copy()
        for a in axes:
            tau[a.motor_v] += a.torque
            if a.stiffness:
                twist = q[a.motor_q] - q[a.q]
                over = twist - min(max(twist, -a.state.play / 2), a.state.play / 2)
                gear = a.stiffness * over + (
                    a.gear_damping * (v[a.motor_v] - v[a.v]) if over or not a.state.play else 0
                )
                tau[a.v] += gear
                tau[a.motor_v] -= gear
        for (_, dof), bristle in frictions:
            tau[dof] -= bristle.force(now, v[dof])
        for (position, dof), functions in forces:
            tau[dof] += sum(function(now, q[position], v[dof]) for function in functions)
        if physics.body_forces:
            _push(physics, plant, context, body, now, v, tau)
        if not np.array_equal(tau, acting):
            port.FixValue(context, tau)
            acting = tau
        world.simulator.AdvanceTo((k + 1) * dt)
    motion = np.array(states)
    if not np.isfinite(motion).all() or np.abs(motion).max() > 1e4:
        raise RuntimeError(f"the world on Drake diverged in {rig.name}")
    joints = {d.joint: motion[:, a.q] for d, a in zip(rig.drives, axes, strict=True)}
    motors = {d.joint: motion[:, a.motor_q] for d, a in zip(rig.drives, axes, strict=True)}
    stacked = np.array(poses)
    return ForeignMotion(np.array(times), joints, motors, {name: stacked[:, i] for i, name in enumerate(seen)})


def build(rig: ForeignRig, physics: Physics) -> _World:
    """Return the world of a rig, its masses set, at the initial pose of the MJCF."""
    logging.getLogger("drake").setLevel(logging.ERROR)
    builder = drake.DiagramBuilder()
    config = drake.MultibodyPlantConfig(time_step=0.0 if rig.continuous else rig.step)
    plant, scene = drake.AddMultibodyPlant(config, builder)
    if not rig.continuous:
        approximation = (
            drake.DiscreteContactApproximation.kSap if rig.bounces else drake.DiscreteContactApproximation.kLagged
        )
        plant.set_discrete_contact_approximation(approximation)
        plant.set_contact_model(drake.ContactModel.kHydroelasticWithFallback)
    del scene
    drake.Parser(plant).AddModelsFromString(_stripped(rig.text.format(**physics.values)), ".xml")
    for joint, damping in physics.damping.items():
        plant.GetJointByName(joint).set_default_damping(damping)
    motors = {}
    for drive in rig.drives:
        state = physics.drives[drive.actuator]
        joint = plant.GetJointByName(drive.joint)
        if state.play or state.compliance:
            motors[drive.joint] = _motor(plant, joint, state.armature)
        else:
            actuator = plant.AddJointActuator(drive.actuator, joint)
            actuator.set_default_rotor_inertia(state.armature / GEAR_RATIO**2)
            actuator.set_default_gear_ratio(GEAR_RATIO)
    if physics.slosh:
        _add_slosh(rig, physics, plant)
    if rig.shape != "none":
        _add_contacts(rig, physics, plant)
    plant.mutable_gravity_field().set_gravity_vector(physics.gravity)
    plant.Finalize()
    diagram = builder.Build()
    simulator = drake.Simulator(diagram)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    if plant.num_actuators():
        plant.get_actuation_input_port().FixValue(context, np.zeros(plant.num_actuators()))
    if rig.continuous:
        simulator.get_mutable_integrator().set_target_accuracy(1e-7)
    _weigh(rig, physics, plant, context)
    return _World(plant, simulator, context, motors)


def _stripped(text: str) -> str:
    """Return MJCF without what Drake's parser drops or would take otherwise, and without collisions."""
    root = ElementTree.fromstring(text)
    for tag in ("actuator", "sensor", "option", "default"):
        for element in root.findall(tag):
            root.remove(element)
    for geom in root.iter("geom"):
        geom.set("contype", "0")
        geom.set("conaffinity", "0")
        geom.attrib.pop("friction", None)
    for parent in root.iter():
        for site in parent.findall("site"):
            parent.remove(site)
    for joint in root.iter("joint"):
        for name in ("frictionloss", "armature", "damping"):
            joint.attrib.pop(name, None)
    return ElementTree.tostring(root, encoding="unicode")


def _motor(plant: Any, joint: Any, armature: float) -> Any:
    """Add the motor's side of a gear: a body on a joint beside the link's, with the reflected inertia of the rotor."""
    axis = joint.revolute_axis()
    inertia = drake.SpatialInertia(1e-6, np.zeros(3), drake.UnitInertia.SolidSphere(np.sqrt(2.5 * armature / 1e-6)))
    body = plant.AddRigidBody(f"{joint.name()}_motor", joint.child_body().model_instance(), inertia)
    return plant.AddJoint(
        drake.RevoluteJoint(f"{joint.name()}_motor", joint.frame_on_parent(), body.body_frame(), axis, 0.0)
    )


def _add_slosh(rig: ForeignRig, physics: Physics, plant: Any) -> None:
    """Add a mass that swings on springs along the body's x and y."""
    body = plant.GetBodyByName(rig.body)
    part = physics.slosh * body.default_mass()
    stiffness = part * (2 * np.pi * SLOSH_FREQUENCY) ** 2
    frame = body.body_frame()
    for name, axis, mass in (("slosh_x", [1.0, 0, 0], 1e-4 * part), ("slosh_y", [0, 1.0, 0], part)):
        inner = plant.AddRigidBody(
            name, body.model_instance(), drake.SpatialInertia(mass, np.zeros(3), drake.UnitInertia.SolidSphere(1e-3))
        )
        damping = 0.1 * np.sqrt(stiffness * part)
        joint = plant.AddJoint(drake.PrismaticJoint(name, frame, inner.body_frame(), axis, damping=damping))
        rest = SLOSH_PLACE * axis[0]
        joint.set_default_translation(rest)
        plant.AddForceElement(drake.PrismaticSpring(joint, rest, stiffness))
        frame = inner.body_frame()


def _add_contacts(rig: ForeignRig, physics: Physics, plant: Any) -> None:
    """Add table, body and finger as they touch each other."""
    v, size = physics.values, physics.size
    table = _material(v["friction"] / (2 - v["friction"]))  # with a body of coefficient 1, Drake's mean is `friction`
    plant.RegisterCollisionGeometry(
        plant.world_body(), drake.RigidTransform(), drake.HalfSpace(), "table_contact", table
    )
    body = plant.GetBodyByName(rig.body)
    if rig.shape == "ball":
        stiffness = v.get("stiffness", ROLLING_STIFFNESS)
        frequency = np.sqrt(stiffness / (physics.mass * v["mass"]))
        ratio = v["damping_ratio"] - 0.5 * frequency * rig.step if rig.bounces else 1.0
        ball = _material(1.0, stiffness, 2 * ratio / frequency)
        plant.RegisterCollisionGeometry(
            body, drake.RigidTransform(), drake.Sphere(size * v["radius"]), "ball_contact", ball
        )
        return
    block = _material(1.0)
    x, y, z = size * np.array([v["half_x"], v["half_y"], v["half_z"]]) - FOOT
    for i, (a, b) in enumerate(((-x, -y), (-x, y), (x, -y), (x, y))):
        foot = _material(1.0, FOOT_STIFFNESS)
        plant.RegisterCollisionGeometry(body, drake.RigidTransform([a, b, -z]), drake.Sphere(FOOT), f"foot_{i}", foot)
    if rig.finger:
        pad = _material(v["pad"] / (2 - v["pad"]))
        drake.AddRigidHydroelasticProperties(0.001, pad)
        drake.AddCompliantHydroelasticProperties(0.2, MODULUS, block)
        box = drake.Box(2 * (x + FOOT), 2 * (y + FOOT), 2 * z)  # does not reach the table
        plant.RegisterCollisionGeometry(body, drake.RigidTransform(), box, "block_contact", block)
        shape = drake.Cylinder(v["finger_radius"], 2 * v["finger_length"])
        plant.RegisterCollisionGeometry(
            plant.GetBodyByName(rig.finger), drake.RigidTransform(), shape, "finger_contact", pad
        )


def _material(friction: float, stiffness: float = 1e12, relaxation: float = 0.0) -> Any:
    """Return properties of a surface: coefficient [-], stiffness at a point [N/m], time over which it relaxes [s]."""
    properties = drake.ProximityProperties()
    drake.AddContactMaterial(
        dissipation=DISSIPATION,
        point_stiffness=stiffness,
        friction=drake.CoulombFriction(friction, friction),
        properties=properties,
    )
    properties.AddProperty("material", "relaxation_time", relaxation)
    return properties


def _weigh(rig: ForeignRig, physics: Physics, plant: Any, context: Any) -> None:
    """Set mass, centre of mass and inertia of the body under test."""
    body = plant.GetBodyByName(rig.body)
    nominal = body.default_spatial_inertia()
    center = nominal.get_com()
    central = nominal.Shift(center).CalcRotationalInertia().CopyToFullMatrix3() * physics.mass * physics.inertia
    mass = nominal.get_mass() * physics.mass * (1 - physics.slosh)
    i = drake.RotationalInertia(
        central[0, 0], central[1, 1], central[2, 2], central[0, 1], central[0, 2], central[1, 2]
    )
    shifted = drake.SpatialInertia.MakeFromCentralInertia(mass, center + physics.center, i)
    body.SetSpatialInertiaInBodyFrame(context, shifted)


def _place(rig: ForeignRig, physics: Physics, trial: ForeignTrial, plant: Any, context: Any) -> None:
    """Set the state in which the simulation begins: drives at their first command, the free body as the trial says."""
    q, v = plant.GetPositions(context), plant.GetVelocities(context)
    for drive in rig.drives:
        first = trial.action[drive.actuator][1][0] + physics.drives[drive.actuator].offset
        for name in (drive.joint, f"{drive.joint}_motor"):
            if plant.HasJointNamed(name):
                q[plant.GetJointByName(name).position_start()] = first
    if rig.free:
        body = plant.GetBodyByName(rig.body)
        pose, velocity = np.array(trial.pose, float), np.array(trial.velocity or np.zeros(6), float)
        if rig.shape != "none" and not rig.bounces:
            pose[2] = physics.size * physics.values["half_z" if rig.shape == "box" else "radius"]
        start = body.floating_positions_start()
        q[start : start + 7] = [*pose[3:], *pose[:3]]
        start = body.floating_velocities_start_in_v()
        v[start : start + 6] = [*velocity[3:], *velocity[:3]]
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)


def _axis(rig: ForeignRig, physics: Physics, trial: ForeignTrial, drive: Drive, world: _World, steps: int) -> _Axis:
    """Return a drive at the beginning of a trial."""
    state, values = physics.drives[drive.actuator], physics.values
    q, v = _dof(world.plant, drive.joint)
    motor = world.motor_joints.get(drive.joint)
    motor_q, motor_v = (q, v) if motor is None else _dof(world.plant, motor.name())
    stiffness = 0.0
    if motor is not None:
        stiffness = PLAY_STIFFNESS if state.play else 1 / state.compliance
    damping = 2 * GEAR_DAMPING * np.sqrt(stiffness * state.armature)
    ticks = np.arange(round(steps * rig.step / CONTROL_PERIOD) + 2) * CONTROL_PERIOD - trial.before
    return _Axis(
        drive,
        state,
        values[drive.kp],
        values[drive.kv],
        setpoints(*trial.action[drive.actuator], ticks, state),
        q,
        v,
        motor_q,
        motor_v,
        stiffness,
        damping,
    )


def _dof(plant: Any, joint: str) -> tuple[int, int]:
    """Return where position and velocity of a joint stand."""
    found = plant.GetJointByName(joint)
    return found.position_start(), found.velocity_start()


def _push(physics: Physics, plant: Any, context: Any, body: Any, time: float, v: np.ndarray, tau: np.ndarray) -> None:
    """Add forces on the free body."""
    pose = plant.EvalBodyPoseInWorld(context, body)
    rotation = pose.rotation().matrix()
    start = body.floating_velocities_start_in_v()
    turning, velocity = v[start : start + 3], v[start + 3 : start + 6]
    arm = rotation @ body.CalcCenterOfMassInBodyFrame(context)
    state = BodyState(pose.translation() + arm, velocity + np.cross(turning, arm), turning, rotation)
    for function in physics.body_forces:
        force, torque = function(time, state)
        tau[start : start + 3] += torque + np.cross(arm, force)
        tau[start + 3 : start + 6] += force


def _pose(pose: Any) -> np.ndarray:
    """Return x y z and quaternion wxyz, shape (7,)."""
    return np.concatenate([pose.translation(), pose.rotation().ToQuaternion().wxyz()])
