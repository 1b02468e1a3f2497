"""Columns of a CSV file by the names in its header."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from concent_warp.errors import RecordingError

QUATERNIONS = (int(mujoco.mjtSensor.mjSENS_FRAMEQUAT), int(mujoco.mjtSensor.mjSENS_BALLQUAT))
COMPONENT = re.compile(
    r"(?:q|v|p|a|f|t|m|r|w|o|g|b|quat|quaternion|pos|position|vel|velocity|acc|gyro|omega|ang|force|torque|mag)?([wxyz])"
)
"""A word that names a component: ``x``, ``qx``, ``vx``, ``posx``."""
NUMBERED = re.compile(r".*?(\d+)")
OTHER_UNITS = ("mm", "cm", "um", "deg", "degs", "degree", "degrees", "inch", "inches")
"""Words of a column's name that say that its numbers are not SI."""


def column_order(path: Path, header: Sequence[str], m: mujoco.MjModel, sensor: str) -> np.ndarray:
    """Return the order in which the value columns of a measurement are to be read, shape (columns,) int.

    Columns that are called after components (``x``, ``qw``, ``pos_z``) or numbered (``q0`` .. ``q3``, w first) are put
    in the order of the sensor, w x y z of a quaternion and x y z else; columns with other names are read as they stand.

    Args:
        path: The file, for messages.
        header: Names of the value columns, in lower case.
        m: The compiled scene.
        sensor: Name of the sensor; one that the scene lacks leaves the order as it is.

    Raises:
        RecordingError: The names contradict the sensor, one another or SI units.
    """
    _check_names(path, header)
    as_written = np.arange(len(header))
    row = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SENSOR, sensor)
    if row < 0 or int(m.sensor_dim[row]) != len(header):
        return as_written
    if len(header) == 1:
        _check_subject(path, header[0], m, _read_by(m, row, sensor))
        return as_written
    numbers = [NUMBERED.fullmatch(name) for name in header]
    if all(numbers):
        count = [int(found.group(1)) for found in numbers if found]
        order = np.argsort(count, kind="stable")
        if [count[k] - count[order[0]] for k in order] == list(range(len(header))):
            return order
    quaternion = int(m.sensor_type[row]) in QUATERNIONS
    if not quaternion and len(header) != 3:
        return as_written
    expected = "wxyz" if quaternion else "xyz"
    found = [_component(name) for name in header]
    if not any(found):
        return as_written
    if sorted(map(str, found)) != sorted(expected):
        raise RecordingError(
            f"the columns are not the components of sensor {sensor!r}",
            where=f"{path}, line 1",
            expected=f"time and {', '.join(expected)}, in any order",
            found=", ".join(header),
        )
    return np.array([found.index(component) for component in expected])


def check_command_column(path: Path, header: Sequence[str], m: mujoco.MjModel, actuator: str) -> None:
    """Check the name of the one column of a commanded channel.

    Raises:
        RecordingError: It is that of something else in the scene, or says that the unit is not SI.
    """
    _check_names(path, header)
    row = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_ACTUATOR, actuator)
    if row < 0:
        return
    kind = {
        mujoco.mjtTrn.mjTRN_JOINT: mujoco.mjtObj.mjOBJ_JOINT,
        mujoco.mjtTrn.mjTRN_TENDON: mujoco.mjtObj.mjOBJ_TENDON,
        mujoco.mjtTrn.mjTRN_SITE: mujoco.mjtObj.mjOBJ_SITE,
    }.get(mujoco.mjtTrn(int(m.actuator_trntype[row])))
    driven = None if kind is None else mujoco.mj_id2name(m, kind, int(m.actuator_trnid[row, 0]))
    _check_subject(path, header[0], m, {actuator, driven or actuator})


def _read_by(m: mujoco.MjModel, row: int, sensor: str) -> set[str]:
    """Return the names of a sensor and of what it reads."""
    read = mujoco.mj_id2name(m, int(m.sensor_objtype[row]), int(m.sensor_objid[row]))
    return {sensor, read or sensor}


def _check_names(path: Path, header: Sequence[str]) -> None:
    """Refuse names that occur twice and units that are not SI."""
    for name in header:
        if name and list(header).count(name) > 1:
            raise RecordingError("two columns have the same name", where=f"{path}, line 1", found=name)
        if unit := next((word for word in _words(name) if word in OTHER_UNITS), None):
            raise RecordingError(
                f"a column is in {unit}",
                where=f"{path}, line 1",
                expected="SI units: m, rad, s",
                found=repr(name),
                fix="convert the numbers and rename the column",
            )


def _check_subject(path: Path, name: str, m: mujoco.MjModel, own: set[str]) -> None:
    """Refuse a column that has the name of another joint, actuator or sensor of the scene."""
    if name in {one.lower() for one in own}:
        return
    others = {m.joint(i).name for i in range(m.njnt)} | {m.actuator(i).name for i in range(m.nu)}
    others |= {m.sensor(i).name for i in range(m.nsensor)}
    if name and name in {one.lower() for one in others}:
        raise RecordingError(
            "the column is called after something else in the scene",
            where=f"{path}, line 1",
            expected=f"one of {sorted(own)}, or another word",
            found=repr(name),
            fix="check that the file has the right name",
        )


def _component(name: str) -> str | None:
    """Return the component that a column's name states, one of w, x, y, z, or None."""
    found = [match.group(1) for word in _words(name) if (match := COMPONENT.fullmatch(word))]
    return found[-1] if found else None


def _words(name: str) -> list[str]:
    """Return the words of a column's name."""
    return [word for word in re.split(r"[^a-z0-9]+", name) if word]
