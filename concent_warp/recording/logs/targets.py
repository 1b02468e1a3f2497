"""What a scene has that a log can be mapped to: actuators, sensors and bodies with quantities and ranges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from concent_warp.recording.logs.units import Quantity

S = mujoco.mjtSensor
QUANTITIES: dict[int, Quantity] = {
    int(S.mjSENS_FRAMEPOS): "length",
    int(S.mjSENS_SUBTREECOM): "length",
    int(S.mjSENS_RANGEFINDER): "length",
    int(S.mjSENS_GEOMDIST): "length",
    int(S.mjSENS_FRAMEQUAT): "orientation",
    int(S.mjSENS_BALLQUAT): "orientation",
    int(S.mjSENS_FRAMELINVEL): "velocity",
    int(S.mjSENS_VELOCIMETER): "velocity",
    int(S.mjSENS_SUBTREELINVEL): "velocity",
    int(S.mjSENS_FRAMEANGVEL): "angular velocity",
    int(S.mjSENS_GYRO): "angular velocity",
    int(S.mjSENS_BALLANGVEL): "angular velocity",
    int(S.mjSENS_ACCELEROMETER): "acceleration",
    int(S.mjSENS_FRAMELINACC): "acceleration",
    int(S.mjSENS_FRAMEANGACC): "angular acceleration",
    int(S.mjSENS_FORCE): "force",
    int(S.mjSENS_TOUCH): "force",
    int(S.mjSENS_TORQUE): "torque",
}
OF_JOINTS: dict[int, tuple[Quantity, Quantity]] = {
    int(S.mjSENS_JOINTPOS): ("angle", "length"),
    int(S.mjSENS_TENDONPOS): ("angle", "length"),
    int(S.mjSENS_ACTUATORPOS): ("angle", "length"),
    int(S.mjSENS_JOINTVEL): ("angular velocity", "velocity"),
    int(S.mjSENS_TENDONVEL): ("angular velocity", "velocity"),
    int(S.mjSENS_ACTUATORVEL): ("angular velocity", "velocity"),
    int(S.mjSENS_JOINTACTFRC): ("torque", "force"),
    int(S.mjSENS_ACTUATORFRC): ("torque", "force"),
}
"""Quantities of sensors of hinges and of slides."""
Controlled = Literal["position", "velocity", "force"]
CONTROLS: dict[Controlled, tuple[Quantity, Quantity]] = {
    "position": ("angle", "length"),
    "velocity": ("angular velocity", "velocity"),
    "force": ("torque", "force"),
}
"""Quantities of controls of hinges and of slides."""
FILTERS = (int(mujoco.mjtDyn.mjDYN_NONE), int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
"""Dynamics of actuators that leave the unit of their control."""
LARGEST_ARM = 0.1
"""Largest coefficients up to which those of a fixed tendon may be moment arms [m], and its length one in metres."""
POSITIONS = (int(S.mjSENS_JOINTPOS), int(S.mjSENS_TENDONPOS), int(S.mjSENS_ACTUATORPOS))
VELOCITIES = (int(S.mjSENS_JOINTVEL),)


@dataclass(frozen=True)
class Target:
    """An actuator or a sensor of the scene."""

    name: str
    command: bool
    size: int
    """Numbers of a sample."""
    quantity: Quantity
    range: tuple[float, float] | None
    """Range of the joint, tendon or control [SI], where it has one."""
    joint: str = ""
    """Joint, tendon or body that it acts on or reads."""
    position: bool = False
    """Whether it is the position of a joint or tendon, measured or commanded of a servo."""
    velocity: bool = False
    """Whether it is the velocity of a joint."""


def targets_of(m: mujoco.MjModel) -> tuple[dict[str, Target], dict[str, Target]]:
    """Return the named actuators and sensors of a scene, each by name."""
    actuators = {m.actuator(i).name: actuator_target(m, i) for i in range(m.nu) if m.actuator(i).name}
    sensors = {m.sensor(i).name: sensor_target(m, i) for i in range(m.nsensor) if m.sensor(i).name}
    return actuators, sensors


def named_parts(m: mujoco.MjModel) -> frozenset[str]:
    """Return the names of all that a table of its own may be of: bodies, joints, sites, geoms, sensors, actuators."""
    names = [m.body(i).name for i in range(1, m.nbody)] + [m.joint(i).name for i in range(m.njnt)]
    names += [m.site(i).name for i in range(m.nsite)] + [m.geom(i).name for i in range(m.ngeom)]
    names += [m.sensor(i).name for i in range(m.nsensor)] + [m.actuator(i).name for i in range(m.nu)]
    return frozenset(names) - {""}


def body_sensors(m: mujoco.MjModel, body: str) -> tuple[str | None, str | None]:
    """Return the sensors of a body's position and orientation in the world, None where there is none."""
    found: list[str | None] = []
    for kind in (S.mjSENS_FRAMEPOS, S.mjSENS_FRAMEQUAT):
        found.append(
            next(
                (
                    m.sensor(i).name
                    for i in range(m.nsensor)
                    if m.sensor_type[i] == kind
                    and m.sensor_refid[i] < 0
                    and m.sensor_objtype[i] == mujoco.mjtObj.mjOBJ_XBODY
                    and m.body(int(m.sensor_objid[i])).name == body
                ),
                None,
            )
        )
    return found[0], found[1]


