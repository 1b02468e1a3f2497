"""Refinement of a pose in the frames of one moment, and whether the result agrees with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.perception.tracking.alignment.rows import MAD, Crop, Normal, depth_rows, edge_rows, rendered_crop
from concent_warp.perception.tracking.alignment.texture import Keyframe, common_shift, texture_rows
from concent_warp.perception.tracking.cfg import AcceptCfg, AlignCfg, TextureCfg
from concent_warp.perception.tracking.geometry.pose import moved, twist_between
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.symmetry import Symmetry
from concent_warp.perception.tracking.geometry.view import View

FREE = np.diag([1 / 0.1**2] * 3 + [1 / 1.0**2] * 3)
"""Information on a pose of which nothing is known [1/m^2, 1/rad^2]: 0.1 m and 1 rad, so that equations can be
solved."""
SQUARE = 7
"""Edge of the squares over which differences of depth are averaged [px]."""


@dataclass(frozen=True)
class Fit:
    """A pose and what one moment's frames say about it, linearised there."""

    pose: np.ndarray
    """Shape (4, 4)."""
    geometry: Normal
    """Depth and edges."""
    texture: list[tuple[int, Normal]]
    """Texture points, each with the number of its keyframe."""
    depth_std: float
    """Scatter of depth [m]."""
    edge_share: float
    """Share of the contour at which the image has an edge."""
    texture_correlation: float
    """Mean correlation of the keyframe's patches."""
    edge_std: float
    """Scatter of edges [px]."""
    texture_std: float
    """Scatter of texture points [px]."""
    agreement: Agreement | None = None
    """How the frames agree with the pose, where that was asked."""

    def position_std(self) -> float:
        """Return the standard deviation of the position along the worst direction [m], common errors aside."""
        information = self.geometry.information + sum(n.information for _, n in self.texture) + 1e-3 * FREE
        return float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(information)[:3, :3])[-1]))


@dataclass(frozen=True)
class Agreement:
    """How a pose agrees with one moment's frames."""

    pixels: int
    """Pixels that agree."""
    share: float
    """Their share of those with depth that nothing known covers [-]."""
    behind: float
    """Share that sees through the object [-]."""
    unexplained: float
    """Share of the pixels around it that are as near and unknown [-]."""
    visible: float
    """Share of the outline that nothing known covers [-]."""
    misfit: float = 0.0
    """Scatter of the depth's difference, averaged over squares of pixels [m]: noise averages out, a wrong shape or
    pose does not."""
    depth_std: float = 0.0
    """Scatter of the depth's difference by pixel [m]."""
    penetration: float = 0.0
    """How deep it is in other bodies [m]."""

    def accepted(self, cfg: AcceptCfg) -> bool:
        """Return whether this is agreement enough."""
        return not self.objections(cfg)

    def objections(self, cfg: AcceptCfg, *, followed: bool = False) -> list[str]:
        """Return what speaks against the pose, in words; nothing where this is agreement enough.

        Args:
            cfg: Thresholds.
            followed: Whether the body was seen nearby just before.
        """
        deepest = cfg.max_followed_penetration if followed else cfg.max_penetration
        misfit = max(cfg.max_misfit, cfg.max_misfit_share * self.depth_std)
        checks = (
            (
                self.visible >= cfg.min_visible,
                f"known bodies leave {self.visible:.0%} of it in view (at least {cfg.min_visible:.0%})",
            ),
            (
                self.share >= cfg.min_agreement,
                f"{self.share:.0%} of its pixels agree with the depth (at least {cfg.min_agreement:.0%})",
            ),
            (self.behind <= cfg.max_behind, f"{self.behind:.0%} see through it (at most {cfg.max_behind:.0%})"),
            (
                self.unexplained <= cfg.max_unexplained,
                f"{self.unexplained:.0%} of its surroundings are unexplained (at most {cfg.max_unexplained:.0%})",
            ),
            (
                self.misfit <= misfit,
                f"its surface is off by {1e3 * self.misfit:.1f} mm (at most {1e3 * misfit:.1f})",
            ),
            (
                self.penetration <= deepest,
                f"it is {1e3 * self.penetration:.1f} mm inside others (at most {1e3 * deepest:g})",
            ),
        )
        found = [words for passed, words in checks if not passed]
        if not found and not self.pixels >= cfg.min_pixels:
            found.append(f"{self.pixels} pixels agree (at least {cfg.min_pixels})")
        return found

    def text(self) -> str:
        """Return this in words."""
        return (
            f"{self.pixels} pixels agree, {self.share:.0%} of those in view; {self.behind:.0%} see through it; "
            f"{self.unexplained:.0%} of the surroundings are unexplained; {self.visible:.0%} of it in view; "
            f"its surface is off by {1e3 * self.misfit:.1f} mm and {1e3 * self.penetration:.1f} mm inside others"
        )


