"""Effects of the surroundings: gravity that is not straight down, air."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.effects.effect import Effect, Parameter
from concent_warp.effects.library.joints import MUJOCO
from concent_warp.effects.select import element_name, free_bodies, unguided_body_targets
from concent_warp.scene.spheres.contact_geometry import SPHERE_GEOM_GROUP as SPHERES

AIR_DENSITY = 1.2
"""Density of air at 20 degrees [kg/m^3]."""
ROTATIONAL_DRAG = 2
"""Index of the fluid coefficient of drag against rotation."""
TILTS = (-0.02, 0.02)
"""Angles that are scanned [rad]: about a degree. Where something slides, simulated contacts are rough, and derivatives
by small angles say little."""
MIN_RADIUS = 1e-5
"""Radius of bodies on which no drag acts [m]: their drag is negligible."""


class GravityTilt(Effect):
    """Tilt of the world against gravity, as of a table or robot base that is not level."""

    name = "gravity_tilt"
    family = "world"
    kind = "none"
    summary = "Gravity is turned about the world's x and y axes."
    exact = True
    source = "geometry"
    signature = "a constant residual force along one horizontal direction"
    confusions = ("center_of_mass", "frame_offset", "wind", "anisotropic_friction")

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the one selection that there is."""
        return ((),) if np.linalg.norm(m.opt.gravity) > 0 else ()

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Angles about x and y."""
        return tuple(Parameter(axis, "rad", 0.0, -0.5, 0.5, 0.02, scan=TILTS) for axis in "xy")

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Gravity."""
        return ("opt.gravity",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Turn gravity."""
        m.opt.gravity = Rotation.from_rotvec([values[0], values[1], 0.0]).apply(m.opt.gravity)


AIR_DENSITIES = (0.6, 2.0, 10.0)
"""Densities that are scanned [kg/m^3], upward from that of air times a sphere's drag coefficient, 1.2 x 0.47: a light
ball that stops in the air within its flight is followed from there only."""


class AirEffect(Effect):
    """An effect of the air on bodies without bearings, which MuJoCo takes for ellipsoids."""

    family = "world"
    kind = "body"

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return all bodies without bearings together: there is one air."""
        found = tuple(n for (n,) in unguided_body_targets(m))
        return (found,) if found else ()

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Use the ellipsoid fluid model on the target's shape; other bodies get one of negligible size.

        A model that is in a medium already keeps its own. A ball turns almost freely in air: the friction of its skin
        is a hundredth of what MuJoCo's coefficient for blunt shapes gives.
        """
        if spec.option.density > 0 or spec.option.viscosity > 0:
            return
        for body in spec.bodies[1:]:
            if body.name in self.target:
                drawn = [geom for geom in body.geoms if geom.group != SPHERES]
                for geom in drawn or body.geoms:
                    geom.fluid_ellipsoid = True
                    if geom.type == mujoco.mjtGeom.mjGEOM_SPHERE:
                        geom.fluid_coefs[ROTATIONAL_DRAG] = 0.0
            elif not any(geom.fluid_ellipsoid for geom in body.geoms):
                body.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_SPHERE,
                    size=[MIN_RADIUS, 0, 0],
                    mass=0,
                    contype=0,
                    conaffinity=0,
                    fluid_ellipsoid=True,
                )


class AirDrag(AirEffect):
    """Resistance of the air."""

    name = "air_drag"
    summary = (
        "Drag of an ellipsoid of the body's size in still air, of a density that stands for air times drag factor."
    )
    source = f"Andersen, Pesavento, Wang, J. Fluid Mech. 541, 2005, in MuJoCo's ellipsoid fluid model ({MUJOCO})"
    signature = "residual force against the velocity, growing with its square; fast flights fall short"
    confusions = ("wind", "time_base", "length_scale", "joint_damping")

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Density times drag factor."""
        return (Parameter("density", "kg/m^3", float(m.opt.density), 0.0, 500.0, 5.0, scan=AIR_DENSITIES),)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Density of the medium."""
        return ("opt.density",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Set the density."""
        m.opt.density = max(float(values[0]), 0.0)


WIND, VERTICAL_WIND = 3.0, 0.3
"""Typical wind along each horizontal axis and upward [m/s]. Near the ground no wind crosses it: what is left upward is
turbulence, 1.25 x the friction velocity, a tenth of the wind a metre above a floor (Panofsky and Dutton, "Atmospheric
Turbulence", 1984, chapter 7)."""


class Wind(AirEffect):
    """Air that moves."""

    name = "wind"
    summary = (
        "Drag as in still air, of the body's velocity less the wind's; air of a density that the model has, or 1.2."
    )
    source = AirDrag.source
    signature = "a residual force along one direction on light bodies in flight"
    confusions = ("gravity_tilt", "air_drag")
    rarity = 6.0

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return all free bodies together: what moves in a plane rolls or slides there, hardly moved by wind."""
        found = tuple(n for b in free_bodies(m) if (n := element_name(m, mujoco.mjtObj.mjOBJ_BODY, b)))
        return (found,) if found else ()

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Velocity of the wind along each axis of the world."""
        typical = (("x", WIND), ("y", WIND), ("z", VERTICAL_WIND))
        return tuple(Parameter(axis, "m/s", 0.0, -30.0, 30.0, size, scan=(-5.0, 5.0)) for axis, size in typical)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Wind and density of the medium."""
        return ("opt.wind", "opt.density")

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Set the wind."""
        m.opt.wind = values
        m.opt.density = max(m.opt.density, AIR_DENSITY)
