"""Virtual collision penalty (VCP): distances in place of contacts, for the spheres left out of the physics.

From the paper, section 3.2.2 and appendix C. A left-out sphere with centre x and radius r collides with a target when
the signed distance D of x to the target falls below r. With the gap g = D(x) - r of a sphere to a target, a margin m
and a gate,

    depth = max(-g, 0)                              how deep the sphere is in the target
    band  = gate * clamp((m - g) / m, 0, 1)^2       from 0 at the margin to 1 in touch, and no further
    r^vcp = -(depth_weight sum(depth) + band_weight sum(band) + severe_penalty [some depth > severe])

summed over all spheres and targets that are paired. One depth beyond `severe` ends the episode. The gate of a pair is a
number for each stage: 0 where the stage is to bring the two together, so that only penetration is penalised.

Targets move with bodies, and sphere centres are taken into the target's frame, so that nothing is rebuilt. A target is

- a triangle mesh. The winding number determines which side of it a point is on. The pseudo-normal of the nearest face,
  which is cheaper, is wrong for meshes that overlap themselves (a box made of plates: the nearest face may lie within
  another plate) or are open (behind the rim of a hole, everything would be inside); on one closed surface both agree.
- or the spheres of another object, whose distance is that of their union: the least |x - c_j| - r_j.

Quaternions are wxyz, stored in `wp.quat` as four plain numbers, as in MuJoCo-Warp.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from .contact_pairs import check_poses
from .virtual_collision_kernel import CollisionTables, collision_kernel

THREADS = 128
"""Threads of a world's block on CUDA."""


@dataclass(frozen=True)
class SphereSet:
    """Spheres fixed in the frame of a body."""

    body: int
    """Id of the body."""
    centre: np.ndarray
    """Centres [m], body frame, shape (n, 3)."""
    radius: np.ndarray
    """Radii [m], shape (n,)."""

    def __post_init__(self) -> None:
        count = len(self.radius)
        if np.shape(self.radius) != (count,) or np.shape(self.centre) != (count, 3) or not count:
            raise ValueError(
                "SphereSet: centre and radius must be of shapes (n, 3) and (n,), n > 0, found "
                f"{np.shape(self.centre)} and {np.shape(self.radius)}."
            )
        if not (np.isfinite(self.centre).all() and np.isfinite(self.radius).all() and np.min(self.radius) >= 0):
            raise ValueError("SphereSet: centres and radii must be finite, and radii not negative.")


@dataclass(frozen=True)
class TargetMesh:
    """A triangle mesh fixed in the frame of a body; it may overlap itself, and may have holes."""

    body: int
    """Id of the body."""
    vertices: np.ndarray
    """Vertices [m], body frame, shape (v, 3)."""
    faces: np.ndarray
    """Vertex indices, counter-clockwise seen from outside, shape (f, 3)."""

    def __post_init__(self) -> None:
        vertices, faces = np.asarray(self.vertices, dtype=float), np.asarray(self.faces)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
            raise ValueError(
                "TargetMesh: vertices and faces must be of shapes (v, 3) and (f, 3), f > 0, found "
                f"{vertices.shape} and {faces.shape}."
            )
        if not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
            raise ValueError("TargetMesh: vertices must be finite, and faces must index them.")
        corners = vertices[faces] - vertices.mean(axis=0)
        if np.linalg.det(corners).sum() < 0:
            raise ValueError("TargetMesh: the faces point inwards; reverse the order of their vertices.")


@dataclass(frozen=True)
class VirtualPair:
    """Which spheres must keep clear of which target."""

    spheres: int
    """Index into `spheres` of `VirtualCollision`."""
    target: int
    """Index into `targets`."""
    margin: float = 0.002
    """Width of the margin band [m]; 0 for none."""
    severe: float = 0.01
    """Depth of one sphere beyond which the episode ends [m]."""
    gate: tuple[float, ...] | None = None
    """Weight of the margin band in each stage, shape (S,); None for 1 in all stages."""


