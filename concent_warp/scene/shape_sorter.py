"""The paper's task (section 4.1): a 40 mm block and a box with a 42 mm square hole, on a table before the arm."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import mujoco
import numpy as np

from concent_warp.checks import Bounds, Length, Place, TimeStep, Turn
from concent_warp.scene.robot import HOME_ANGLES, RobotCfg
from concent_warp.scene.scene import Scene
from concent_warp.scene.tabletop import add_body, add_objects, tabletop


@dataclass(frozen=True)
class ShapeSorterCfg:
    """Sizes and places of the shape sorter."""

    objects: ClassVar[tuple[str, str]] = ("block", "box")
    """Bodies of the object that is moved and of the one that it is moved to."""
    text: ClassVar[str] = "put the block into the hole of the box"
    """What is to be done."""
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
        spec = tabletop(self.robot, "shape_sorter", self.timestep)
        self.add_block(spec)
        self.add_box(spec)
        add_objects(spec, *self.objects)
        return Scene.from_spec(spec, source="shape sorter")

    def placed_at(self, position: tuple[float, float], yaw: float) -> ShapeSorterCfg:
        """Return the task with the block at a place on the table [m], turned by `yaw` [rad]."""
        return replace(self, block_position=position, block_yaw=yaw)

    def goal(self) -> np.ndarray:
        """Return where the block is when it is in the hole, in the frame of the box [m], shape (3,)."""
        return np.array([0.0, 0.0, self.floor + self.block_size / 2])

    def add_block(self, spec: mujoco.MjSpec) -> None:
        """Add the free block, its frame at its centre."""
        half = self.block_size / 2
        block = add_body(spec, "block", self.block_position, half, self.block_yaw, free=True)
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
        box = add_body(spec, "box", self.box_position, 0.0, self.box_yaw, free=False)
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


def home(model: mujoco.MjModel) -> np.ndarray:
    """Return the scene's initial qpos (nq,) with the embedded arm in its ready pose and the gripper open."""
    qpos = model.qpos0.copy()
    for i, angle in enumerate(HOME_ANGLES):
        joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, f"joint{i + 1}")
        if joint >= 0:
            qpos[model.jnt_qposadr[joint]] = angle
    return qpos