def actuator_target(m: mujoco.MjModel, row: int) -> Target:
    """Return an actuator."""
    name = m.actuator(row).name
    follows = _followed(m, row)
    angular, span, driven = _driven(m, int(m.actuator_trntype[row]), int(m.actuator_trnid[row, 0]))
    quantity: Quantity = "any" if angular is None or follows is None else CONTROLS[follows][0 if angular else 1]
    servo = follows == "position"
    if quantity == "any" or not servo:
        span = None
    if m.actuator_ctrllimited[row]:
        span = float(m.actuator_ctrlrange[row, 0]), float(m.actuator_ctrlrange[row, 1])
    return Target(name, True, 1, quantity, span, driven, position=servo)


def _followed(m: mujoco.MjModel, row: int) -> Controlled | None:
    """Return what the control of an actuator sets, None where its unit cannot be told, as behind a gear.

    The force of MuJoCo's ``position`` is kp (control - position), less damping; that of ``velocity`` is
    kv (control - velocity); ``intvelocity`` integrates a velocity to such a position; that of ``motor`` is its control.
    """
    if m.actuator_gear[row, 0] != 1 or m.actuator_gaintype[row] != mujoco.mjtGain.mjGAIN_FIXED:
        return None
    gain, bias = m.actuator_gainprm[row, 0], m.actuator_biasprm[row]
    integrates = m.actuator_dyntype[row] == mujoco.mjtDyn.mjDYN_INTEGRATOR
    filters = m.actuator_dyntype[row] in FILTERS
    if m.actuator_biastype[row] == mujoco.mjtBias.mjBIAS_AFFINE and gain != 0 and (integrates or filters):
        if gain == -bias[1]:
            return "velocity" if integrates else "position"
        return "velocity" if filters and bias[1] == 0 and gain == -bias[2] else None
    if m.actuator_biastype[row] == mujoco.mjtBias.mjBIAS_NONE and gain == 1 and filters:
        return "force"
    return None


def _driven(m: mujoco.MjModel, kind: int, target: int) -> tuple[bool | None, tuple[float, float] | None, str]:
    """Return whether an actuator turns (None: unknown), the range of what it drives, and its name."""
    if kind == mujoco.mjtTrn.mjTRN_JOINT:
        return (*_joint(m, target), m.joint(target).name)
    if kind == mujoco.mjtTrn.mjTRN_TENDON:
        return (*_tendon(m, target), m.tendon(target).name)
    return None, None, ""


def _joint(m: mujoco.MjModel, joint: int) -> tuple[bool | None, tuple[float, float] | None]:
    """Return whether a joint is a hinge, None if neither that nor a slide, and its range."""
    kind = m.jnt_type[joint]
    angular = {int(mujoco.mjtJoint.mjJNT_HINGE): True, int(mujoco.mjtJoint.mjJNT_SLIDE): False}.get(int(kind))
    span = (float(m.jnt_range[joint, 0]), float(m.jnt_range[joint, 1])) if m.jnt_limited[joint] else None
    return angular, span


def _tendon(m: mujoco.MjModel, tendon: int) -> tuple[bool | None, tuple[float, float] | None]:
    """Return whether the joints of a fixed tendon are hinges, None if its length may be either, and its range.

    It may be either where joints are not of one kind, and where coefficients of hinges are as small as moment arms.
    """
    rows = slice(m.tendon_adr[tendon], m.tendon_adr[tendon] + m.tendon_num[tendon])
    if (m.wrap_type[rows] != mujoco.mjtWrap.mjWRAP_JOINT).any():
        span = m.tendon_range[tendon]
        return False, (float(span[0]), float(span[1])) if m.tendon_limited[tendon] else None
    joints = m.wrap_objid[rows]
    kinds = {_joint(m, int(one))[0] for one in joints}
    angular = kinds.pop() if len(kinds) == 1 else None
    if angular and float(np.abs(m.wrap_prm[rows]).max()) <= LARGEST_ARM:
        angular = None
    if m.tendon_limited[tendon]:
        return angular, (float(m.tendon_range[tendon, 0]), float(m.tendon_range[tendon, 1]))
    if not m.jnt_limited[joints].all():
        return angular, None
    ends = m.wrap_prm[rows, None] * m.jnt_range[joints]
    return angular, (float(ends.min(axis=1).sum()), float(ends.max(axis=1).sum()))


def sensor_target(m: mujoco.MjModel, row: int) -> Target:
    """Return a sensor."""
    kind, target = int(m.sensor_type[row]), int(m.sensor_objid[row])
    name, size = m.sensor(row).name, int(m.sensor_dim[row])
    read = mujoco.mj_id2name(m, int(m.sensor_objtype[row]), target) or ""
    if kind not in OF_JOINTS:
        return Target(name, False, size, QUANTITIES.get(kind, "any"), None, read)
    objtype = m.sensor_objtype[row]
    if objtype == mujoco.mjtObj.mjOBJ_JOINT:
        angular, span = _joint(m, target)
    elif objtype == mujoco.mjtObj.mjOBJ_TENDON:
        angular, span = _tendon(m, target)
    else:
        angular, span, read = _driven(m, int(m.actuator_trntype[target]), int(m.actuator_trnid[target, 0]))
    pair = OF_JOINTS[kind]
    quantity: Quantity = "any" if angular is None else pair[0 if angular else 1]
    position = kind in POSITIONS
    return Target(
        name, False, size, quantity, span if position else None, read, position=position, velocity=kind in VELOCITIES
    )


def joint_positions(m: mujoco.MjModel, measured: dict[str, float]) -> np.ndarray:
    """Return the reference state, shape (nq,), with the joints whose sensors have given values set to them."""
    qpos = np.array(m.qpos0)
    for i in range(m.nsensor):
        name = m.sensor(i).name
        if m.sensor_type[i] == S.mjSENS_JOINTPOS and np.isfinite(measured.get(name, np.nan)):
            qpos[m.jnt_qposadr[int(m.sensor_objid[i])]] = measured[name]
    return qpos