class VirtualCollision:
    """The penalty of W worlds, with buffers of its own: nothing is allocated in `launch`.

    `launch` may be recorded by `wp.ScopedCapture`; it reads the arrays given to the constructor, and never waits. Sums
    run in a fixed order: equal inputs give equal results, bit by bit.

    Args:
        spheres: spheres left out of the physics, one set for each body that carries some.
        targets: meshes, and spheres of other objects (left out or not).
        pairs: which sets of spheres must keep clear of which targets.
        xpos: body origins [m], `wp.vec3`, shape (W, nbody), as in MuJoCo-Warp's data.
        xquat: body orientations, `wp.quat` holding wxyz, shape (W, nbody).
        stage: stage of each world, int32, shape (W,); only the gates read it. Beyond 0..S-1 all gates are 0.
        stages: S, the number of stages.
        depth_weight: penalty for each metre of depth [1/m].
        band_weight: penalty of a sphere in touch, at the inner end of its margin band [-].
        severe_penalty: penalty of a world that ends by a severe penetration [-].
        gaps: also write `gap`.
        threads: threads of a world's block on CUDA; no effect on a CPU.

    Raises:
        ValueError: if an array has another shape, type or device than stated, or an index or length cannot be.
    """

    reward: wp.array
    """r^vcp, 0 or less [-], float32, shape (W,); like all that follow 0 where `finite` is 0."""
    penetration: wp.array
    """Sum of depths [m], float32, shape (W,)."""
    band: wp.array
    """Sum of the gated margin bands [-], float32, shape (W,)."""
    deepest: wp.array
    """Largest depth of one sphere in one target [m], float32, shape (W,)."""
    deepest_pair: wp.array
    """Index of its pair, the first of equals, int32, shape (W,); -1 where nothing penetrates or a pose is not
    finite."""
    severe: wp.array
    """1 where some depth is beyond its pair's `severe`, int32, shape (W,): the episode is to end."""
    finite: wp.array
    """1 where the poses of all bodies concerned are sane, 0 where one is not finite or beyond 1e5 m, int32, shape
    (W,)."""
    gap: wp.array | None
    """Gap of each sphere to each of its targets [m], pair by pair, float32, shape (W, sum of spheres of the pairs);
    infinite where it is not below the margin. None unless asked for."""

    def __init__(
        self,
        spheres: Sequence[SphereSet],
        targets: Sequence[SphereSet | TargetMesh],
        pairs: Sequence[VirtualPair],
        xpos: wp.array,
        xquat: wp.array,
        stage: wp.array,
        *,
        stages: int,
        depth_weight: float = 10.0,
        band_weight: float = 0.01,
        severe_penalty: float = 10.0,
        gaps: bool = False,
        threads: int = THREADS,
    ) -> None:
        check_poses("VirtualCollision", xpos, xquat, stage)
        for item in (*spheres, *targets):
            if not 0 <= item.body < xpos.shape[1]:
                raise ValueError(f"VirtualCollision: a body must be in 0..{xpos.shape[1] - 1}, found {item.body}.")
        for pair in pairs:
            check_pair(pair, len(spheres), len(targets), stages)
        device, worlds = xpos.device, xpos.shape[0]
        self._meshes = [build_mesh(t, device) if isinstance(t, TargetMesh) else None for t in targets]
        self._tables = build_tables(spheres, targets, pairs, self._meshes, stages, device)
        self._inputs = (xpos, xquat, stage, float(depth_weight), float(band_weight), float(severe_penalty))
        self._threads = threads
        self.reward, self.penetration, self.band, self.deepest = (
            wp.zeros(worlds, dtype=float, device=device) for _ in range(4)
        )
        self.deepest_pair, self.severe, self.finite = (
            wp.zeros(worlds, dtype=wp.int32, device=device) for _ in range(3)
        )
        rows = sum(len(spheres[pair.spheres].radius) for pair in pairs)
        self.gap = wp.zeros((worlds, rows), dtype=float, device=device) if gaps else None
        self._gap = wp.empty((0, 0), dtype=float, device=device) if self.gap is None else self.gap
        wp.load_module(collision_kernel.module, device=device, block_dim=threads)

    def launch(self) -> None:
        """Write all outputs, on the current stream of the device."""
        if self.gap is not None:
            self.gap.fill_(np.inf)
        wp.launch_tiled(
            collision_kernel,
            dim=[self.reward.shape[0]],
            inputs=[*self._inputs, self._tables],
            outputs=[
                self.reward,
                self.penetration,
                self.band,
                self.deepest,
                self.deepest_pair,
                self.severe,
                self.finite,
                self._gap,
            ],
            block_dim=self._threads,
            device=self.reward.device,
        )


