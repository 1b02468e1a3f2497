"""What the tasks on a table have in common: the arm, the table, and two objects whose poses are measured."""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.scene.robot import RobotCfg
from concent_warp.scene.scene import GOAL_NUMERIC, OBJECTS_TEXT

TABLE_FRICTION = 0.6


def tabletop(robot: RobotCfg, name: str, timestep: float) -> mujoco.MjSpec:
    """Return a scene of the arm and a table whose top is the plane z = 0.

    Args:
        robot: The arm.
        name: Name of the scene.
        timestep: Simulation time step [s].
    """
    spec = robot.build()
    spec.modelname = name
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.option.iterations = 50
    spec.option.ls_iterations = 50
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    spec.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0.4, 0, -0.02],
        size=[0.6, 0.6, 0.02],
        friction=[TABLE_FRICTION, 0.005, 0.0001],
        rgba=[0.80, 0.77, 0.72, 1],
    )
    spec.worldbody.add_light(pos=[0.6, -0.4, 1.6], dir=[-0.1, 0.3, -1.0], castshadow=True)
    return spec


def add_objects(spec: mujoco.MjSpec, moved: str, other: str, goal: np.ndarray | None = None) -> None:
    """State which bodies are the objects, and add sensors of their poses.

    Args:
        spec: The scene with both bodies, changed in place.
        moved: The object that is moved.
        other: The object that it is moved to.
        goal: Where it is when the task is done, in the frame of the other [m], shape (3,).
    """
    spec.add_text(name=OBJECTS_TEXT, data=f"{moved} {other}")
    if goal is not None:
        spec.add_numeric(name=GOAL_NUMERIC, data=list(goal), size=3)
    for body in (moved, other):
        for suffix, kind in (
            ("position", mujoco.mjtSensor.mjSENS_FRAMEPOS),
            ("orientation", mujoco.mjtSensor.mjSENS_FRAMEQUAT),
        ):
            spec.add_sensor(name=f"{body}_{suffix}", type=kind, objtype=mujoco.mjtObj.mjOBJ_XBODY, objname=body)


def add_body(
    spec: mujoco.MjSpec, name: str, position: tuple[float, float], height: float, yaw: float, *, free: bool
) -> mujoco.MjsBody:
    """Return a new body above a place on the table.

    Args:
        spec: The scene, changed in place.
        name: Its name.
        position: Place on the table [m].
        height: Height of its origin [m].
        yaw: Rotation about the vertical [rad].
        free: Whether it moves freely; its joint is then called ``<name>_joint``.
    """
    body = spec.worldbody.add_body(name=name, pos=[*position, height], quat=yaw_quaternion(yaw))
    if free:
        body.add_freejoint(name=f"{name}_joint")
    return body


def yaw_quaternion(yaw: float) -> list[float]:
    """Return the quaternion (wxyz) of a rotation about the vertical [rad]."""
    return [float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))]
