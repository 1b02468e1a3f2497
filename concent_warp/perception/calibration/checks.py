"""What the views of targets say about intrinsics, distortion, depth and the size of the targets."""

from __future__ import annotations

import numpy as np
from scipy.special import stdtrit

from concent_warp.perception.calibration.bundle import INTRINSICS, SIZE, BundleFit, Problem
from concent_warp.perception.calibration.footage import Footage
from concent_warp.perception.calibration.result import Check

SHRINK = 0.8
"""Part of a target, about its middle, within which depth is read [-]."""
FEWEST_PIXELS = 12
"""Pixels with depth on a target from which on it counts."""
NOTEWORTHY_FOCAL = 0.3
"""Error of a focal length that matters [%]."""
NOTEWORTHY_CENTRE = 2.0
"""Error of the principal point that matters [px]."""
NOTEWORTHY_DEPTH = 0.3
"""Error of the scale of depth that matters [%]."""
NOTEWORTHY_DISTORTION = 0.5
"""Distortion at the corner of what was seen that matters [px]."""
UNKNOWN_FOCAL = 5.0
"""Half width of the interval of a focal length above which it is not determined [%]."""


def quantile(fit: BundleFit) -> float:
    """Return the factor from a standard deviation to half of a 95 % interval."""
    return float(stdtrit(fit.degrees_of_freedom, 0.975))


def size_check(fit: BundleFit) -> Check:
    """Return how much larger than stated the targets are [%]."""
    value, half = 100 * (fit.estimate.size - 1), 100 * quantile(fit) * float(fit.std(SIZE)[0])
    return Check("target size", value, value - half, value + half, "%", 0.5)


def intrinsic_checks(fit: BundleFit, stated: np.ndarray) -> list[Check]:
    """Return how far stated intrinsics are off, stated minus true, from a fit in which they were free.

    Args:
        fit: The fit.
        stated: Pinhole matrix in the recording [px], shape (3, 3).
    """
    half = quantile(fit) * fit.std(INTRINSICS)
    checks = []
    for i, name in enumerate(("focal length x", "focal length y")):
        value = 100 * (stated[i, i] / fit.estimate.intrinsics[i, i] - 1)
        checks.append(Check(name, value, value - 100 * half[i], value + 100 * half[i], "%", NOTEWORTHY_FOCAL))
    for i, name in enumerate(("principal point x", "principal point y")):
        value = float(stated[i, 2] - fit.estimate.intrinsics[i, 2])
        checks.append(Check(name, value, value - half[2 + i], value + half[2 + i], "px", NOTEWORTHY_CENTRE))
    return checks


def radial_check(fit: BundleFit, problem: Problem) -> Check:
    """Return the radial distortion that remains in the images, at the outermost corner that was seen [px]."""
    matrix = fit.estimate.intrinsics
    pixels = np.concatenate([v.pixels for f in problem.frames for v in f.views])
    focal = float(np.sqrt(matrix[0, 0] * matrix[1, 1]))
    radius = float(np.linalg.norm((pixels - matrix[:2, 2]) / focal, axis=1).max())
    gradient = focal * np.array([radius**3, radius**5])
    value = float(gradient @ fit.estimate.radial)
    half = quantile(fit) * float(np.sqrt(gradient @ fit.block(INTRINSICS)[4:, 4:] @ gradient))
    return Check("radial distortion", value, value - half, value + half, "px", NOTEWORTHY_DISTORTION)


def depth_check(fit: BundleFit, problem: Problem, footage: Footage) -> Check | None:
    """Return by how much depth reads too long on the targets [%]; None where there is too little depth on them."""
    ratios = []
    relative = np.linalg.inv(fit.estimate.camera) @ problem.relative(fit.estimate.offset)
    for frame, pose, weight in zip(problem.frames, relative, fit.weights, strict=True):
        depth = footage.streams[frame.demonstration].depth[frame.row]
        if weight < 0.5 or not depth.any():
            continue
        for view in frame.views:
            ratio = _depth_ratio(depth, view.pixels, pose @ fit.estimate.targets[view.target], fit.estimate.intrinsics)
            if ratio is not None:
                ratios.append(ratio)
    if len(ratios) < 3:
        return None
    value = float(np.median(ratios)) - 1
    kept = np.abs(np.array(ratios) - 1 - value) < 5 * np.median(np.abs(np.array(ratios) - 1 - value)) + 1e-4
    value = float(np.mean(np.array(ratios)[kept])) - 1
    scatter = float(np.std(np.array(ratios)[kept], ddof=1)) / np.sqrt(kept.sum())
    half = float(stdtrit(kept.sum() - 1, 0.975)) * float(np.hypot(scatter, fit.std(SIZE)[0]))
    return Check("depth", 100 * value, 100 * (value - half), 100 * (value + half), "%", NOTEWORTHY_DEPTH)


def _depth_ratio(depth: np.ndarray, pixels: np.ndarray, pose: np.ndarray, intrinsics: np.ndarray) -> float | None:
    """Return the median of measured over expected depth on a planar target; None where depth is missing.

    Args:
        depth: Measured depth [m], shape (H, W).
        pixels: Corners of the target [px], shape (n, 2).
        pose: Pose of the target in the camera's frame, shape (4, 4).
        intrinsics: Pinhole matrix [px], shape (3, 3).
    """
    import cv2

    hull = cv2.convexHull(pixels.astype(np.float32))[:, 0]
    middle = hull.mean(axis=0)
    mask = np.zeros(depth.shape, dtype=np.uint8)
    cv2.fillConvexPoly(mask, np.round(middle + SHRINK * (hull - middle)).astype(np.int32), 1)
    v, u = np.nonzero(mask & (depth > 0))
    if len(u) < FEWEST_PIXELS:
        return None
    rays = np.stack([u, v, np.ones(len(u))], axis=1) @ np.linalg.inv(intrinsics).T
    normal, place = pose[:3, 2], pose[:3, 3]
    expected = (normal @ place) / (rays @ normal)
    good = expected > 0
    return float(np.median(depth[v, u][good] / expected[good])) if good.sum() >= FEWEST_PIXELS else None


def remarks_on(checks: list[Check], *, fitted: bool) -> list[str]:
    """Return sentences about what is off.

    Args:
        checks: The checks.
        fitted: Whether the intrinsics were fitted.
    """
    lines = []
    for check in checks:
        if not check.off:
            continue
        low, high = sorted((abs(check.low), abs(check.high)))
        size = f"{abs(check.value):.2f} {check.unit} (95 %: {low:.2f} to {high:.2f})"
        cure = "the fitted value is written" if fitted else "--fit-intrinsics fits it"
        if check.name == "depth":
            lines.append(f"depth reads {size} too {'long' if check.value > 0 else 'short'}")
        elif check.name == "target size":
            lines.append(f"the targets are {size} {'larger' if check.value > 0 else 'smaller'} than stated")
        elif check.name == "radial distortion":
            lines.append(f"residuals grow with the radius, as by a distortion of {size} at its largest; {cure}")
        elif check.name.startswith("focal"):
            lines.append(
                f"{check.name} in the recording is {size} too {'long' if check.value > 0 else 'short'}; {cure}"
            )
        else:
            lines.append(f"{check.name} in the recording is {size} off; {cure}")
    return lines
