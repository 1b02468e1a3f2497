"""Checks of a camera against the scene: its depths are compared with rays cast from its pose.

A pose that is inverted, transposed or of OpenGL's axes, and depths in another unit, fit the scene badly as stated and
well once they are mended. Where neither fits, as with a background that the scene lacks, nothing is refused.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import mujoco
import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.recording.logs.cfg import PlausibilityCfg
from concent_warp.recording.logs.units import DEPTHS
from concent_warp.recording.recording import ImageStream

FIX = f"set depth_unit in the map (one of {', '.join(DEPTHS)})"


def check_camera(
    stream: ImageStream, unit: str, m: mujoco.MjModel, qpos: np.ndarray, where: str, cfg: PlausibilityCfg
) -> Iterator[RecordingError]:
    """Yield what is wrong with pose and depths of a camera.

    Args:
        stream: Some frames.
        unit: Unit that their depths were taken to be in.
        m: The compiled scene.
        qpos: State of the scene in the first of them, shape (nq,).
        where: For messages.
        cfg: Thresholds.
    """
    pose = np.asarray(stream.pose, dtype=float)
    if error := _transform_error(pose, where):
        yield error
        return
    depth = stream.depth[0]
    measured = depth[depth > 0]
    if not measured.size:
        return
    middle = float(np.median(measured))
    data = mujoco.MjData(m)
    data.qpos[:] = qpos
    mujoco.mj_forward(m, data)
    fit = _Fit(stream, m, data, depth, cfg)
    given, seen = fit.of(pose)
    right = min(math.log(cfg.right_ratio), given / cfg.better)
    low, high = cfg.depth_bounds
    wrong = given > math.log(cfg.wrong_ratio) or seen < cfg.seen_share
    if wrong:
        for other, size in DEPTHS.items():
            factor = size / DEPTHS[unit]
            ratio, share = fit.of(pose, factor)
            if other != unit and ratio < right and share >= cfg.seen_share:
                yield RecordingError(
                    f"the depths look like {other} and not {unit}", where=where,
                    expected=f"about {middle * factor:.3g} m, as the scene has it from this pose",
                    found=f"{middle:.4g} m in the median", fix=FIX,
                )  # fmt: skip
                return
    if not low <= middle <= high:
        yield RecordingError(
            f"the depths are not in {unit}", where=where, expected=f"a median of {low:g} to {high:g} m",
            found=f"{middle:.4g} m", fix=FIX,
        )  # fmt: skip
        return
    if wrong:
        for words, other in _mended(pose):
            ratio, share = fit.of(other)
            if ratio < right and share >= max(cfg.seen_share, seen):
                yield RecordingError(
                    f"the camera pose looks {words}", where=where,
                    expected="camera-to-world (or camera-to-body), x right, y down, z forward, row by row",
                    found=f"depths {math.exp(given):.2f} times off, {math.exp(ratio):.2f} with the mended pose"
                    if math.isfinite(given)
                    else "a camera that sees nothing of the scene, unlike with the mended pose",
                    fix="write the matrix that way",
                )  # fmt: skip
                return


def _transform_error(pose: np.ndarray, where: str) -> RecordingError | None:
    """Return what is wrong with a matrix that is no rotation and translation, where the cause can be told."""
    expected = "camera-to-world, x right, y down, z forward"
    if not np.allclose(pose[3], [0, 0, 0, 1]) and np.allclose(pose[:, 3], [0, 0, 0, 1]):
        return RecordingError(
            "the camera pose is transposed: its translation is in the last row", where=where, expected=expected,
            fix="write it row by row, with 0 0 0 1 at the end",
        )  # fmt: skip
    rotation = pose[:3, :3]
    if np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-2) and np.linalg.det(rotation) < 0:
        return RecordingError(
            "the camera pose is mirrored", where=where, expected=expected, found="a left-handed rotation",
            fix="check the sign of its axes: one column or all three are negated",
        )  # fmt: skip
    return None


def _mended(pose: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield other readings of a camera-to-world transform, each with what is wrong if it is the right one."""
    transposed = pose.copy()
    transposed[:3, :3] = pose[:3, :3].T
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    yield "inverted (world-to-camera)", np.linalg.inv(pose)
    yield "to have its rotation transposed (column by column)", transposed
    yield "to have the axes of OpenGL (y up, z backward)", pose @ flip
    yield "inverted, with the axes of OpenGL", np.linalg.inv(flip @ pose)


class _Fit:
    """How well depths of one frame fit the scene from a pose."""

    def __init__(
        self, stream: ImageStream, m: mujoco.MjModel, data: mujoco.MjData, depth: np.ndarray, cfg: PlausibilityCfg
    ) -> None:
        """Pick pixels with a depth on a grid."""
        height, width = depth.shape
        rows = np.linspace(0, height - 1, cfg.depth_grid + 2)[1:-1].round().astype(int)
        columns = np.linspace(0, width - 1, cfg.depth_grid + 2)[1:-1].round().astype(int)
        v, u = (one.ravel() for one in np.meshgrid(rows, columns, indexing="ij"))
        kept = depth[v, u] > 0
        ones = np.ones(int(kept.sum()))
        self.rays = np.stack([u[kept], v[kept], ones], axis=1) @ np.linalg.inv(stream.intrinsics).T
        self.depth = depth[v, u][kept].astype(float)
        self.body = -1 if stream.body is None else int(m.body(stream.body).id)
        self.m, self.data = m, data

    def of(self, pose: np.ndarray, factor: float = 1.0) -> tuple[float, float]:
        """Return the median of abs(log(measured / expected)), infinite if nothing is seen, and the share seen."""
        if not len(self.depth):
            return 0.0, 1.0
        if self.body >= 0:
            carrier = np.eye(4)
            carrier[:3, :3] = self.data.xmat[self.body].reshape(3, 3)
            carrier[:3, 3] = self.data.xpos[self.body]
            pose = carrier @ pose
        geom = np.zeros((1, 1), np.int32)
        expected = np.array(
            [
                mujoco.mj_ray(self.m, self.data, pose[:3, 3], pose[:3, :3] @ ray, None, 1, self.body, geom)
                for ray in self.rays
            ]
        )
        hit = expected > 0
        if not hit.any():
            return math.inf, 0.0
        ratio = np.abs(np.log(self.depth[hit] * factor / expected[hit]))
        return float(np.median(ratio)), float(hit.mean())