def refine(
    renderer: RayRenderer,
    views: Sequence[View],
    shape: TrackedShape,
    pose: np.ndarray,
    cfg: AlignCfg,
    *,
    prior: np.ndarray | None = None,
    keyframes: Sequence[tuple[int, Keyframe] | None] = (),
    texture: TextureCfg | None = None,
    rough: bool = False,
    iterations: int | None = None,
    symmetry: Symmetry | None = None,
) -> Fit | None:
    """Return the pose that agrees best with the frames of one moment, or None where the body is out of all of them.

    Args:
        renderer: Scene with the other bodies where they are; the body is moved in it.
        views: Frames.
        shape: The body.
        pose: Where to start, shape (4, 4).
        cfg: Settings.
        prior: Information on the start [1/m^2, 1/rad^2], shape (6, 6).
        keyframes: For each view, number and keyframe whose texture is compared.
        texture: Settings of the texture.
        rough: Whether the start may be off by centimetres.
        iterations: Iterations; by default those of `cfg`.
        symmetry: Of the body; a round one may have turned where its texture has moved.
    """
    start, prior = pose, FREE if prior is None else prior
    count = iterations or (cfg.first_iterations if rough else cfg.iterations)
    if texture is not None and count > 1:
        renderer.place(shape.row, pose)
        for view, chosen in zip(views, keyframes, strict=False):
            if chosen is not None:
                shift = common_shift(renderer, view, shape, pose, chosen[1], texture)
                start = pose = _shifted(pose, shift, view, shape, symmetry)
                break
    fit = None
    for k in range(count):
        share = 1 - k / max(count - 2, 1) if rough else 0.0
        share = float(np.clip(share, 0.0, 1.0))
        gate = cfg.depth_gate + share * (cfg.first_depth_gate - cfg.depth_gate)
        reach = cfg.edge_range + share * (cfg.first_edge_range - cfg.edge_range)
        with_texture = texture is not None and (k >= 1 or count == 1) and not (rough and k < count - 3)
        fit = _linearised(
            renderer,
            views,
            shape,
            pose,
            cfg,
            gate,
            reach,
            keyframes if with_texture else (),
            texture,
            final=k == count - 1,
            symmetry=symmetry,
        )
        if fit is None:
            return None
        if k == count - 1:
            break
        total = fit.geometry.information + prior
        gradient = fit.geometry.gradient + prior @ twist_between(pose, start)
        for number, normal in fit.texture:
            weight = _tempered(
                normal.information, next(f for n, f in filter(None, keyframes) if n == number).covariance
            )
            total = total + weight @ normal.information
            gradient = gradient + weight @ normal.gradient
        step = np.linalg.solve(total, gradient)
        limit = max(np.linalg.norm(step[:3]) / cfg.max_step, np.linalg.norm(step[3:]) * shape.reach / cfg.max_step, 1.0)
        pose = moved(pose, step / limit)
    return fit


