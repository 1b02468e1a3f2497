"""The point on a body's surface at which an unexplained force acts.

A force f at the point p has the torque p x f. One wrench gives the line of action; wrenches of other directions in the
body's frame give the point on it; otherwise the point is where the line meets the surface with the force pushing
inward. Least squares over the windows of a phase, along what the body's contacts leave visible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from concent_warp.diagnosis.forces.cfg import ForcePlaceCfg
from concent_warp.diagnosis.forces.contact_state import Touch, extent
from concent_warp.errors import SceneError
from concent_warp.scene.shapes.surface import Surface

if TYPE_CHECKING:
    from concent_warp.diagnosis.forces.wrench import SteadyForce, Wrenches
    from concent_warp.model import Model


@dataclass(frozen=True)
class ForcePlace:
    """Where a force acts on a body, in its frame."""

    point: np.ndarray
    """[m], shape (3,)."""
    std: np.ndarray
    """Standard error of each coordinate [m], shape (3,); where the contacts hide it, the spread over the face."""
    normal: np.ndarray
    """Outward normal of the surface there, shape (3,)."""
    face: str
    """The face in words: "+x face, near its -z edge"."""
    hidden: tuple[str, ...]
    """Axes along which the point is unknown."""
    off: float
    """Distance by which the line of action misses the body [m]; 0 where it meets it."""
    against: str | None
    """Body in contact there in the model, where the force may be that contact's."""
    through_center: bool
    """Whether the line of action passes through the centre of mass, as that of weight, wind or inertia does."""

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON, SI units."""
        return {
            name: value.tolist()
            if isinstance(value, np.ndarray)
            else list(value)
            if isinstance(value, tuple)
            else value
            for name, value in vars(self).items()
        }


def force_place(
    model: Model,
    m: mujoco.MjModel,
    body: int,
    w: Wrenches,
    steady: SteadyForce,
    touches: Sequence[dict[str, Touch]],
    cfg: ForcePlaceCfg,
) -> ForcePlace | None:
    """Return where the force of a phase acts; None where torques were not measured.

    Args:
        model: The model.
        m: The same, compiled.
        body: Id of the body.
        w: Wrenches in the windows of the phase, n of them.
        steady: Their force.
        touches: Contacts of the body in these windows, n of them.
        cfg: Settings.
    """
    if not w.turned:
        return None
    point, axes, std = _line_of_action(w, steady)
    low, high = extent(m, body)
    certain = std < cfg.max_axis_error * w.size
    known, open_axes, known_std = axes[:, certain], axes[:, ~certain], std[certain]
    direction = np.einsum("nji,nj->i", w.rotation, steady.steady)
    steadiness = np.linalg.norm(direction) / max(float(np.linalg.norm(steady.steady, axis=1).sum()), 1e-12)
    direction /= max(float(np.linalg.norm(direction)), 1e-12)
    sampled = _surface_points(model, m, body, cfg.surface_points)
    reach = np.concatenate([sampled[0], np.zeros((0, 3))])
    spacing = float(np.sqrt(((high - low) ** 2).sum())) / 60
    miss = (reach - point) @ known
    distance = np.sqrt(((miss / np.hypot(known_std, spacing)) ** 2).sum(axis=1))
    near = distance < max(3.0, float(distance.min()) + 0.5)
    pushing = near & (sampled[1] @ direction < -cfg.min_inward) if steadiness > cfg.parallel_cosine else near
    chosen = pushing if pushing.any() else near
    weight = np.exp(-(distance[chosen] ** 2) / 2) + 1e-12
    spot = np.average(reach[chosen], axis=0, weights=weight)
    best = spot + known @ (known.T @ (point - spot))
    inside = known @ known.T
    spread = np.cov(reach[chosen] @ (np.eye(3) - inside), rowvar=False, aweights=weight)
    variance = np.diag(np.atleast_2d(spread)) + np.diag(known * known_std**2 @ known.T)
    normal = np.average(sampled[1][chosen], axis=0, weights=weight)
    off = float(np.sqrt((miss**2).sum(axis=1)).min()) if known.shape[1] else 0.0
    off = max(0.0, off - spacing - 3 * float(known_std.max(initial=0)))
    contact = _at_contact(w, steady, touches, point, known, known_std, direction, cfg)
    if contact is not None:
        best, normal = contact[1], -contact[2]
        variance = np.maximum(variance, contact[3] ** 2)
    centre = known.T @ (m.body_ipos[body] - point)
    half = np.maximum((high - low) / 2, 1e-6)
    error = np.sqrt(np.maximum(variance, 0))
    hidden = tuple(
        "xyz"[i]
        for i in range(3)
        if error[i] > cfg.max_coordinate_error * half[i] and np.abs(open_axes[i]).max(initial=0) > 0.3
    )
    if contact is not None:
        hidden = ()
    middle = (low + high) / 2
    return ForcePlace(
        point=best,
        std=error,
        normal=normal / max(float(np.linalg.norm(normal)), 1e-9),
        face=_face_words((best - middle) / half, normal, hidden, cfg.edge_share),
        hidden=hidden,
        off=off if off > cfg.shape_tolerance else 0.0,
        against=None if contact is None else contact[0],
        through_center=bool(
            known.shape[1] and (np.abs(centre) < np.maximum(2.5 * known_std, cfg.shape_tolerance / 2)).all()
        ),
    )


def _line_of_action(w: Wrenches, steady: SteadyForce) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the point where forces explain torques best [m] (3,), body frame; axes (3, 3) and sizes (3,) of its error.

    The torque rows of P [f, (R p) x f / size] = visible wrench are linear in p.
    """
    normal, right, square, count = np.zeros((3, 3)), np.zeros(3), 0.0, 0
    chance = np.zeros((3, 3))
    for k in range(len(w.force)):
        force = steady.each[k]
        rows = w.free[k, 3:, 3:] @ _lever(force, w.rotation[k]) / w.size
        seen = w.torque[k] / w.size - w.free[k, 3:, :3] @ force
        value, axes = np.linalg.eigh(w.covariance[k, 3:, 3:])
        kept = value > 1e-8 * max(float(value.max()), 1e-30)
        white = axes[:, kept].T / np.sqrt(value[kept])[:, None]
        for axis in steady.taken * w.std[k] * w.free[k, :3, :3]:
            apparent = white @ w.free[k, 3:, 3:] @ _lever(axis, w.rotation[k]) / w.size
            chance += apparent.T @ apparent
        rows, seen = white @ rows, white @ seen
        normal += rows.T @ rows
        right += rows.T @ seen
        square += float(seen @ seen)
        count += int(kept.sum())
    value, axes = np.linalg.eigh(normal)
    # Noise of the forces looks like forces of other directions: an axis known through it alone is unknown.
    kept = value > np.maximum(1e-6 * float(value.max()), 2 * np.einsum("ji,jk,ki->i", axes, chance, axes))
    kept &= value > 0
    point = axes[:, kept] @ ((axes[:, kept].T @ right) / value[kept])
    left = square - 2 * float(point @ right) + float(point @ normal @ point)
    scale = np.sqrt(max(1.0, left / max(count - 3, 1)))
    std = np.where(kept, scale / np.sqrt(np.where(kept, value, 1.0)), np.inf)
    return point, axes, std


