"""Joint least squares of reprojection errors over camera pose, target poses, clock offset and, if wanted, intrinsics.

The errors of the corners in one frame are not independent: an error of the joint angles moves all of them. So the
covariance of a frame is V = s^2 I + k J Q J', with the noise s of a corner [px], the derivatives J of its pixels by the
joint angles, their variances Q, and a factor k. Both s and k are estimated from the residuals by restricted maximum
likelihood (Patterson and Thompson, Biometrika 58, 1971), in turns with the least squares, in which a view whose
residual is larger than expected has a smaller weight. The intervals follow from V.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation

from concent_warp.perception.calibration.joint_motion import JointMotion
from concent_warp.perception.calibration.targets import TargetView

ROUNDS = 7
"""Rounds of least squares and estimated variances."""
MOST_STEPS = 30
"""Steps of a round of least squares at most."""
ANGLE_STEP = 1e-4
"""Step of the derivatives by joint angles [rad or m]."""
CAMERA, CLOCK, SIZE, INTRINSICS = "camera", "clock", "size", "intrinsics"
INTRINSIC_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2")


@dataclass(frozen=True)
class Frame:
    """All views of targets in one frame."""

    motion: JointMotion
    """Readings of the joints during its demonstration."""
    demonstration: str
    time: float
    """Time by the camera's clock [s]."""
    views: tuple[TargetView, ...]
    row: int
    """Row of the frame in its stream."""


@dataclass(frozen=True)
class Estimate:
    """Values that are fitted."""

    camera: np.ndarray
    """Camera to its body, shape (4, 4)."""
    targets: dict[str, np.ndarray]
    """Targets to their body, shape (4, 4) each."""
    intrinsics: np.ndarray
    """Pinhole matrix [px], shape (3, 3)."""
    offset: float = 0.0
    """Time to be added to those of the frames [s]."""
    radial: np.ndarray = field(default_factory=lambda: np.zeros(2))
    """Coefficients k1, k2 of radial distortion as in OpenCV [-], shape (2,)."""
    size: float = 1.0
    """True over stated size of the targets [-]."""


@dataclass(frozen=True)
class BundleFit:
    """Result of the least squares."""

    estimate: Estimate
    covariance: np.ndarray
    """Covariance of the parameters, shape (p, p)."""
    names: tuple[str, ...]
    """Names of the parameters: group and component, such as `camera.0`; a pose has a rotation vector in its own frame
    [rad] and a translation in its body's [m]."""
    residuals: tuple[np.ndarray, ...]
    """Reprojection errors by frame and corner [px], shape (n, 2) each."""
    weights: np.ndarray
    """Weight of each frame, shape (frames,)."""
    corner_std: float
    """Noise of a corner [px]."""
    joint_factor: float
    """Variance of the joint angles over that of the smoothed readings [-]."""
    degrees_of_freedom: float

    @property
    def rms(self) -> float:
        """Root mean square reprojection error of the frames with a weight above one half [px]."""
        good = [r for r, w in zip(self.residuals, self.weights, strict=True) if w > 0.5] or list(self.residuals)
        return float(np.sqrt(np.mean(np.concatenate(good) ** 2)))

    def std(self, group: str) -> np.ndarray:
        """Return the standard deviations of a group of parameters."""
        rows = [i for i, name in enumerate(self.names) if name.rpartition(".")[0] == group]
        return np.sqrt(np.diag(self.covariance)[rows])

    def block(self, group: str) -> np.ndarray:
        """Return the covariance of a group of parameters."""
        rows = [i for i, name in enumerate(self.names) if name.rpartition(".")[0] == group]
        return self.covariance[np.ix_(rows, rows)]


@dataclass(frozen=True)
class Corners:
    """Corners of targets in all frames, n of them in v views."""

    points: np.ndarray
    """In the frames of the targets [m], shape (n, 3)."""
    pixels: np.ndarray
    """In the images [px], shape (n, 2)."""
    view: np.ndarray
    """View of each corner, shape (n,)."""
    frame_of_view: np.ndarray
    """Shape (v,)."""
    names: list[str]
    """Names of the targets."""
    target_of_view: np.ndarray
    """Shape (v,)."""
    ends: np.ndarray
    """Corners after which a new frame begins, shape (frames - 1,)."""


