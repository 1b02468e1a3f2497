"""Physics of Reality: exact convex shapes, elliptic cones, a shorter time step, and hidden effects.

Reality is built from the same nominal scene (positions and sizes) as the user's model, and shares none of the contact
assumptions of the models fitted to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from concent_warp.checks import Positive, TimeStep
from concent_warp.scene.scene import Scene

INTEGRATORS = {
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
}


@dataclass(frozen=True)
class HiddenEffect:
    """A change of the world that recordings do not mention; each hook is optional."""

    name: str
    edit: Callable[[mujoco.MjSpec], None] | None = None
    """Changes the world before it is compiled."""
    force: Callable[[mujoco.MjModel, mujoco.MjData], None] | None = None
    """Called before every step; may add to `qfrc_applied` and `xfrc_applied`, which are cleared before it."""
    command: Callable[[float, np.ndarray], np.ndarray] | None = None
    """Maps time [s] and the commanded control (nu,) to the control that acts."""
    measure: Callable[[str, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None
    """Maps channel name, times (T,) [s] and values (T, dim) to the recorded times and values."""


@dataclass(frozen=True)
class WorldCfg:
    """Physics of Reality."""

    timestep: TimeStep = 0.001
    """Step [s]."""
    integrator: Literal["implicitfast", "implicit", "Euler", "RK4"] = "implicitfast"
    """Integrator, named as in MJCF."""
    chamfer: float = 0.0015
    """Chamfer of the edges of free boxes and cylinders [m]."""
    solref: tuple[Positive, Positive] = (0.003, 1.0)
    """Contact time constant [s] and damping ratio [-]."""

    def build(self, scene: Scene, effects: tuple[HiddenEffect, ...] = ()) -> mujoco.MjSpec:
        """Return Reality for a nominal scene with hidden effects, ready to be compiled."""
        spec = scene.spec()
        spec.option.timestep = self.timestep
        spec.option.integrator = INTEGRATORS[self.integrator]
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 10.0
        spec.option.iterations = 100
        spec.option.ls_iterations = 50
        for name in scene.objects():
            for geom in spec.body(name).geoms:
                geom.solref = list(self.solref)
                if geom.type in CHAMFERED and spec.body(name).joints:
                    self.chamfer_geom(spec, geom)
        for effect in effects:
            if effect.edit is not None:
                effect.edit(spec)
        return spec

    def chamfer_geom(self, spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> None:
        """Replace a box or a cylinder by a convex mesh with chamfered edges, with the mass and inertia it had."""
        body = geom.parent
        place = [other is geom or other == geom for other in body.geoms].index(True)
        taken = {mesh.name for mesh in spec.meshes}
        name = f"{geom.name or f'{body.name}_geom{place}'}_chamfered"
        while name in taken:
            name += "_"
        compiled = spec.copy().compile()
        base = compiled.body(body.name).id
        row = int(compiled.body_geomadr[base]) + place
        body.explicitinertial = True
        body.mass, body.inertia = compiled.body_mass[base], compiled.body_inertia[base]
        body.ipos, body.iquat = compiled.body_ipos[base], compiled.body_iquat[base]
        mesh = spec.add_mesh(name=name)
        # The compiled geom has the pose and the size that the MJCF may state by the ends of its axis.
        geom.pos, geom.quat, geom.fromto = compiled.geom_pos[row], compiled.geom_quat[row], [np.nan] * 6
        mesh.uservert = CHAMFERED[geom.type](compiled.geom_size[row].copy(), self.chamfer).ravel()
        geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, name


def chamfered_box(half: np.ndarray, chamfer: float) -> np.ndarray:
    """Return the 24 corners [m] of a box of half sizes (3,) whose edges are cut at 45 degrees, shape (24, 3)."""
    corners = []
    for signs in np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T:
        for axis in range(3):
            inner = half - chamfer
            inner[axis] = half[axis]
            corners.append(signs * inner)
    return np.array(corners)


def chamfered_cylinder(size: np.ndarray, chamfer: float, sides: int = 48) -> np.ndarray:
    """Return the corners [m] of a prism about the z axis whose ends are cut at 45 degrees, shape (4 * sides, 3).

    Args:
        size: Radius of the circle around the prism and half its length [m], shape (2,) or longer.
        chamfer: Chamfer of both ends [m].
        sides: Sides of the prism.
    """
    angle = 2 * np.pi * np.arange(sides) / sides
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(sides)])
    rings = ((size[0], size[1] - chamfer), (size[0] - chamfer, size[1]))
    up = np.array([0, 0, 1.0])
    return np.concatenate([radius * circle + sign * height * up for radius, height in rings for sign in (-1, 1)])


CHAMFERED = {
    mujoco.mjtGeom.mjGEOM_BOX: chamfered_box,
    mujoco.mjtGeom.mjGEOM_CYLINDER: chamfered_cylinder,
}
"""Corners of what stands for a geom of a kind, by half sizes as in MJCF [m], shape (3,), and chamfer [m]."""
