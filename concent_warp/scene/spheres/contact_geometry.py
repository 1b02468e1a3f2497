"""Contact geometry: the sphere primitives C = {c_i} of each object (paper, section 3.1.1).

Spheres belong to bodies of the scene by name. A body that carries spheres collides through them alone: its own geoms
stay for looks and for the sampling of surface points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from concent_warp.array_file import read_arrays, write_arrays
from concent_warp.errors import ModelError

SPHERE_GEOM_GROUP = 3
"""MuJoCo geom group of the spheres (3: collision geoms, by convention hidden in the viewer)."""
LARGEST = {"position": 1e3, "radius": 1e3, "mass": 1e9, "friction": 1e9}
"""Largest magnitudes of a sphere's numbers, in SI units: far beyond what a scene holds."""


@dataclass(frozen=True)
class ContactGeometry:
    """S spheres on B bodies.

    Example:
        >>> import concent_warp as cw
        >>> geometry = cw.load_policy("shape_sorter").run.model.geometry
        >>> geometry.bodies, geometry.position.shape
        (('block', 'box'), (912, 3))
    """

    bodies: tuple[str, ...]
    """Names of the bodies, in the order of `body`."""
    body: np.ndarray
    """Index into `bodies`, shape (S,), int."""
    position: np.ndarray
    """Centres in the body frame [m], shape (S, 3)."""
    radius: np.ndarray
    """Radii [m], shape (S,)."""
    mass: np.ndarray
    """Masses [kg], shape (S,); they sum to the body's mass and keep its centre of mass and inertia."""
    friction: np.ndarray
    """Sliding friction coefficients [-], shape (S,)."""

    def __post_init__(self) -> None:
        count = len(self.radius) if np.ndim(self.radius) else -1
        for name, kinds in (("body", "iu"), *((n, "iuf") for n in ("position", "radius", "mass", "friction"))):
            kind = np.asarray(getattr(self, name)).dtype
            if kind.kind not in kinds:
                raise ModelError(
                    f"contact geometry: wrong kind of {name}",
                    expected="whole numbers" if kinds == "iu" else "numbers",
                    found=kind,
                )
        if len(set(self.bodies)) < len(self.bodies):
            raise ModelError("contact geometry: two bodies have the same name", found=list(self.bodies))
        shapes = {"body": (count,), "position": (count, 3), "mass": (count,), "friction": (count,)}
        for name, shape in shapes.items():
            found = np.shape(getattr(self, name))
            if found != shape:
                raise ModelError(f"contact geometry: wrong shape of {name}", expected=shape, found=found)
        for name, largest in LARGEST.items():
            values = getattr(self, name)
            if not np.isfinite(values).all():
                raise ModelError(
                    f"contact geometry: {name} holds values that are not finite", expected="finite numbers"
                )
            if count and np.abs(values).max() > largest:
                raise ModelError(
                    f"contact geometry: {name} is too large",
                    expected=f"at most {largest:g}",
                    found=f"{np.abs(values).max():g}",
                    fix="check the units, which are m and kg",
                )
        if count and (self.radius <= 0).any():
            worst = int(np.argmin(self.radius))
            raise ModelError(
                "contact geometry: a radius is not positive",
                expected="> 0 m",
                found=f"{self.radius[worst]:g} m at sphere {worst}",
            )
        for name, unit in (("mass", "kg"), ("friction", "")):
            values = getattr(self, name)
            if count and values.min() < 0:
                worst = int(np.argmin(values))
                raise ModelError(
                    f"contact geometry: a {name} is negative",
                    expected=f">= 0 {unit}".rstrip(),
                    found=f"{values[worst]:g} at sphere {worst}",
                )
        if count and ((self.body < 0) | (self.body >= len(self.bodies))).any():
            raise ModelError(
                "contact geometry: a sphere names a body that does not exist", expected=f"0..{len(self.bodies) - 1}"
            )

    def __len__(self) -> int:
        return len(self.radius)

    def of(self, body: str) -> np.ndarray:
        """Return the indices of the spheres of a body, shape (n,)."""
        return np.flatnonzero(self.body == self.bodies.index(body))

    def names(self) -> list[str]:
        """Return the geom name of each sphere, ``<body>_sphere<k>`` with k counting within its body."""
        names = [""] * len(self)
        for body in self.bodies:
            for k, i in enumerate(self.of(body)):
                names[i] = f"{body}_sphere{k}"
        return names

    def with_position(self, position: np.ndarray) -> ContactGeometry:
        """Return a copy with other centres [m], shape (S, 3)."""
        return replace(self, position=np.array(position, dtype=float))

    @staticmethod
    def concatenate(parts: Sequence[ContactGeometry]) -> ContactGeometry:
        """Join the geometries of different bodies into one."""
        bodies = tuple(name for part in parts for name in part.bodies)
        offsets = np.cumsum([0] + [len(part.bodies) for part in parts])
        return ContactGeometry(
            bodies=bodies,
            body=np.concatenate([part.body + offset for part, offset in zip(parts, offsets, strict=False)]),
            position=np.concatenate([part.position for part in parts]),
            radius=np.concatenate([part.radius for part in parts]),
            mass=np.concatenate([part.mass for part in parts]),
            friction=np.concatenate([part.friction for part in parts]),
        )

    def save(self, path: str | Path) -> None:
        """Write an ``.npz`` file, in one piece or not at all."""
        arrays = {name: getattr(self, name) for name in ("body", "position", "radius", "mass", "friction")}
        write_arrays(Path(path), {"bodies": np.array(self.bodies), **arrays}, compressed=True)

    @staticmethod
    def load(path: Path) -> ContactGeometry:
        """Read what `save` wrote."""
        if not path.is_file():
            raise ModelError("the contact geometry is missing", where=path, expected="a .npz file")
        names = ("bodies", "body", "position", "radius", "mass", "friction")
        arrays = read_arrays(path, names, kind="a contact geometry written by concent", error=ModelError)
        bodies = arrays.pop("bodies")
        if bodies.ndim != 1 or bodies.dtype.kind != "U":
            raise ModelError(
                "not a contact geometry", where=path, expected="names of bodies", found=f"{bodies.shape} {bodies.dtype}"
            )
        try:
            geometry = ContactGeometry(bodies=tuple(str(name) for name in bodies), **arrays)
        except ModelError as error:
            raise ModelError(str(error).rstrip("."), where=path) from None
        if not len(geometry):
            raise ModelError("the contact geometry has no spheres", where=path, expected="at least one")
        return geometry

    def attach(
        self,
        spec: mujoco.MjSpec,
        *,
        solref: Sequence[float],
        solimp: Sequence[float],
        condim: int,
        collidable: np.ndarray | None = None,
    ) -> None:
        """Add the spheres to a spec and take the other geoms of their bodies out of the collisions.

        `solref`, `solimp` and `condim` are MuJoCo's contact parameters of the spheres. `collidable`, shape (S,) bool,
        leaves out the spheres that are False. The spheres are massless in the spec: each body keeps the inertia that
        the scene gives it (sphere masses sum to the same, and count where a geometry is exported on its own).
        """
        base = spec.copy().compile()
        for name in self.bodies:
            body = spec.body(name)
            if body is None:
                known = [b.name for b in spec.bodies]
                raise ModelError(
                    f"the contact geometry names a body {name!r} that the scene lacks", expected=f"one of {known}"
                )
            row = base.body(name).id
            body.explicitinertial = True
            body.mass, body.inertia = base.body_mass[row], base.body_inertia[row]
            body.ipos, body.iquat = base.body_ipos[row], base.body_iquat[row]
            for geom in body.geoms:
                geom.contype = geom.conaffinity = 0
        for i, name in enumerate(self.names()):
            if collidable is not None and not collidable[i]:
                continue
            spec.body(self.bodies[self.body[i]]).add_geom(
                name=name,
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[self.radius[i], 0, 0],
                pos=self.position[i],
                mass=0,
                friction=[self.friction[i], 0.005, 0.0001],
                group=SPHERE_GEOM_GROUP,
                condim=condim,
                solref=list(solref),
                solimp=[*solimp, 0.5, 2.0],
                rgba=[0.2, 0.7, 0.9, 0.5],
            )
