"""The world on Bullet: bodies and contacts by Bullet, drives, gears and hidden forces step by step.

Bodies are `btMultiBody` (Featherstone's algorithm, explicit in the Coriolis terms, semi-implicit Euler), contacts are
solved by sequential impulses [Catto, "Iterative dynamics with temporal coherence", GDC 2005]. Bullet's default damping
of bodies and joints, its joint motors, rolling and spinning friction, restitution and sleeping are off. What Bullet
does not have is done here:

- Drives are sampled at 1 kHz, their torque is held in between.
- Reflected inertia A of rotors: (M + A) a = tau - c has the acceleration of M a = (tau - A a) - c, with M and c by
  Bullet's inverse dynamics. With play in the gear, the rotor is integrated here, with smaller steps.
- Coulomb friction of joints is LuGre friction [Canudas de Wit et al., IEEE Trans. Automat. Control 40(3), 1995].
- A bouncing ball touches by Bullet's contact stiffness and damping, which are integrated implicitly and so add
  sqrt(k / m) dt / 2 to the damping ratio; the damper has so much less.

Bullet's friction cone is solved for each contact by itself, in impulses: its force points along the sliding velocity
only where the effective mass of the contact is the same in all directions. So blocks are square and stand on a foot
that is small against their radius of gyration.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.independent.bullet.urdf import is_free, roots, true_bodies, urdf
from benchmarks.independent.foreign.drives import (
    CONTROL_PERIOD,
    GEAR_DAMPING,
    RECORD_PERIOD,
    Bristle,
    setpoints,
)
from benchmarks.independent.foreign.rig import (
    BodyState,
    Drive,
    DriveState,
    ForeignMotion,
    ForeignRig,
    ForeignTrial,
    Physics,
)

try:
    bullet: Any = import_module("pybullet")
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("the world on Bullet needs the extra: pip install 'concent-warp[benchmarks]'") from error

ITERATIONS = 100
"""Iterations of the contact solver in a step, without early stop."""
SLOWEST_BOUNCE = 1e-3
"""Speed below which nothing bounces [m/s]."""
RIGID = 1e18
"""Stiffness of the table under a bouncing ball, of whose own the contact has the series [N/m]."""
TOOTH_STIFFNESS = 5000.0
"""Stiffness of teeth at either end of the play [N m/rad]."""
ROTOR_STEPS = 4
"""Steps of a rotor behind play in a step of the world."""


class _Client:
    """A server of Bullet's in this process, with Bullet's functions as methods."""

    def __init__(self) -> None:
        self.number = bullet.connect(bullet.DIRECT)

    def __getattr__(self, name: str) -> Any:
        return partial(getattr(bullet, name), physicsClientId=self.number)


@dataclass
class _World:
    """Bodies in the engine."""

    client: _Client
    arm: int | None = None
    """Number of the bodies on joints."""
    joints: dict[str, int] = field(default_factory=dict)
    """Numbers of their joints, in the order of the degrees of freedom."""
    body: int | None = None
    """Number of the free body."""
    center: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Its centre of mass [m], body frame."""
    table: np.ndarray = field(default_factory=lambda: np.eye(3))
    """Rotation matrix of the table."""


@dataclass
class _Axis:
    """A driven joint in the simulation."""

    state: DriveState
    kp: float
    kv: float
    setpoint: np.ndarray
    """Command after delay and lag, by control period."""
    dof: int
    torque: float = 0.0
    """Torque that is held [N m or N]."""
    angle: float = 0.0
    """Angle of the rotor, where there is play [rad]."""
    rate: float = 0.0
    """Its speed [rad/s]."""

    def control(self, tick: int, q: float, v: float) -> None:
        """Set the torque at a tick."""
        angle, rate = (self.angle, self.rate) if self.has_gear else (q, v)
        error = self.setpoint[tick] - (angle - self.state.offset)
        torque = self.state.gain * (self.kp * error - self.kv * rate)
        self.torque = min(max(torque, -self.state.limit), self.state.limit)

    @property
    def has_gear(self) -> bool:
        """Whether rotor and link do not move as one."""
        return bool(self.state.play or self.state.compliance)

    def turn(self, q: float, v: float, dt: float) -> float:
        """Return the mean torque on the link over a step [N m], and move the rotor on."""
        state = self.state
        stiffness = TOOTH_STIFFNESS if state.play else 1 / state.compliance
        damping = 2 * GEAR_DAMPING * np.sqrt(stiffness * state.armature)
        part, total = dt / ROTOR_STEPS, 0.0
        for _ in range(ROTOR_STEPS):
            twist = self.angle - q
            over = twist - min(max(twist, -state.play / 2), state.play / 2)
            torque = stiffness * over + damping * (self.rate - v) if over or not state.play else 0.0
            if state.play and torque * over < 0:  # teeth push only
                torque = 0.0
            self.rate += part * (self.torque - torque) / state.armature
            self.angle += part * self.rate
            q += part * v
            total += torque / ROTOR_STEPS
        return total


