"""Starting contact geometry: from the bodies of a scene to spheres, by farthest point sampling of surface points.

Paper, section 3.1.1 and appendix E.1. The paper centres the spheres on the surface, which inflates an object by a
radius and closes a tight hole; the default here keeps the spheres within the object.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import mujoco
import numpy as np

from concent_warp.checks import Bounds, Share, check_settings
from concent_warp.errors import ModelError, SceneError
from concent_warp.scene.scene import Scene
from concent_warp.scene.shapes.objects import MAX_EXTENT
from concent_warp.scene.shapes.surface import Surface
from concent_warp.scene.spheres.contact_geometry import ContactGeometry
from concent_warp.scene.spheres.edges import edge_spheres
from concent_warp.scene.spheres.inset import InsetCfg, inset
from concent_warp.scene.spheres.mass import MassSplitCfg, split_mass
from concent_warp.scene.spheres.sampling import farthest_point_sampling


@dataclass(frozen=True)
class ContactGeometryCfg:
    """How spheres are placed on objects.

    Example:
        >>> import concent_warp as cw
        >>> scene = cw.load_policy("shape_sorter").run.model.scene
        >>> geometry = cw.ContactGeometryCfg(count=64, candidates=2000).build(scene)
        >>> len(geometry.radius)
        64
    """

    count: Annotated[int, Bounds(1, 100_000)] = 512
    """Spheres of all objects together. More follow the shape more closely and cost simulation time."""
    split: Literal["area", "equal"] = "area"
    """Share of each object: in proportion to its surface area (the same spacing everywhere), or the same number."""
    counts: Mapping[str, Annotated[int, Bounds(1, 100_000)]] = field(default_factory=dict)
    """Number of spheres by body name; the bodies not named share what is left of `count`."""
    placement: Literal["inset", "surface"] = "inset"
    """Spheres within the object, or centred on its surface as in the paper (which inflates it by the radius)."""
    radius: Annotated[float, Bounds(0, 10, above_low=True)] | Literal["auto"] = 0.004
    """Radius [m]; "auto" makes it half the mean spacing of the object's spheres, so that neighbours touch."""
    edges: Annotated[int, Bounds(0, 100_000)] = 0
    """Further, smaller spheres along the edges of all objects, which spheres of `radius` round off; shared among the
    objects like `count`. Only for inset spheres."""
    edge_radius: Annotated[float, Bounds(0, 10, above_low=True)] = 0.0015
    """Radius of the spheres along edges [m]."""
    thin: Literal["shrink", "refuse"] = "shrink"
    """Where an object is thinner than an inset sphere: make the sphere as large as fits, or raise an error."""
    friction: Annotated[float, Bounds(0, 100)] | None = None
    """Sliding friction coefficient [-]; None takes it from the nearest geom of the body."""
    min_radius_share: Share = 0.05
    """Share of the radius below which a shrunk sphere, at a sharp edge, is not a candidate [-]: smaller ones add
    nothing to the shape. Empirical."""
    inset: InsetCfg = field(default_factory=InsetCfg)
    """How inset spheres are moved into the object."""
    mass: MassSplitCfg = field(default_factory=MassSplitCfg)
    """How the mass of a body is split over its spheres."""
    candidates: Annotated[int, Bounds(1, 10_000_000)] = 20_000
    """Surface points of each object to choose from."""
    seed: int = 0
    """Seed of the surface points."""

    def __post_init__(self) -> None:
        check_settings(self, ModelError)

    def build(
        self,
        scene: Scene,
        objects: Sequence[str] | None = None,
        *,
        surfaces: Mapping[str, Surface] | None = None,
    ) -> ContactGeometry:
        """Return spheres on bodies of a scene.

        Args:
            scene: the scene.
            objects: names of the bodies; None takes `scene.objects()`.
            surfaces: surfaces by body name to use in place of the geoms of the scene, in the body frame [m]; say of the
                point cloud that a body was made from.

        Raises `SceneError` where there is no body or no surface to sample, `ModelError` where the settings do not suit.
        """
        names = tuple(scene.objects() if objects is None else objects)
        if not names:
            raise SceneError(
                "the scene has no objects to place spheres on",
                where=scene.source,
                expected="a body with a free joint, or names in <text name='concent_objects'>",
            )
        given = surfaces or {}
        found = {name: given[name] if name in given else Surface.of_body(scene, name) for name in names}
        counts = self.share(found)
        seeds = np.random.SeedSequence(self.seed).spawn(len(names))
        return ContactGeometry.concatenate(
            [
                self.build_body(scene, name, found[name], counts[name], np.random.default_rng(seed))
                for name, seed in zip(names, seeds, strict=True)
            ]
        )

    def share(self, surfaces: Mapping[str, Surface]) -> dict[str, int]:
        """Return the number of spheres of each body; they sum to `count` unless `counts` names every body."""
        if unknown := sorted(set(self.counts) - set(surfaces)):
            raise ModelError(
                "contact geometry: counts names bodies that are no objects of the scene",
                expected=f"some of {list(surfaces)}",
                found=unknown,
            )
        rest = [name for name in surfaces if name not in self.counts]
        left = self.count - sum(self.counts.values())
        if rest and left < len(rest):
            raise ModelError(
                "contact geometry: too few spheres for the objects",
                expected=f"at least 1 for each of {rest}",
                found=left,
            )
        weight = np.array([surfaces[name].area if self.split == "area" else 1.0 for name in rest])
        extra = _apportion(left - len(rest), weight) if rest else []
        return {**self.counts, **{name: 1 + int(n) for name, n in zip(rest, extra, strict=True)}}

    def build_body(
        self, scene: Scene, name: str, surface: Surface, count: int, rng: np.random.Generator
    ) -> ContactGeometry:
        """Return `count` spheres on one body."""
        wanted = self.radius if self.radius != "auto" else _spacing(surface.area, count) / 2
        surface_points, _ = surface.sample(max(self.candidates, count), rng)
        if (extent := float(np.ptp(surface_points, axis=0).max())) > MAX_EXTENT:
            raise SceneError(
                f"body {name!r} is larger than what a robot handles, as if in millimetres",
                where=scene.source,
                expected=f"at most {MAX_EXTENT:g} m",
                found=f"{extent:.3g} m",
                fix='write sizes in metres, and scale="0.001 0.001 0.001" for a <mesh> in millimetres',
            )
        points, radius = surface_points, np.full(len(surface_points), wanted)
        if self.placement == "inset":
            points, radius = inset(surface, points, wanted, self.inset)
            if self.thin == "refuse" and radius.min() < wanted * (1 - 1e-6):
                raise ModelError(
                    f"body {name!r} is too thin for spheres of this radius within it",
                    expected=f"a radius of at most {max(radius.min(), 0):.3g} m",
                    found=f"{wanted:.3g} m",
                    fix='pass a smaller radius, thin="shrink" or placement="surface"',
                )
            roomy = radius > self.min_radius_share * wanted
            if roomy.sum() < count:
                raise ModelError(
                    f"body {name!r} has no room for {count} spheres within it", found=f"{int(roomy.sum())} places"
                )
            surface_points, points, radius = surface_points[roomy], points[roomy], radius[roomy]
        chosen = farthest_point_sampling(points, count)
        edges = round(self.edges * count / self.count) if self.placement == "inset" else 0
        extra = edge_spheres(
            surface, surface_points, (points, radius), edges, self.edge_radius,
            min_radius=self.min_radius_share * self.edge_radius, cfg=self.inset,
        )  # fmt: skip
        points, radius = np.concatenate([points[chosen], extra[0]]), np.concatenate([radius[chosen], extra[1]])
        count = len(points)
        model = scene.model
        row = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.body_iquat[row])
        axes = rotation.reshape(3, 3)
        inertia = axes @ np.diag(model.body_inertia[row]) @ axes.T
        split = split_mass(points, radius, float(model.body_mass[row]), model.body_ipos[row], inertia, self.mass)
        friction = surface.friction[surface.owner(points)] if self.friction is None else np.full(count, self.friction)
        return ContactGeometry((name,), np.zeros(count, dtype=int), points, radius, split.mass, friction)


def _spacing(area: float, count: int) -> float:
    """Return the spacing [m] of `count` points in a hexagonal lattice over an area [m^2]."""
    return float(np.sqrt(2 * area / (np.sqrt(3) * count)))


def _apportion(total: int, weight: np.ndarray) -> np.ndarray:
    """Split `total` into whole numbers in proportion to weights (n,), the largest remainders rounded up, shape (n,)."""
    ideal = total * weight / weight.sum()
    parts = np.floor(ideal).astype(int)
    order = np.argsort(parts - ideal, kind="stable")
    parts[order[: total - parts.sum()]] += 1
    return parts