def _shifted(
    pose: np.ndarray, shift: np.ndarray, view: View, shape: TrackedShape, symmetry: Symmetry | None
) -> np.ndarray:
    """Return a pose after a displacement of the surface that faces the camera [m], shape (3,).

    A sphere turns, any other body moves: depth and outline would say where else a sphere is.
    """
    result = pose.copy()
    if symmetry is None or not symmetry.sphere or not shift.any():
        result[:3, 3] += shift
        return result
    middle = pose[:3, :3] @ symmetry.centre + pose[:3, 3]
    front = view.camera.position - middle
    front *= shape.radius / np.linalg.norm(front)
    turn = Rotation.from_rotvec(np.cross(front, shift) / shape.radius**2).as_matrix()
    result[:3, :3] = turn @ pose[:3, :3]
    result[:3, 3] = middle - result[:3, :3] @ symmetry.centre
    return result


def _tempered(information: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the factor, shape (6, 6), on texture's equations that lets in the covariance of its keyframe."""
    return np.linalg.inv(np.eye(6) + information @ covariance)


def _linearised(
    renderer: RayRenderer,
    views: Sequence[View],
    shape: TrackedShape,
    pose: np.ndarray,
    cfg: AlignCfg,
    gate: float,
    reach: float,
    keyframes: Sequence[tuple[int, Keyframe] | None],
    texture: TextureCfg | None,
    *,
    final: bool,
    symmetry: Symmetry | None = None,
) -> Fit | None:
    """Return all residuals at a pose."""
    renderer.place(shape.row, pose)
    total, textures, scatters, found, searched, correlations = Normal(), [], [], 0, 0, []
    edge_scatters, texture_scatters = [], []
    seen, is_round = False, symmetry is not None and bool(symmetry.chosen_turns().any())
    for v, view in enumerate(views):
        crop = rendered_crop(renderer, view, shape, pose, cfg.max_pixels)
        if crop is None or not crop.own.any():
            continue
        seen = True
        normal, scatter, _ = depth_rows(renderer, crop, view, pose, gate, cfg, final=final)
        edge = edge_rows(renderer, view, shape, pose, reach, cfg, is_round=is_round)
        total = total + normal + edge.normal
        scatters.append(scatter)
        edge_scatters.append(edge.scatter)
        found, searched = found + edge.found, searched + edge.searched
        chosen = keyframes[v] if v < len(keyframes) else None
        if chosen is not None and texture is not None:
            rows, count, correlation, scatter = texture_rows(renderer, view, shape, pose, chosen[1], texture, cfg)
            correlations.append(correlation)
            texture_scatters.append(scatter)
            if count >= 4:
                textures.append((chosen[0], rows))
    if not seen:
        return None
    share = found / searched if searched else np.nan
    correlation = float(np.mean(correlations)) if correlations else np.nan
    depth_std, edge_std, texture_std = (_largest(s) for s in (scatters, edge_scatters, texture_scatters))
    if symmetry is not None:
        total = _without_open_turns(total, pose, symmetry)
    return Fit(pose, total, textures, depth_std, share, correlation, edge_std, texture_std)


def _without_open_turns(normal: Normal, pose: np.ndarray, symmetry: Symmetry) -> Normal:
    """Return the equations of depth and edges without turns about axes about which the body is round.

    Facets that stand for a round surface would seem to show them.
    """
    axes = pose[:3, :3] @ symmetry.chosen_turns()
    if not axes.any():
        return normal
    middle = pose[:3, :3] @ symmetry.centre
    turns = np.concatenate([np.cross(middle, axes, axis=0), axes])
    kept = np.eye(6) - turns @ np.linalg.pinv(turns, rcond=1e-6)
    return Normal(kept.T @ normal.information @ kept, kept.T @ normal.gradient, kept.T @ normal.bias)


def _largest(values: Sequence[float]) -> float:
    """Return the largest of those that are finite, NaN where none is."""
    return max((v for v in values if np.isfinite(v)), default=np.nan)


def agreement(
    renderer: RayRenderer,
    views: Sequence[View],
    shape: TrackedShape,
    pose: np.ndarray,
    depth_std: float,
    cfg: AcceptCfg,
) -> Agreement:
    """Return how a pose agrees with the frames of one moment; where several see it, of the one that sees most."""
    renderer.place(shape.row, pose)
    results = [_agreement(renderer, view, shape, pose, depth_std, cfg) for view in views]
    known = [r for r in results if r is not None]
    if not known:
        return Agreement(0, 0.0, 0.0, 0.0, 0.0)
    return replace(max(known, key=lambda r: r.pixels), penetration=renderer.penetration(shape.row))


def _agreement(
    renderer: RayRenderer, view: View, shape: TrackedShape, pose: np.ndarray, depth_std: float, cfg: AcceptCfg
) -> Agreement | None:
    """Return the agreement in one frame."""
    import cv2

    crop = rendered_crop(renderer, view, shape, pose, 1500)
    if crop is None:
        return None
    tolerance = max(cfg.depth_tolerance, 4 * depth_std if np.isfinite(depth_std) else 0.0)
    difference = crop.measured - crop.depth
    # What covers the body off its mask is left out; what is seen behind it there still speaks against the pose.
    with_depth = crop.own & (crop.measured > 0) & (crop.mask | (difference > tolerance))
    inner = cv2.erode(crop.own.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    inner = inner & with_depth if (inner & with_depth).sum() >= cfg.min_pixels else with_depth
    count = max(int(inner.sum()), 1)
    agrees = int((inner & (np.abs(difference) < tolerance)).sum())
    behind = int((inner & (difference > tolerance)).sum())
    own = crop.own.astype(np.uint8)
    ring = (cv2.dilate(own, np.ones((9, 9), np.uint8)) > 0) & ~(cv2.dilate(own, np.ones((5, 5), np.uint8)) > 0)
    ring &= crop.measured > 0
    depths = crop.depth[crop.own]
    near = crop.measured < (depths.max() + tolerance if len(depths) else 0.0)
    near &= crop.measured > (depths.min() - tolerance if len(depths) else 0.0)
    # Nothing is known of what is behind something off the mask.
    in_front = crop.measured < crop.depth - tolerance
    ring &= crop.mask | ~in_front
    strange = int((ring & near & in_front).sum())
    alone = _outline_pixels(view, shape, pose, crop)
    misfit, scatter = _misfit(np.where(inner & (np.abs(difference) < 2 * tolerance), difference, np.nan))
    return Agreement(
        agrees,
        agrees / count,
        behind / count,
        strange / max(int(ring.sum()), 1),
        float(crop.own.sum()) / max(alone, 1),
        misfit,
        scatter,
    )


def _misfit(difference: np.ndarray) -> tuple[float, float]:
    """Return the scatter of differences (h, w) [m], NaN where unused, averaged over squares of pixels, and by pixel."""
    import cv2

    known = np.isfinite(difference)
    if known.sum() < 9:
        return 0.0, 0.0
    size = (SQUARE, SQUARE)
    total = cv2.boxFilter(
        np.where(known, difference, 0.0), cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    count = cv2.boxFilter(known.astype(float), cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    mean = (total / np.maximum(count, 1))[known & (count > 0.4 * SQUARE**2)]
    if not len(mean):
        return 0.0, 0.0
    return MAD * float(np.median(np.abs(mean))), MAD * float(np.median(np.abs(difference[known])))


def _outline_pixels(view: View, shape: TrackedShape, pose: np.ndarray, crop: Crop) -> int:
    """Return how many pixels of a crop's grid the body would take if nothing covered it, from its surface points."""
    import cv2

    points = shape.points @ pose[:3, :3].T + pose[:3, 3]
    corners = np.concatenate([points, shape.edges.point @ pose[:3, :3].T + pose[:3, 3]])
    pixels, _ = view.camera.project(corners)
    hull = cv2.convexHull(np.asarray(pixels, np.float32))
    stride = int(crop.rows[1] - crop.rows[0]) if len(crop.rows) > 1 else 1
    return int(cv2.contourArea(hull) / stride**2)