def simulate(rig: ForeignRig, physics: Physics, trial: ForeignTrial) -> ForeignMotion:
    """Return the true motion of a trial.

    Raises:
        RuntimeError: The simulation diverged.
        ValueError: The world has something hidden that is on Drake only.
    """
    if physics.slosh:
        raise ValueError("the world on Bullet has no mass that swings in a body")
    with built(rig, physics) as world:
        return _run(rig, physics, trial, world)


def _run(rig: ForeignRig, physics: Physics, trial: ForeignTrial, world: _World) -> ForeignMotion:
    dt, client = rig.step, world.client
    before = round(trial.before / dt)
    steps = before + round(trial.duration / dt)
    names = list(world.joints)
    axes = [_axis(rig, physics, trial, d, names, steps) for d in rig.drives]
    _place(rig, physics, trial, world, axes)
    frictions = [(names.index(joint), Bristle(f, dt)) for joint, f in physics.friction.items()]
    damping = np.array([physics.damping.get(name, 0.0) for name in names])
    forces = [(names.index(joint), functions) for joint, functions in physics.joint_forces.items()]
    rotors = np.zeros(len(names))
    for a in axes:
        rotors[a.dof] = 0.0 if a.has_gear else a.state.armature
    every, control = max(1, round(RECORD_PERIOD / dt)), max(1, round(CONTROL_PERIOD / dt))
    times, states, motors, poses = [], [], [], []
    carried = np.zeros(len(names))
    for k in range(steps + 1):
        now = (k - before) * dt
        q, v = _joints(world)
        if k % every == 0:
            times.append(now)
            states.append(q)
            motors.append([a.angle if a.has_gear else q[a.dof] for a in axes])
            poses.append(_pose(world) if world.body is not None else np.zeros(7))
        if k == steps:
            break
        if k % control == 0:
            for a in axes:
                a.control(k // control, q[a.dof], v[a.dof])
            if physics.compensation:
                rest = [0.0] * len(names)
                weight = client.calculateInverseDynamics(world.arm, q.tolist(), rest, rest)
                carried = physics.compensation * np.array(weight)
        tau = carried - damping * v
        for a in axes:
            tau[a.dof] += a.turn(q[a.dof], v[a.dof], dt) if a.has_gear else a.torque
        for dof, bristle in frictions:
            tau[dof] -= bristle.force(now, v[dof])
        for dof, functions in forces:
            tau[dof] += sum(function(now, q[dof], v[dof]) for function in functions)
        if rotors.any():
            tau -= rotors * _acceleration(world, q, v, tau, rotors)
        if world.arm is not None:
            client.setJointMotorControlArray(
                world.arm, list(world.joints.values()), bullet.TORQUE_CONTROL, forces=tau.tolist()
            )
        if physics.body_forces:
            _push(physics, world, now)
        client.stepSimulation()
    motion, seen = np.array(states), np.array(poses)
    if (
        not np.isfinite(motion).all()
        or not np.isfinite(seen).all()
        or max(np.abs(motion).max(initial=0), np.abs(seen).max()) > 1e4
    ):
        raise RuntimeError(f"the world on Bullet diverged in {rig.name}")
    return ForeignMotion(
        np.array(times),
        {name: motion[:, i] for i, name in enumerate(names)},
        {d.joint: np.array(motors)[:, i] for i, d in enumerate(rig.drives)},
        {rig.body: seen} if world.body is not None else {},
    )


@contextmanager
def built(rig: ForeignRig, physics: Physics) -> Iterator[_World]:
    """Open the world of a rig, its joints at zero."""
    client = _Client()
    try:
        client.setPhysicsEngineParameter(
            fixedTimeStep=rig.step,
            numSubSteps=0,
            numSolverIterations=ITERATIONS,
            solverResidualThreshold=0.0,
            enableConeFriction=1,
            restitutionVelocityThreshold=SLOWEST_BOUNCE,
            deterministicOverlappingPairs=1,
        )
        client.setGravity(*physics.gravity)
        world, model = _World(client), true_bodies(rig, physics)
        for root in roots(model):
            _load(rig, physics, world, model, root)
        for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
            turn = Rotation.from_quat(model.geom_quat[geom], scalar_first=True)
            world.table = turn.as_matrix()
            shape = client.createCollisionShape(bullet.GEOM_PLANE, planeNormal=world.table[:, 2].tolist())
            table = client.createMultiBody(0, shape, basePosition=model.geom_pos[geom].tolist())
            _surface(client, table, -1, physics.values["friction"])
            if rig.bounces:
                client.changeDynamics(table, -1, contactStiffness=RIGID, contactDamping=0.0)
        yield world
    finally:
        client.disconnect()


def _load(rig: ForeignRig, physics: Physics, world: _World, model: mujoco.MjModel, root: int) -> None:
    """Add a body and all that hangs on it."""
    client, free = world.client, is_free(model, root)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "body.urdf"
        path.write_text(urdf(model, root))
        flags = bullet.URDF_USE_INERTIA_FROM_FILE
        number = client.loadURDF(str(path), useFixedBase=not free, flags=flags)
    for link in range(-1, client.getNumJoints(number)):
        client.changeDynamics(number, link, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0)
        _surface(client, number, link, 1.0)
    if free:
        world.body, world.center = number, model.body_ipos[root].copy()
        if rig.bounces:
            v, mass = physics.values, model.body_mass[root]
            frequency = np.sqrt(v["stiffness"] / mass)
            ratio = v["damping_ratio"] - 0.5 * frequency * rig.step
            client.changeDynamics(
                number, -1, contactStiffness=v["stiffness"], contactDamping=2 * ratio * frequency * mass
            )
        return
    world.arm = number
    for link in range(client.getNumJoints(number)):
        info = client.getJointInfo(number, link)
        world.joints[info[1].decode()] = link
        if info[12].decode() == rig.finger:
            _surface(client, number, link, physics.values["pad"])
    numbers = list(world.joints.values())
    client.setJointMotorControlArray(number, numbers, bullet.VELOCITY_CONTROL, forces=[0.0] * len(numbers))


def _surface(client: _Client, body: int, link: int, friction: float) -> None:
    """Set friction of a surface [-], of which a contact has the product; nothing bounces by restitution."""
    client.changeDynamics(
        body, link, lateralFriction=friction, rollingFriction=0.0, spinningFriction=0.0, restitution=0.0
    )


def _place(rig: ForeignRig, physics: Physics, trial: ForeignTrial, world: _World, axes: list[_Axis]) -> None:
    """Set the state in which the simulation begins: drives at their first command, the free body as the trial says.

    Poses and velocities of bodies on a table are given in the table's frame.
    """
    client, numbers = world.client, list(world.joints.values())
    for a in axes:
        a.angle = float(a.setpoint[0] + a.state.offset)
        client.resetJointState(world.arm, numbers[a.dof], a.angle, 0.0)
    if world.body is None:
        return
    position, velocity = np.array(trial.pose[:3], float), np.array(trial.velocity or np.zeros(6), float)
    turn = Rotation.from_quat(trial.pose[3:], scalar_first=True)
    if rig.shape != "none" and not rig.bounces:
        position[2] = physics.size * physics.values["half_z" if rig.shape == "box" else "radius"]
        position, turn = world.table @ position, Rotation.from_matrix(world.table) * turn
        velocity = (velocity.reshape(2, 3) @ world.table.T).ravel()
    arm = turn.apply(world.center)
    linear = velocity[:3] + np.cross(velocity[3:], arm)
    client.resetBasePositionAndOrientation(world.body, (position + arm).tolist(), turn.as_quat().tolist())
    client.resetBaseVelocity(world.body, linear.tolist(), velocity[3:].tolist())


def _axis(rig: ForeignRig, physics: Physics, trial: ForeignTrial, drive: Drive, names: list[str], steps: int) -> _Axis:
    """Return a drive at the beginning of a trial."""
    state, values = physics.drives[drive.actuator], physics.values
    ticks = np.arange(round(steps * rig.step / CONTROL_PERIOD) + 2) * CONTROL_PERIOD - trial.before
    setpoint = setpoints(*trial.action[drive.actuator], ticks, state)
    return _Axis(state, values[drive.kp], values[drive.kv], setpoint, names.index(drive.joint))


def _joints(world: _World) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities of joints."""
    if world.arm is None:
        return np.zeros(0), np.zeros(0)
    found = world.client.getJointStates(world.arm, list(world.joints.values()))
    return np.array([s[0] for s in found]), np.array([s[1] for s in found])


def _acceleration(world: _World, q: np.ndarray, v: np.ndarray, tau: np.ndarray, rotors: np.ndarray) -> np.ndarray:
    """Return the acceleration of joints with rotors of a reflected inertia, given their torques."""
    inertia = np.array(world.client.calculateMassMatrix(world.arm, q.tolist()))
    bias = world.client.calculateInverseDynamics(world.arm, q.tolist(), v.tolist(), [0.0] * len(q))
    return np.linalg.solve(inertia + np.diag(rotors), tau - np.array(bias))


def _pose(world: _World) -> np.ndarray:
    """Return the pose of the free body's frame, x y z and quaternion wxyz, shape (7,)."""
    center, quaternion = world.client.getBasePositionAndOrientation(world.body)
    turn = Rotation.from_quat(quaternion)
    return np.concatenate([np.array(center) - turn.apply(world.center), turn.as_quat(scalar_first=True)])


def _push(physics: Physics, world: _World, time: float) -> None:
    """Add forces on the free body."""
    client = world.client
    center, quaternion = client.getBasePositionAndOrientation(world.body)
    velocity, turning = client.getBaseVelocity(world.body)
    rotation = Rotation.from_quat(quaternion).as_matrix()
    state = BodyState(np.array(center), np.array(velocity), np.array(turning), rotation)
    for function in physics.body_forces:
        force, torque = function(time, state)
        client.applyExternalForce(world.body, -1, force.tolist(), center, bullet.WORLD_FRAME)
        client.applyExternalTorque(world.body, -1, torque.tolist(), bullet.WORLD_FRAME)
