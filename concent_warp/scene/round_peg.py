"""A round peg of 30 mm and a holder with a round hole of 32 mm, on a table before the arm."""

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
class RoundPegCfg:
    """Sizes and places of peg and holder."""

    objects: ClassVar[tuple[str, str]] = ("peg", "holder")
    """Bodies of the object that is moved and of the one that it is moved to."""
    text: ClassVar[str] = "put the peg into the hole of the holder"
    """What is to be done."""
    robot: RobotCfg = field(default_factory=RobotCfg)
    """The arm."""
    peg_diameter: Length = 0.03
    """Diameter of the peg [m]."""
    peg_length: Length = 0.05
    """Length of the peg [m]."""
    peg_mass: Annotated[float, Bounds(0, 1000, above_low=True)] = 0.05
    """Mass of the peg [kg]."""
    hole_diameter: Length = 0.032
    """Diameter of the circle within the hole [m]."""
    holder_diameter: Length = 0.065
    """Diameter of the circle within the outline of the holder [m]."""
    holder_height: Length = 0.025
    """Height of the holder [m]."""
    floor: Length = 0.003
    """Thickness of the holder's floor [m]."""
    sides: Annotated[int, Bounds(6, 64)] = 20
    """Sides of the polygon that stands for the round hole."""
    friction: Annotated[float, Bounds(0, 100)] = 0.3
    """Sliding friction of the objects' surfaces [-]."""
    peg_position: tuple[Place, Place] = (0.45, -0.12)
    """Peg on the table [m]."""
    peg_yaw: Turn = 0.0
    """Rotation of the peg about the vertical [rad]."""
    holder_position: tuple[Place, Place] = (0.5, 0.08)
    """Holder on the table [m]; it is clamped there."""
    timestep: TimeStep = 0.005
    """Simulation time step [s]."""

    def build(self) -> Scene:
        """Return the scene: robot, table, peg, holder and the sensors of both objects' poses."""
        spec = tabletop(self.robot, "round_peg", self.timestep)
        surface = {"friction": [self.friction, 0.005, 0.0001]}
        half = self.peg_length / 2
        peg = add_body(spec, "peg", self.peg_position, half, self.peg_yaw, free=True)
        peg.add_geom(
            name="peg",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[self.peg_diameter / 2, half, 0],
            mass=self.peg_mass,
            rgba=[0.89, 0.47, 0.20, 1],
            **surface,
        )
        holder = add_body(spec, "holder", self.holder_position, 0.0, 0.0, free=False)
        colour = [0.25, 0.52, 0.75, 1]
        inner, outer = self.hole_diameter / 2, self.holder_diameter / 2
        holder.add_geom(
            name="holder_floor",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[outer, self.floor / 2, 0],
            pos=[0, 0, self.floor / 2],
            rgba=colour,
            **surface,
        )
        for k in range(self.sides):
            angle = 2 * np.pi * k / self.sides
            middle = (inner + outer) / 2
            holder.add_geom(
                name=f"holder_wall_{k}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=[(outer - inner) / 2, outer * np.tan(np.pi / self.sides), self.holder_height / 2],
                pos=[middle * np.cos(angle), middle * np.sin(angle), self.holder_height / 2],
                quat=[np.cos(angle / 2), 0, 0, np.sin(angle / 2)],
                rgba=colour,
                **surface,
            )
        add_objects(spec, *self.objects, goal=self.goal())
        return Scene.from_spec(spec, source="round peg")

    def placed_at(self, position: tuple[float, float], yaw: float) -> RoundPegCfg:
        """Return the task with the peg at a place on the table [m], turned by `yaw` [rad]."""
        return replace(self, peg_position=position, peg_yaw=yaw)

    def goal(self) -> np.ndarray:
        """Return where the peg is when it is in the hole, in the frame of the holder [m], shape (3,)."""
        return np.array([0.0, 0.0, self.floor + self.peg_length / 2])
