"""What each kind of MuJoCo sensor measures: quantity, unit, body, and the frame that its readings are in."""

from __future__ import annotations

from typing import Literal

import mujoco

from concent_warp.simulate.replay import UNIT_QUATERNION_SENSORS

Kind = Literal["position", "orientation", "joint", "points", "other"]
"""What a channel measures."""
SENSOR = mujoco.mjtSensor
POSITIONS = (SENSOR.mjSENS_FRAMEPOS, SENSOR.mjSENS_SUBTREECOM)
BODIES = (mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY)
LOCAL = (
    *(SENSOR.mjSENS_GYRO, SENSOR.mjSENS_ACCELEROMETER, SENSOR.mjSENS_VELOCIMETER, SENSOR.mjSENS_MAGNETOMETER),
    *(SENSOR.mjSENS_FORCE, SENSOR.mjSENS_TORQUE, SENSOR.mjSENS_FRAMEQUAT, SENSOR.mjSENS_BALLQUAT),
    SENSOR.mjSENS_BALLANGVEL,
)
"""Sensors whose residual is in a frame that moves along with a body."""
UNITS = {
    SENSOR.mjSENS_FRAMEPOS: "m",
    SENSOR.mjSENS_SUBTREECOM: "m",
    SENSOR.mjSENS_RANGEFINDER: "m",
    SENSOR.mjSENS_FRAMEQUAT: "rad",
    SENSOR.mjSENS_BALLQUAT: "rad",
    SENSOR.mjSENS_FRAMELINVEL: "m/s",
    SENSOR.mjSENS_VELOCIMETER: "m/s",
    SENSOR.mjSENS_SUBTREELINVEL: "m/s",
    SENSOR.mjSENS_FRAMEANGVEL: "rad/s",
    SENSOR.mjSENS_GYRO: "rad/s",
    SENSOR.mjSENS_BALLANGVEL: "rad/s",
    SENSOR.mjSENS_ACCELEROMETER: "m/s²",
    SENSOR.mjSENS_FRAMELINACC: "m/s²",
    SENSOR.mjSENS_FRAMEANGACC: "rad/s²",
    SENSOR.mjSENS_FORCE: "N",
    SENSOR.mjSENS_TOUCH: "N",
    SENSOR.mjSENS_TORQUE: "N m",
}
"""Units of sensors that do not depend on the joint that they sit on."""
JOINT_UNITS = {
    SENSOR.mjSENS_JOINTPOS: ("rad", "m"),
    SENSOR.mjSENS_TENDONPOS: ("rad", "m"),
    SENSOR.mjSENS_ACTUATORPOS: ("rad", "m"),
    SENSOR.mjSENS_JOINTVEL: ("rad/s", "m/s"),
    SENSOR.mjSENS_TENDONVEL: ("rad/s", "m/s"),
    SENSOR.mjSENS_ACTUATORVEL: ("rad/s", "m/s"),
    SENSOR.mjSENS_ACTUATORFRC: ("N m", "N"),
    SENSOR.mjSENS_JOINTACTFRC: ("N m", "N"),
    SENSOR.mjSENS_TENDONACTFRC: ("N m", "N"),
}
"""Units on a hinge and on a slide."""


def kind_and_unit(compiled: mujoco.MjModel, row: int) -> tuple[Kind, str]:
    """Return what a sensor measures and the unit of its residual."""
    sensor = SENSOR(int(compiled.sensor_type[row]))
    if sensor in UNIT_QUATERNION_SENSORS:
        return "orientation", "rad"
    if sensor in JOINT_UNITS:
        unit = JOINT_UNITS[sensor][_slides(compiled, sensor, int(compiled.sensor_objid[row]))]
        return "joint" if unit in ("rad", "m") else "other", unit
    return "position" if sensor in POSITIONS else "other", UNITS.get(sensor, "")


def _slides(compiled: mujoco.MjModel, sensor: mujoco.mjtSensor, target: int) -> bool:
    """Return whether a joint, tendon or actuator sensor is about lengths rather than angles."""
    if sensor in (SENSOR.mjSENS_ACTUATORPOS, SENSOR.mjSENS_ACTUATORVEL, SENSOR.mjSENS_ACTUATORFRC):
        tendon = compiled.actuator_trntype[target] == mujoco.mjtTrn.mjTRN_TENDON
        target = int(compiled.actuator_trnid[target, 0])
    else:
        tendon = sensor in (SENSOR.mjSENS_TENDONPOS, SENSOR.mjSENS_TENDONVEL, SENSOR.mjSENS_TENDONACTFRC)
    if not tendon:
        return compiled.jnt_type[target] == mujoco.mjtJoint.mjJNT_SLIDE
    start = compiled.tendon_adr[target]
    wraps = range(start, start + compiled.tendon_num[target])
    joints = [compiled.wrap_objid[w] for w in wraps if compiled.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT]
    return all(compiled.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE for j in joints)


def body_of(compiled: mujoco.MjModel, row: int) -> str | None:
    """Return the body that a sensor sits on, or that its joint moves."""
    kind, target = int(compiled.sensor_objtype[row]), int(compiled.sensor_objid[row])
    owner = {
        mujoco.mjtObj.mjOBJ_JOINT: compiled.jnt_bodyid,
        mujoco.mjtObj.mjOBJ_SITE: compiled.site_bodyid,
        mujoco.mjtObj.mjOBJ_GEOM: compiled.geom_bodyid,
        mujoco.mjtObj.mjOBJ_CAMERA: compiled.cam_bodyid,
    }
    if kind not in BODIES:
        if kind not in owner:
            return None
        target = int(owner[mujoco.mjtObj(kind)][target])
    return compiled.body(target).name or f"body{target}"