def _lever(force: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return the matrix (3, 3) that takes a point in the body frame to the torque of a force (3,) there, (R p) x f."""
    cross = np.array([[0, -force[2], force[1]], [force[2], 0, -force[0]], [-force[1], force[0], 0]])
    return -cross @ rotation


def _surface_points(model: Model, m: mujoco.MjModel, body: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points on the surface of a body [m] and outward normals, (S, 3) each, in its frame.

    Of its shapes; where these have no closed surface, of its contact spheres; else of the box about it.
    """
    name = m.body(body).name
    rng = np.random.default_rng(0)
    try:
        return Surface.of_body(model.scene, name).sample(count, rng)
    except SceneError:
        if model.geometry is not None and name in model.geometry.bodies:
            rows = model.geometry.of(name)
            centre, radius = model.geometry.position[rows], model.geometry.radius[rows]
            owner = rng.choice(len(radius), count, p=radius**2 / (radius**2).sum())
            normal = rng.standard_normal((count, 3))
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            point = centre[owner] + radius[owner, None] * normal
            gap = np.linalg.norm(point[:, None] - centre, axis=2) - radius
            outer = gap.min(axis=1) > -1e-6
            return point[outer], normal[outer]
        low, high = extent(m, body)
        axis, side = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
        normal = np.eye(3)[axis] * side[:, None]
        unit = np.where(normal != 0, normal, rng.uniform(-1, 1, (count, 3)))
        return (low + high) / 2 + unit * (high - low) / 2, normal


def _at_contact(
    w: Wrenches,
    steady: SteadyForce,
    touches: Sequence[dict[str, Touch]],
    point: np.ndarray,
    known: np.ndarray,
    known_std: np.ndarray,
    direction: np.ndarray,
    cfg: ForcePlaceCfg,
) -> tuple[str, np.ndarray, np.ndarray, np.ndarray] | None:
    """Return the contact that the force may be that of: body, point, normal towards the body, spread of the point.

    Its line must pass by the contact, and point along the sliding there or along the contact's normal.
    """
    best: tuple[float, tuple[str, np.ndarray, np.ndarray, np.ndarray]] | None = None
    for name in sorted({name for t in touches for name in t}):
        rows = np.array([k for k, t in enumerate(touches) if name in t])
        if len(rows) < len(touches) / 2:
            continue
        points = np.stack([touches[k][name].point for k in rows])
        normal = np.mean([touches[k][name].normal for k in rows], axis=0)
        centre, spread = points.mean(axis=0), points.std(axis=0)
        miss = np.abs(known.T @ (centre - point))
        force, slip = steady.steady[rows], w.sliding[rows]
        length = np.linalg.norm(force, axis=1) * np.linalg.norm(slip, axis=1)
        along = float((force * slip).sum() / length.sum()) if length.sum() > 0 else 0.0
        fits = (miss < cfg.shape_tolerance + 3 * known_std + np.abs(known.T) @ spread).all()
        if fits and (abs(along) > cfg.parallel_cosine or abs(float(direction @ normal)) > cfg.parallel_cosine):
            distance = float(np.linalg.norm(miss))
            if best is None or distance < best[0]:
                best = distance, (name, centre, normal, spread)
    return None if best is None else best[1]


def _face_words(place: np.ndarray, normal: np.ndarray, hidden: Sequence[str], edge_share: float) -> str:
    """Return the face of a point in words.

    Args:
        place: Over the half extents, from the middle of the body, shape (3,).
        normal: Outward normal, shape (3,).
        hidden: Axes along which the point is unknown.
        edge_share: Coordinate over the half extent above which it is near the edge.
    """
    axis = int(np.argmax(np.abs(normal)))
    length = float(np.linalg.norm(normal))
    if length < 1e-9 or abs(normal[axis]) < 0.7 * length:
        return "its surface"
    words = f"{'+' if normal[axis] > 0 else '-'}{'xyz'[axis]} face"
    edges = [
        f"{'+' if place[i] > 0 else '-'}{'xyz'[i]}"
        for i in range(3)
        if i != axis and "xyz"[i] not in hidden and abs(place[i]) > edge_share
    ]
    if len(edges) == 2:
        return f"{words}, near its {' '.join(edges)} corner"
    return f"{words}, near its {edges[0]} edge" if edges else words