@dataclass(frozen=True)
class Problem:
    """Frames, the bodies that carry camera and targets, and which groups of parameters are free."""

    frames: Sequence[Frame]
    camera_body: str
    target_body: str
    free: tuple[str, ...] = (CLOCK,)
    """Groups that are fitted besides the poses: clock, size, intrinsics."""
    robust_width: float = 3.0
    """Residual of a frame over the median one, beyond which its weight falls [-]."""
    size_std: float = 0.01
    """Standard deviation of what is known of the targets' size in advance [-]."""

    def names(self, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of the parameters."""
        groups = {CAMERA: 6} | dict.fromkeys(estimate.targets, 6)
        groups |= {name: {CLOCK: 1, SIZE: 1, INTRINSICS: 6}[name] for name in self.free}
        return tuple(f"{name}.{i}" for name, count in groups.items() for i in range(count))

    def moved(self, estimate: Estimate, step: np.ndarray) -> Estimate:
        """Return the estimate after a step of its parameters (p,)."""
        groups: dict[str, np.ndarray] = {}
        for name, value in zip(self.names(estimate), step, strict=True):
            group = name.rpartition(".")[0]
            groups[group] = np.append(groups.get(group, np.zeros(0)), value)
        matrix, radial = estimate.intrinsics, estimate.radial
        if INTRINSICS in groups:
            focal, centre = groups[INTRINSICS][:2], groups[INTRINSICS][2:4]
            matrix = matrix.copy()
            matrix[[0, 1], [0, 1]] *= np.exp(focal)
            matrix[[0, 1], [2, 2]] += centre
            radial = radial + groups[INTRINSICS][4:]
        return replace(
            estimate,
            camera=_stepped(estimate.camera, groups[CAMERA]),
            targets={name: _stepped(pose, groups[name]) for name, pose in estimate.targets.items()},
            intrinsics=matrix,
            radial=radial,
            offset=estimate.offset + float(groups.get(CLOCK, np.zeros(1))[0]),
            size=estimate.size * float(np.exp(groups.get(SIZE, np.zeros(1))[0])),
        )

    def relative(self, offset: float) -> np.ndarray:
        """Return the poses of the targets' body in the frame of the camera's body, shape (frames, 4, 4)."""
        result = np.empty((len(self.frames), 4, 4))
        for motion in {id(f.motion): f.motion for f in self.frames}.values():
            rows = [i for i, f in enumerate(self.frames) if f.motion is motion]
            qpos = motion.angles(np.array([self.frames[i].time for i in rows]) + offset)
            result[rows] = self.between(motion, qpos)
        return result

    def between(self, motion: JointMotion, qpos: np.ndarray) -> np.ndarray:
        """Return the poses of the targets' body in the frame of the camera's body at positions (n, nq), (n, 4, 4)."""
        return np.linalg.inv(motion.poses(qpos, self.camera_body)) @ motion.poses(qpos, self.target_body)

    @cached_property
    def corners(self) -> Corners:
        """All corners of all frames, one after the other."""
        views = [(i, v) for i, f in enumerate(self.frames) for v in f.views]
        names = sorted({v.target for _, v in views})
        counts = [len(v.points) for _, v in views]
        return Corners(
            np.concatenate([v.points for _, v in views]),
            np.concatenate([v.pixels for _, v in views]),
            np.repeat(np.arange(len(views)), counts),
            np.array([i for i, _ in views]),
            names,
            np.array([names.index(v.target) for _, v in views]),
            np.cumsum([sum(len(v.points) for v in f.views) for f in self.frames])[:-1],
        )

    def residuals(self, estimate: Estimate, relative: np.ndarray | None = None) -> list[np.ndarray]:
        """Return the reprojection errors, projected minus detected, by frame [px], shape (corners, 2) each."""
        relative = self.relative(estimate.offset) if relative is None else relative
        c = self.corners
        targets = np.array([estimate.targets[name] for name in c.names])
        pose = (np.linalg.inv(estimate.camera) @ relative)[c.frame_of_view] @ targets[c.target_of_view]
        pose = pose[c.view]
        local = estimate.size * np.einsum("nij,nj->ni", pose[:, :3, :3], c.points) + pose[:, :3, 3]
        return np.split(_imaged(local, estimate.intrinsics, estimate.radial) - c.pixels, c.ends)

    @staticmethod
    def frame_residual(frame: Frame, to_camera: np.ndarray, estimate: Estimate) -> np.ndarray:
        """Return the reprojection errors of a frame [px], shape (corners, 2); `to_camera` is body to camera (4, 4)."""
        parts = []
        for view in frame.views:
            pose = to_camera @ estimate.targets[view.target]
            parts.append(project(pose, estimate.size * view.points, estimate.intrinsics, estimate.radial) - view.pixels)
        return np.concatenate(parts)


def project(pose: np.ndarray, points: np.ndarray, intrinsics: np.ndarray, radial: np.ndarray) -> np.ndarray:
    """Return the pixels, shape (n, 2), of points (n, 3) [m] of a target at a pose (4, 4) in the camera's frame.

    Radial distortion after OpenCV: r' = r (1 + k1 r^2 + k2 r^4).
    """
    return _imaged(points @ pose[:3, :3].T + pose[:3, 3], intrinsics, radial)


def _imaged(local: np.ndarray, intrinsics: np.ndarray, radial: np.ndarray) -> np.ndarray:
    """Return the pixels, shape (n, 2), of points (n, 3) [m] in the camera's frame."""
    plane = local[:, :2] / np.maximum(local[:, 2:], 1e-3)
    square = (plane**2).sum(axis=1, keepdims=True)
    plane = plane * (1 + radial[0] * square + radial[1] * square**2)
    return plane @ intrinsics[:2, :2].T + intrinsics[:2, 2]


def fit(problem: Problem, start: Estimate) -> BundleFit:
    """Return the least-squares estimate with its covariance."""
    estimate, names = start, problem.names(start)
    frames, count = problem.frames, len(names)
    sizes = [2 * sum(len(v.points) for v in f.views) for f in frames]
    first = np.array([np.sqrt(np.mean(r**2)) for r in problem.residuals(estimate)])
    variances = np.array([max(float(np.median(first)), 0.05) ** 2, 1.0])
    weights = np.minimum(1.0, (problem.robust_width * np.median(first) / np.maximum(first, 1e-9)) ** 2)
    parts: list[np.ndarray] = []
    raw: list[np.ndarray] = []
    covariances: list[np.ndarray] = []
    for turn in range(ROUNDS):
        by_joints = _joint_covariances(problem, estimate)
        roots = [np.linalg.cholesky(_frame_covariance(n, by_joints[i], variances)) for i, n in enumerate(sizes)]
        whiten = [np.sqrt(w) * np.linalg.inv(root) for root, w in zip(roots, weights, strict=True)]

        def whitened(step: np.ndarray, estimate=estimate, whiten=whiten) -> np.ndarray:
            moved = problem.moved(estimate, step)
            parts = problem.residuals(moved)
            known = np.log([moved.size]) / problem.size_std
            rows = [white @ r.ravel() for r, white in zip(parts, whiten, strict=True)]
            return np.concatenate([*rows, known])

        solved = least_squares(
            whitened, np.zeros(count), x_scale="jac", method="lm", xtol=1e-9, ftol=1e-9, max_nfev=MOST_STEPS
        )
        estimate = problem.moved(estimate, solved.x)
        parts = problem.residuals(estimate)
        # Back from whitened derivatives to pixels.
        rows = np.split(solved.jac[:-1], np.cumsum(sizes)[:-1])
        raw = [root @ j / np.sqrt(w) for root, j, w in zip(roots, rows, weights, strict=True)]
        by_joints = _joint_covariances(problem, estimate)
        variances = _variances([r.ravel() for r in parts], raw, by_joints, weights, variances)
        covariances = [_frame_covariance(n, by_joints[i], variances) for i, n in enumerate(sizes)]
        size = np.array(
            [
                np.sqrt(r.ravel() @ np.linalg.solve(v, r.ravel()) / r.size)
                for r, v in zip(parts, covariances, strict=True)
            ]
        )
        if turn < ROUNDS - 1:  # over the median: gross errors are in the first variances
            limit = problem.robust_width * float(np.median(size))
            weights = np.where(size > limit, (limit / np.maximum(size, 1e-9)) ** 2, 1.0)
    information = sum(w * j.T @ np.linalg.solve(v, j) for w, j, v in zip(weights, raw, covariances, strict=True))
    information = np.asarray(information)
    if SIZE in problem.free:
        row = names.index(f"{SIZE}.0")
        information[row, row] += 1 / problem.size_std**2
    covariance = _inverse(information)
    free = float(sum(min(6, n) * w for n, w in zip(sizes, weights, strict=True)) - count)
    return BundleFit(
        estimate,
        covariance,
        names,
        tuple(parts),
        weights,
        float(np.sqrt(variances[0])),
        float(variances[1]),
        max(free, 1),
    )


def _inverse(information: np.ndarray) -> np.ndarray:
    """Return the inverse of an information matrix whose parameters have different units, huge where it is singular."""
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-30))
    value, vector = np.linalg.eigh(information * scale * scale[:, None])
    return (vector / np.maximum(value, 1e-14)) @ vector.T * scale * scale[:, None]