def check_pair(pair: VirtualPair, spheres: int, targets: int, stages: int) -> None:
    """Raise `ValueError` unless a pair is one of these spheres and targets, with a gate for each stage."""
    if not (0 <= pair.spheres < spheres and 0 <= pair.target < targets):
        raise ValueError(
            f"VirtualCollision: a pair is of set {pair.spheres} and target {pair.target}, but there are "
            f"{spheres} sets and {targets} targets."
        )
    if not (pair.margin >= 0 and pair.severe >= 0):
        raise ValueError(
            f"VirtualCollision: margin and severe must be 0 m or more, found {pair.margin} and {pair.severe}."
        )
    if pair.gate is not None and len(pair.gate) != stages:
        raise ValueError(f"VirtualCollision: a gate must have {stages} stages, found {len(pair.gate)}.")


def build_mesh(target: TargetMesh, device: wp.Device) -> wp.Mesh:
    """Return a mesh with its search tree and what the winding number needs."""
    return wp.Mesh(
        points=wp.array(np.asarray(target.vertices), dtype=wp.vec3, device=device),
        indices=wp.array(np.asarray(target.faces).ravel(), dtype=wp.int32, device=device),
        support_winding_number=True,
    )


def build_tables(
    spheres: Sequence[SphereSet],
    targets: Sequence[SphereSet | TargetMesh],
    pairs: Sequence[VirtualPair],
    meshes: Sequence[wp.Mesh | None],
    stages: int,
    device: wp.Device,
) -> CollisionTables:
    """Return the tables on the device."""
    boxes = np.array([bounding_box(target) for target in targets]).reshape(-1, 2, 3)
    centres = [np.mean([s.centre.min(axis=0), s.centre.max(axis=0)], axis=0) for s in spheres]
    radii = [(np.linalg.norm(s.centre - c, axis=1) + s.radius).max() for s, c in zip(spheres, centres, strict=True)]
    counts = [len(s.radius) for s in spheres]
    target_spheres = [
        np.column_stack([t.centre, t.radius]) if isinstance(t, SphereSet) else np.empty((0, 4)) for t in targets
    ]
    rows = np.cumsum([0, *(counts[pair.spheres] for pair in pairs)])
    gates = [np.ones(stages) if pair.gate is None else pair.gate for pair in pairs]
    tables = CollisionTables()

    def on_device(values: object, dtype: type, shape: tuple[int, ...] = (-1,)) -> wp.array:
        return wp.array(np.asarray(values).reshape(shape), dtype=dtype, device=device)

    tables.pair_set = on_device([pair.spheres for pair in pairs], wp.int32)
    tables.pair_target = on_device([pair.target for pair in pairs], wp.int32)
    tables.pair_row = on_device(rows[:-1], wp.int32)
    tables.margin = on_device([pair.margin for pair in pairs], wp.float32)
    tables.severe = on_device([pair.severe for pair in pairs], wp.float32)
    tables.gate = on_device(np.array(gates).reshape(-1, stages).T.copy(), wp.float32, (stages, len(pairs)))
    tables.set_body = on_device([s.body for s in spheres], wp.int32)
    tables.set_first = on_device(np.cumsum([0, *counts]), wp.int32)
    tables.set_centre = on_device(centres, wp.vec3, (-1, 3))
    tables.set_radius = on_device(radii, wp.float32)
    tables.centre = on_device(np.concatenate([np.empty((0, 3)), *(s.centre for s in spheres)]), wp.vec3, (-1, 3))
    tables.radius = on_device(np.concatenate([np.empty(0), *(s.radius for s in spheres)]), wp.float32)
    tables.target_body = on_device([t.body for t in targets], wp.int32)
    tables.mesh = on_device([0 if mesh is None else int(mesh.id) for mesh in meshes], wp.uint64)
    tables.inside = on_device(0.501 * np.ptp(boxes, axis=1).min(axis=1), wp.float32)
    tables.lower = on_device(boxes[:, 0], wp.vec3, (-1, 3))
    tables.upper = on_device(boxes[:, 1], wp.vec3, (-1, 3))
    tables.target_first = on_device(np.cumsum([0, *map(len, target_spheres)]), wp.int32)
    tables.target_sphere = on_device(np.concatenate([np.empty((0, 4)), *target_spheres]), wp.vec4, (-1, 4))
    return tables


def bounding_box(target: SphereSet | TargetMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper corner of a target [m], body frame, each of shape (3,)."""
    if isinstance(target, SphereSet):
        r = np.asarray(target.radius)[:, None]
        return (target.centre - r).min(axis=0), (target.centre + r).max(axis=0)
    used = np.asarray(target.vertices)[np.unique(target.faces)]
    return used.min(axis=0), used.max(axis=0)
