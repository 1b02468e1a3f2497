"""The paper's task (section 4.1): a 40 mm block and a box with a 42 mm square hole, on a table before the arm."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import mujoco
import numpy as np

from concent_warp.checks import Bounds, Length, Place, TimeStep, Turn
from concent_warp.scene.robot import HOME_ANGLES, RobotCfg
from concent_warp.scene.scene import OBJECTS_TEXT, Scene

TABLE_FRICTION = 0.6


@dataclass(frozen=True)
class ShapeSorterCfg:
    """Sizes and places of the shape sorter."""

    robot: RobotCfg = field(default_factory=RobotCfg)
    """The arm."""
    block_size: Length = 0.04
    """Edge of the block [m]."""
    block_mass: Annotated[float, Bounds(0, 1000, above_low=True)] = 0.08
    """Mass of the block [kg]."""
    hole_size: Length = 0.042
    """Edge of the square hole [m]."""
    box_size: Length = 0.07
    """Outer edge of the box [m]."""
    box_height: Length = 0.022
    """Height of the box [m]."""
    floor: Length = 0.003
    """Thickness of the box's floor [m]."""
    friction: Annotated[float, Bounds(0, 100)] = 0.3
    """Sliding friction of the objects' surfaces [-]."""
    block_position: tuple[Place, Place] = (0.45, -0.12)
    """Block on the table [m]."""
    block_yaw: Turn = 0.0
    """Rotation of the block about the vertical [rad]."""
    box_position: tuple[Place, Place] = (0.5, 0.08)
    """Box on the table [m]; it is clamped there."""
    box_yaw: Turn = 0.0
    """Rotation of the box about the vertical [rad]."""
    timestep: TimeStep = 0.005
    """Simulation time step [s]."""

    def build(self) -> Scene:
        """Return the scene: robot, table, block, box and the sensors of both objects' poses."""
        spec = self.robot.build()
        spec.modelname = "shape_sorter"
        spec.option.timestep = self.timestep
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 10.0
        spec.option.iterations = 50
        spec.option.ls_iterations = 50
        spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
        _add_table(spec)
        self.add_block(spec)
        self.add_box(spec)
        spec.add_text(name=OBJECTS_TEXT, data="block box")
        for body in ("block", "box"):
            for suffix, kind in (
                ("position", mujoco.mjtSensor.mjSENS_FRAMEPOS),
                ("orientation", mujoco.mjtSensor.mjSENS_FRAMEQUAT),
            ):
                spec.add_sensor(name=f"{body}_{suffix}", type=kind, objtype=mujoco.mjtObj.mjOBJ_XBODY, objname=body)
        return Scene.from_spec(spec, source="shape sorter")

    def add_block(self, spec: mujoco.MjSpec) -> None:
        """Add the free block, its frame at its centre."""
        half = self.block_size / 2
        block = spec.worldbody.add_body(
            name="block", pos=[*self.block_position, half], quat=yaw_quaternion(self.block_yaw)
        )
        block.add_freejoint(name="block_joint")
        block.add_geom(
            name="block",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[half] * 3,
            mass=self.block_mass,
            friction=[self.friction, 0.005, 0.0001],
            rgba=[0.89, 0.47, 0.20, 1],
        )

    def add_box(self, spec: mujoco.MjSpec) -> None:
        """Add the box, its frame on the table under the hole's centre; walls overlap at the corners."""
        outer, inner, height = self.box_size / 2, self.hole_size / 2, self.box_height / 2
        box = spec.worldbody.add_body(name="box", pos=[*self.box_position, 0], quat=yaw_quaternion(self.box_yaw))
        wall, centre = (outer - inner) / 2, (outer + inner) / 2
        plates = {
            "floor": ((0, 0, self.floor / 2), (outer, outer, self.floor / 2)),
            "wall_px": ((centre, 0, height), (wall, outer, height)),
            "wall_nx": ((-centre, 0, height), (wall, outer, height)),
            "wall_py": ((0, centre, height), (outer, wall, height)),
            "wall_ny": ((0, -centre, height), (outer, wall, height)),
        }
        for name, (position, size) in plates.items():
            box.add_geom(
                name=f"box_{name}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=list(position),
                size=list(size),
                friction=[self.friction, 0.005, 0.0001],
                rgba=[0.25, 0.52, 0.75, 1],
            )


def _add_table(spec: mujoco.MjSpec) -> None:
    """Add a table whose top is the plane z = 0, a light and a camera that looks at the workspace."""
    spec.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0.4, 0, -0.02],
        size=[0.6, 0.6, 0.02],
        friction=[TABLE_FRICTION, 0.005, 0.0001],
        rgba=[0.80, 0.77, 0.72, 1],
    )
    spec.worldbody.add_light(pos=[0.6, -0.4, 1.6], dir=[-0.1, 0.3, -1.0], castshadow=True)


def home(model: mujoco.MjModel) -> np.ndarray:
    """Return the scene's initial qpos (nq,) with the embedded arm in its ready pose and the gripper open."""
    qpos = model.qpos0.copy()
    for i, angle in enumerate(HOME_ANGLES):
        joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, f"joint{i + 1}")
        if joint >= 0:
            qpos[model.jnt_qposadr[joint]] = angle
    return qpos


def yaw_quaternion(yaw: float) -> list[float]:
    """Return the quaternion (wxyz) of a rotation about the vertical [rad]."""
    return [float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))]