def _joint_covariances(problem: Problem, estimate: Estimate) -> list[np.ndarray]:
    """Return the covariance of each frame's pixels by the noise of the smoothed joint angles, shape (2n, 2n) each."""
    result: list[np.ndarray] = []
    camera = np.linalg.inv(estimate.camera)
    for frame in problem.frames:
        motion = frame.motion
        qpos = motion.angles(np.array([frame.time + estimate.offset]))
        moved = [qpos[0]]
        for joint in motion.readings:
            moved.append(qpos[0].copy())
            moved[-1][motion.model.jnt_qposadr[joint]] += ANGLE_STEP
        relative = camera @ problem.between(motion, np.array(moved))
        pixels = [problem.frame_residual(frame, pose, estimate).ravel() for pose in relative]
        noise = np.array([reading.noise_std for reading in motion.readings.values()])
        derivative = (np.array(pixels[1:]) - pixels[0]).T / ANGLE_STEP * noise
        result.append(derivative @ derivative.T)
    return result


def _frame_covariance(size: int, by_joints: np.ndarray, variances: np.ndarray) -> np.ndarray:
    """Return the covariance of a frame's pixels [px^2], shape (size, size)."""
    return variances[0] * np.eye(size) + variances[1] * by_joints


def _variances(
    residuals: list[np.ndarray],
    jacobians: list[np.ndarray],
    by_joints: list[np.ndarray],
    weights: np.ndarray,
    start: np.ndarray,
) -> np.ndarray:
    """Return the variances of corners [px^2] and the factor of those of joint angles, by restricted likelihood."""
    good = [i for i, w in enumerate(weights) if w > 0.5]
    # The eigenvectors of a frame's joint covariance are those of its covariance, whatever the two variances.
    spectra = [np.linalg.eigh(by_joints[i]) for i in good]
    turned = [
        (vectors.T @ residuals[i], vectors.T @ jacobians[i]) for i, (_, vectors) in zip(good, spectra, strict=True)
    ]

    def cost(log: np.ndarray) -> float:
        corner, joint = np.exp(np.clip(log, -30, 15))
        total, information = 0.0, 0.0
        for (values, _), (r, j) in zip(spectra, turned, strict=True):
            v = corner + joint * np.maximum(values, 0)
            total += float(np.sum(np.log(v)) + np.sum(r**2 / v))
            information = information + (j.T / v) @ j
        scale = np.sqrt(np.maximum(np.diag(information), 1e-30))
        return total + float(np.linalg.slogdet(information / scale / scale[:, None])[1] + 2 * np.log(scale).sum())

    first = np.log(np.maximum(start, 1e-8))
    options = {"initial_simplex": first + np.array([[0, 0], [1.0, 0], [0, 1.0]]), "xatol": 0.02, "fatol": 0.02}
    found = minimize(cost, first, method="Nelder-Mead", options=options)
    return np.exp(np.clip(found.x, [np.log(1e-4), np.log(1e-2)], 15))


def _stepped(pose: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return a pose turned by a rotation vector in its own frame [rad] and moved in its body's [m], step of shape
    (6,).
    """
    moved = pose.copy()
    moved[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(step[:3]).as_matrix()
    moved[:3, 3] += step[3:]
    return moved
