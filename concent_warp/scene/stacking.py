"""Two blocks on a table before the arm, of which one is put on the other."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import mujoco
import numpy as np

from concent_warp.checks import Bounds, Length, Place, TimeStep, Turn
from concent_warp.scene.robot import RobotCfg
from concent_warp.scene.scene import Scene
from concent_warp.scene.tabletop import add_body, add_objects, tabletop


@dataclass(frozen=True)
class StackingCfg:
    """Sizes and places of the two blocks."""

    objects: ClassVar[tuple[str, str]] = ("block", "base")
    """Bodies of the object that is moved and of the one that it is moved to."""
    text: ClassVar[str] = "put the block on the base"
    """What is to be done."""
    robot: RobotCfg = field(default_factory=RobotCfg)
    """The arm."""
    block_size: Length = 0.04
    """Edge of the block [m]."""
    block_mass: Annotated[float, Bounds(0, 1000, above_low=True)] = 0.08
    """Mass of the block [kg]."""
    base_size: tuple[Length, Length, Length] = (0.05, 0.05, 0.03)
    """Edges of the base [m]."""
    base_mass: Annotated[float, Bounds(0, 1000, above_low=True)] = 0.15
    """Mass of the base [kg]."""
    friction: Annotated[float, Bounds(0, 100)] = 0.3
    """Sliding friction of the objects' surfaces [-]."""
    block_position: tuple[Place, Place] = (0.45, -0.12)
    """Block on the table [m]."""
    block_yaw: Turn = 0.0
    """Rotation of the block about the vertical [rad]."""
    base_position: tuple[Place, Place] = (0.5, 0.08)
    """Base on the table [m]; it can be pushed."""
    base_yaw: Turn = 0.0
    """Rotation of the base about the vertical [rad]."""
    timestep: TimeStep = 0.005
    """Simulation time step [s]."""

    def build(self) -> Scene:
        """Return the scene: robot, table, both blocks and the sensors of their poses."""
        spec = tabletop(self.robot, "stacking", self.timestep)
        edges = {"block": (self.block_size,) * 3, "base": self.base_size}
        for name, position, yaw, mass, colour in (
            ("block", self.block_position, self.block_yaw, self.block_mass, [0.89, 0.47, 0.20, 1]),
            ("base", self.base_position, self.base_yaw, self.base_mass, [0.25, 0.52, 0.75, 1]),
        ):
            body = add_body(spec, name, position, edges[name][2] / 2, yaw, free=True)
            body.add_geom(
                name=name,
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=[edge / 2 for edge in edges[name]],
                mass=mass,
                friction=[self.friction, 0.005, 0.0001],
                rgba=colour,
            )
        add_objects(spec, *self.objects, goal=self.goal())
        return Scene.from_spec(spec, source="stacking")

    def placed_at(self, position: tuple[float, float], yaw: float) -> StackingCfg:
        """Return the task with the block at a place on the table [m], turned by `yaw` [rad]."""
        return replace(self, block_position=position, block_yaw=yaw)

    def goal(self) -> np.ndarray:
        """Return where the block is when it is on the base, in the frame of the base [m], shape (3,)."""
        return np.array([0.0, 0.0, (self.base_size[2] + self.block_size) / 2])
