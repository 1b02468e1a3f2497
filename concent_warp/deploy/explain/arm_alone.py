"""The robot without its surroundings, for a search for effects in its free motion.

While the object touches nothing but the hand it is a load that the arm carries. As a body that is held by friction
it would cut the motion into short pieces, each with an initial state of its own, over which effects of the joints look
alike, and its contacts with the fingers would take most of the time.
"""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.diagnosis.result import Diagnosis
from concent_warp.effects.effect import OBJECTS, AddedEffect
from concent_warp.errors import ConcentError, ModelError
from concent_warp.model import Model
from concent_warp.recording.recording import Demonstration, Recording
from concent_warp.scene.scene import Scene
from concent_warp.train.task.task import Task


def with_arm_alone(
    model: Model, task: Task, grasped: tuple[np.ndarray, Rotation] | None, free: Recording
) -> tuple[Model, Recording]:
    """Return model and recording of the arm alone, see `arm_alone`; as given where it cannot be taken out of the scene.

    Args:
        model: The model.
        task: The task in it.
        grasped: See `arm_alone`.
        free: Recording of free motion in the whole scene.
    """
    try:
        alone = arm_alone(model, task, grasped)
    except (ConcentError, ValueError):  # its parts need others, as those that a plugin drives
        return model, free
    return alone, readings_alone(free, alone)


def arm_alone(model: Model, task: Task, grasped: tuple[np.ndarray, Rotation] | None) -> Model:
    """Return a model of the arm alone, with a hand that does not move and the grasped object fixed to it.

    Bodies keep their masses and inertias and lose their shapes. Effects on what is left are kept, but for those of
    contacts.

    Args:
        model: The model.
        task: The task in it, whose first object is grasped.
        grasped: Pose of the object in the frame of the tool, position [m] and orientation; None where none is.
    """
    m, spec = task.compiled, model.scene.spec()
    joints = {m.joint(int(j)).name for j in task.robot.joint}
    actuators = {m.actuator(int(a)).name for a in task.robot.actuator}
    nominal = spec.compile()  # the effects of joints and links act on the arm alone, too
    for body in spec.bodies[1:]:
        _set_inertia(body, nominal, nominal.body(body.name).id)
    for joint in [j for j in spec.joints if j.name not in joints]:
        spec.delete(joint)
    for name in model.scene.objects():
        if (body := spec.body(name)) is not None:  # else it was part of one before it
            spec.delete(body)
    if grasped is not None:
        _carry(spec, nominal, m.site(task.robot.tool).name, m.body(task.objects[0]).name, grasped)
    rest = (*spec.geoms, *spec.tendons, *spec.equalities, *spec.pairs, *spec.excludes, *spec.keys, *spec.cameras)
    for one in (*rest, *spec.lights, *spec.skins, *spec.meshes, *spec.hfields, *spec.texts, *spec.tuples):
        spec.delete(one)
    for actuator in [a for a in spec.actuators if a.name not in actuators]:
        spec.delete(actuator)
    for sensor in [s for s in spec.sensors if s.objname not in joints | actuators]:
        spec.delete(sensor)
    alone = Model(Scene.from_spec(spec, model.scene.source))
    compiled = alone.compile()
    return replace(alone, effects=tuple(added for added in model.effects if _acts_on(compiled, added)))


def readings_alone(recording: Recording, alone: Model) -> Recording:
    """Return what a recording has of the commands and readings of a model of the arm alone, in its scene."""
    m = alone.compile()

    def kept(d: Demonstration) -> Demonstration:
        measured = {name: c for name, c in d.measured.items() if _has(m, "sensor", name)}
        action = {name: c for name, c in d.action.items() if _has(m, "actuator", name)}
        return replace(d, qpos=None, qvel=None, measured=measured, action=action, points={}, image={})

    demonstrations = tuple(kept(d) for d in recording.demonstrations)
    return replace(recording, scene=alone.scene.xml, demonstrations=demonstrations)


def in_whole_scene(diagnosis: Diagnosis, model: Model) -> Diagnosis:
    """Return the diagnosis of a model of the arm alone, with the effects that it has in the whole model.

    Args:
        diagnosis: The diagnosis.
        model: The model that the arm was taken from.
    """

    def whole(alone: Model) -> Model:
        fitted = {(a.effect.name, a.effect.target): a for a in alone.effects}
        own = tuple(fitted.pop((a.effect.name, a.effect.target), a) for a in model.effects)
        return replace(model, effects=(*own, *fitted.values()))

    return replace(diagnosis, models=tuple(whole(one) for one in diagnosis.models))


def _set_inertia(body: mujoco.MjsBody, m: mujoco.MjModel, i: int) -> None:
    """Give a body the mass and inertia that it was compiled with, whatever its shapes."""
    body.mass, body.ipos, body.inertia = float(m.body_mass[i]), m.body_ipos[i], m.body_inertia[i]
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.iquat, body.explicitinertial = m.body_iquat[i], bool(m.body_mass[i])


def _carry(spec: mujoco.MjSpec, m: mujoco.MjModel, tool: str, load: str, grasped: tuple[np.ndarray, Rotation]) -> None:
    """Fix a body of a compiled model to the one that carries the tool; it keeps its name, for effects on it."""
    (place, turn), site = grasped, m.site(tool)
    frame = Rotation.from_quat(site.quat, scalar_first=True)
    body = spec.body(m.body(int(site.bodyid[0])).name).add_body(name=load)
    body.pos = site.pos + frame.apply(place)
    body.quat = (frame * turn).as_quat(scalar_first=True)
    body.gravcomp = float(m.body_gravcomp[m.body(load).id])
    _set_inertia(body, m, m.body(load).id)


def _has(m: mujoco.MjModel, kind: str, name: str) -> bool:
    """Return whether a compiled model has an element of a kind."""
    return mujoco.mj_name2id(m, OBJECTS[kind], name) >= 0


def _acts_on(m: mujoco.MjModel, added: AddedEffect) -> bool:
    """Return whether an effect acts on a compiled model in which nothing touches anything."""
    if added.effect.family == "contact":
        return False
    try:
        added.effect.check(m)
    except ModelError:
        return False
    return True
