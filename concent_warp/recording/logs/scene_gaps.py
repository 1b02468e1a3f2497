"""What a scene lacks for a log to be mapped to it: names of actuators and sensors, and sensors; with lines to add."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from xml.etree import ElementTree

import mujoco

from concent_warp.recording.logs.targets import actuator_target, sensor_target
from concent_warp.scene.scene import Scene

LISTED = 4
"""Most lines that one sentence gives to be added: who has seen some can write the others."""
TAGS = {
    int(mujoco.mjtSensor.mjSENS_JOINTPOS): ("jointpos", "position"),
    int(mujoco.mjtSensor.mjSENS_JOINTVEL): ("jointvel", "velocity"),
}
"""Elements of MJCF by kind of sensor, and what they read."""


def nameless_actuators(m: mujoco.MjModel) -> str:
    """Return a sentence on the actuators of a scene that have no name, empty where all have one."""
    nameless = [i for i in range(m.nu) if not m.actuator(i).name]
    if not nameless:
        return ""
    joints = [actuator_target(m, i).joint for i in nameless]
    lines = [f'name="{joint}" to that of joint {joint!r}' for joint in joints if joint]
    added = _listed(lines, ", ") or 'name="..." to the element of each'
    return f"{_lack(len(nameless), 'actuator')}; add {added}"


def measured_gaps(scene: Scene, sought: Collection[str] = ()) -> list[str]:
    """Return a sentence for each thing that a scene lacks for measurements to be mapped to it.

    Args:
        scene: The scene.
        sought: Joints that channels without a sensor seem to be of. Lines to be added are for these, and for all
            joints where a scene without any sensor has none of them.
    """
    m, found = scene.model, []
    if nameless := [i for i in range(m.nsensor) if not m.sensor(i).name]:
        lines = [line for line in (_named_sensor(m, i) for i in nameless) if line]
        written = _listed(lines, " ") or 'name="..." into the element of each'
        found.append(f"{_lack(len(nameless), 'sensor')}; write {written}")
    free = unread_joints(scene)
    wanted = [joint for joint in free if joint in sought]
    if not m.nsensor:
        lines = [_sensor("jointpos", joint, "position") for joint in wanted or free]
        lines += [] if wanted else [_pose(body) for body in _free_bodies(scene)]
        example = '<jointpos name="angle" joint="JOINT"/> with the name of a joint'
        found.append(
            "the scene has no sensor that a measurement could be mapped to; add to its MJCF "
            f"<sensor>{_listed(lines, ' ') or example}</sensor>"
        )
    elif wanted:
        lines = [_sensor("jointpos", joint, "position") for joint in wanted]
        found.append(
            f"no sensor of the scene reads the position of {', '.join(map(repr, wanted))}, which channels of the log "
            f"may be of; add to its <sensor> {_listed(lines, ' ')}"
        )
    return found


def scene_gaps(scene: Scene, sought: Collection[str] = ()) -> list[str]:
    """Return a sentence for each thing that a scene lacks for a log to be mapped to it; see `measured_gaps`."""
    return [one for one in (nameless_actuators(scene.model), *measured_gaps(scene, sought)) if one]


def nothing_measured(scene: Scene) -> str:
    """Return what is to be done about a map that names no measurement."""
    if gaps := measured_gaps(scene):
        return gaps[0]
    m = scene.model
    named = [m.sensor(i).name for i in range(m.nsensor)]
    return f"map a channel of the log to one of {named[:LISTED]}{' and more' if len(named) > LISTED else ''}"


def unread_joints(scene: Scene) -> list[str]:
    """Return the hinges and slides with a name whose position no sensor reads."""
    m = scene.model
    sensors = [sensor_target(m, i) for i in range(m.nsensor)]
    read = {one.joint for one in sensors if one.position}
    named = {element.get("name") for element in ElementTree.fromstring(scene.xml).iter("joint")}
    kinds = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    joints = [str(m.joint(j).name) for j in range(m.njnt) if int(m.jnt_type[j]) in kinds]
    return [joint for joint in joints if joint in named and joint not in read]


def _free_bodies(scene: Scene) -> list[str]:
    """Return the bodies with a name and a free joint."""
    m = scene.model
    named = {element.get("name") for element in ElementTree.fromstring(scene.xml).iter("body")}
    free = [
        str(m.body(int(m.jnt_bodyid[j])).name) for j in range(m.njnt) if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE
    ]
    return [body for body in free if body in named]


def _sensor(tag: str, joint: str, quantity: str) -> str:
    """Return the element of a sensor of a joint."""
    return f'<{tag} name="{joint}_{quantity}" joint="{joint}"/>'


def _pose(body: str) -> str:
    """Return the elements of the sensors of a body's pose."""
    kinds = (("framepos", "position"), ("framequat", "orientation"))
    return " ".join(f'<{tag} name="{body}_{what}" objtype="xbody" objname="{body}"/>' for tag, what in kinds)


def _named_sensor(m: mujoco.MjModel, row: int) -> str:
    """Return the element of a sensor of a joint, with a name that it lacks; empty for other sensors."""
    tag, quantity = TAGS.get(int(m.sensor_type[row]), ("", ""))
    return _sensor(tag, sensor_target(m, row).joint, quantity) if tag else ""


def _listed(lines: Sequence[str], between: str) -> str:
    """Return lines to be added, the first few of many."""
    more = f"{between}and {len(lines) - LISTED} more alike" if len(lines) > LISTED else ""
    return between.join(lines[:LISTED]) + more


def _lack(count: int, what: str) -> str:
    """Return that some things of the scene cannot be named in a map."""
    if count == 1:
        return f"1 {what} of the scene has no name by which the map could call it"
    return f"{count} {what}s of the scene have no names by which the map could call them"
