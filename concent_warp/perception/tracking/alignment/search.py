"""The pose of an object that nothing is known about, from one moment's frame.

Depth in front of the rendered robot and static scene is divided into clusters. From many orientations at each cluster,
iterative closest points with the shape's signed distance moves the shape to the points; the best distinct results are
refined against the image and scored by what of the object and of the cluster they explain. The best of these are
refined until they no longer move, and so are turns of the winner that might look like it. The winner must agree with
the image, and be clearly better than the next that no symmetry of the shape explains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.perception.pinhole import pixel_grid
from concent_warp.perception.tracking.alignment.align import Agreement, Fit, agreement, refine
from concent_warp.perception.tracking.alignment.clusters import Cluster, Foreground, Region, foreground
from concent_warp.perception.tracking.alignment.registration import closest_points, placed
from concent_warp.perception.tracking.cfg import TrackCfg
from concent_warp.perception.tracking.geometry.pose import rotation_angle, twist_between
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.symmetry import Symmetry
from concent_warp.perception.tracking.geometry.view import View

FIRST_ITERATIONS = 10
"""Iterations of a start, whose pose may be off by centimetres."""
SETTLED = 0.0005
"""Motion of the object's surface in one round of iterations below which a pose no longer moves [m]."""
MAX_ROUNDS = 4
"""Rounds of iterations, at most, until a pose no longer moves."""
FEWER = 3
"""Share of the points that the first iterations use, and of the iterations that use all [1/-]."""
COMPARED_PIXELS = 20_000
"""Pixels, about, in which two poses are compared."""
DIFFERENT = 4.0
"""Difference of predicted depths, over the scatter of depth, from which on a pixel speaks for one of two poses [-]."""
NO_SURFACE = 1e3
"""Depth that stands for none [m]."""
BOX_TURNS = 24
"""Turns of a box."""
RIVAL_ROUNDS = 3
"""Times, at most, that a better explanation is looked for among the turns of the best pose."""
TEST_TURN = 1.5
"""Turn at which it is tested whether the image shows it, over that from which on two poses differ [-]."""
RIVAL_STEPS = 24
"""Turns about each axis at which other explanations of the winner's image are looked for: 15 degrees apart."""


@dataclass(frozen=True)
class Found:
    """Outcome of a search."""

    fit: Fit | None
    """The pose, or None where none is clear."""
    score: float
    """Its score [-], 0 to 1."""
    reason: str
    """Why there is none, in words; empty where there is one."""


@dataclass(frozen=True)
class _Candidate:
    """A refined pose."""

    fit: Fit
    agreed: Agreement
    score: float

    @property
    def quality(self) -> float:
        """Score of what is seen of it, whatever known bodies cover [-]."""
        return self.score / max(min(self.agreed.visible, 1.0), 1e-3)


def find_pose(
    renderer: RayRenderer,
    view: View,
    shape: TrackedShape,
    symmetry: Symmetry,
    cfg: TrackCfg,
    rng: np.random.Generator,
    region: Region | None = None,
) -> Found:
    """Return the pose of a body in a frame, without prior.

    Args:
        renderer: Scene with robot and known objects where they are.
        view: The frame.
        shape: The body.
        symmetry: Its symmetries.
        cfg: Settings.
        rng: Source of orientations and of samples.
        region: Where a user says that it is; anywhere by default.
    """
    renderer.place(shape.row, None)
    front = foreground(renderer, view, shape, cfg)
    clusters, where = front.clusters, "seen in front of robot and static scene"
    if region is not None and clusters:
        clusters = [c for c in region.restricted(clusters, view, shape) if len(c.points) >= cfg.search.min_cluster]
        where = f"seen at {region.text()}"
    if not clusters:
        return Found(None, 0.0, f"nothing unknown of its size is {where}")
    points = np.unique(np.concatenate([c.points for c in clusters]), axis=0)
    found = _Search(renderer, view, shape, symmetry, cfg, rng, region, front, clusters, points).outcome()
    renderer.place(shape.row, None)
    return found


@dataclass(frozen=True)
class _Search:
    """One search."""

    renderer: RayRenderer
    view: View
    shape: TrackedShape
    symmetry: Symmetry
    cfg: TrackCfg
    rng: np.random.Generator
    region: Region | None
    front: Foreground
    clusters: list[Cluster]
    """Those in which the body may be."""
    points: np.ndarray
    """Points of all clusters [m], shape (n, 3)."""

    def outcome(self) -> Found:
        """Return what is found."""
        cfg = self.cfg.search
        turns = Rotation.random(cfg.orientations, rng=self.rng).as_matrix()
        starts = [pose for cluster in self.clusters for pose in self._aligned(cluster, turns)]
        tried = self._refined(self._best(starts, [], cfg.kept))
        if not tried:
            return Found(None, 0.0, "no start led to a pose that the image determines")
        finals = self._settled(self._distinct(tried)[: cfg.finalists])
        for _ in range(RIVAL_ROUNDS):
            best = (self._accepted(finals) or finals or tried)[0]
            known = [c.fit.pose for c in (*finals, *tried)]
            for group in self._rivals(best):
                rivals = self._best(group, known, cfg.rivals)
                known += rivals
                finals += self._settled(self._distinct(self._refined(rivals)))
            finals = self._distinct(sorted(finals, key=lambda c: -c.score))
            if not finals or self._same(finals[0], best):
                break
        accepted = self._accepted(finals)
        if not accepted:
            best = max(finals or tried, key=lambda c: c.score)
            return Found(None, best.score, f"the best pose does not agree with the image: {best.agreed.text()}")
        return self._clear(accepted)

    def _clear(self, accepted: list[_Candidate]) -> Found:
        """Return that of accepted poses, the best first, that no other one rivals."""
        best = accepted[0]
        for other in accepted[1:]:
            if not self._same(best, other) and self._advantage(best, other) < -self.cfg.search.min_margin:
                best = other
        for other in accepted:
            if self._same(best, other) or self._advantage(best, other) >= self.cfg.search.min_margin:
                continue
            near = np.linalg.norm(_middle(other.fit.pose, self.shape) - _middle(best.fit.pose, self.shape))
            alike = self.symmetry.nearest(best.fit.pose, other.fit.pose)
            reason = (
                f"two poses, {1e3 * near:.0f} mm and {np.degrees(rotation_angle(other.fit.pose, alike)):.0f} degrees "
                f"apart, explain the image about as well (scores {best.score:.2f} and {other.score:.2f})"
            )
            return Found(None, best.score, reason)
        if self._turns_unseen(best):
            return Found(None, best.score, "a turn of the best pose changes nothing that is seen")
        return Found(best.fit, best.score, "")

    def _advantage(self, first: _Candidate, second: _Candidate) -> float:
        """Return by how much one pose is better than another [-].

        Few pixels at which they differ leave it to the scores. Where nearly all of them speak for one pose, it is the
        better one unless the scores say otherwise. Where they are divided, each pose explains what the other does not,
        as with two equal objects: one is better only if it fits what is seen of it much better.
        """
        cfg, lead = self.cfg.search, first.score - second.score
        share, count = preference(self.renderer, self.view, self.shape, first.fit, second.fit)
        majority = 2 * share - 1
        if count < cfg.min_votes:
            return lead
        if abs(majority) >= cfg.min_majority:
            return majority if majority * lead >= 0 else 0.0
        quality = first.quality - second.quality
        return quality if abs(quality) >= cfg.min_divided_margin and quality * lead > 0 else 0.0

    def _turns_unseen(self, best: _Candidate) -> bool:
        """Return whether a turn that would make it another pose changes nothing that is seen."""
        for turn in rival_turns(self.shape, np.radians(TEST_TURN * self.cfg.search.same_rotation)):
            pose = best.fit.pose @ turn
            if self._alike(pose, best.fit.pose):
                continue
            fit = refine(self.renderer, [self.view], self.shape, pose, self.cfg.align, iterations=1)
            turned = self._judged(fit)
            if (
                turned is not None
                and turned.agreed.accepted(self.cfg.accept)
                and self._advantage(best, turned) < self.cfg.search.min_margin
            ):
                return True
        return False

    def _aligned(self, cluster: Cluster, turns: np.ndarray) -> list[np.ndarray]:
        """Return distinct poses from orientations (k, 3, 3) at a cluster, those that fit its points best first."""
        few = self._some(cluster.points, self.cfg.search.points // FEWER)
        return self._moved(cluster, placed(few, self.view.camera.position, self.shape, turns))

    def _moved(self, cluster: Cluster, poses: np.ndarray) -> list[np.ndarray]:
        """Return distinct poses from poses (k, 4, 4) at a cluster, those that fit its points best first.

        Most iterations are done with few points, and the last with more, from the best.
        """
        cfg, eye = self.cfg.search, self.view.camera.position
        few, many = (self._some(cluster.points, n) for n in (max(cfg.points // FEWER, 1), cfg.points))
        cost, poses = closest_points(few, eye, self.shape, poses, cfg.rounds - cfg.rounds // FEWER)
        best = self._unlike(cost, poses, cfg.looked_at)
        cost, poses = closest_points(many, eye, self.shape, poses[best], cfg.rounds // FEWER)
        return [poses[k] for k in self._unlike(cost, poses, cfg.looked_at)]

    def _rivals(self, best: _Candidate) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return poses at which the shape might show nearly what it shows at the best one: turned in its place, and
        moved to the points again, by turns of a box and by smaller turns.
        """
        cluster, turned = _nearest(best, self.clusters, self.shape), best.fit.pose @ rival_turns(self.shape)
        box, fine = turned[:BOX_TURNS], turned[BOX_TURNS:]
        anew = self._aligned(cluster, box[:, :3, :3])
        return [*box, *self._moved(cluster, box), *anew], [*fine, *self._moved(cluster, fine)]

    def _some(self, points: np.ndarray, count: int) -> np.ndarray:
        """Return at most so many of some points (n, 3)."""
        return points[self.rng.choice(len(points), min(len(points), count), replace=False)]

    def _unlike(self, cost: np.ndarray, poses: np.ndarray, most: int) -> list[int]:
        """Return the best poses, by cost (k,), of which no two are the same."""
        found: list[int] = []
        for k in np.argsort(cost):
            if len(found) < most and all(not self._alike(poses[k], poses[other]) for other in found):
                found.append(int(k))
        return found

    def _best(self, starts: list[np.ndarray], known: list[np.ndarray], most: int) -> list[np.ndarray]:
        """Return the starts, at most so many, that explain most of the depth and are unlike known poses (4, 4)."""
        gains = [
            self.front.gain(self.renderer, self.view, self.shape, pose) if self._admitted(pose) else -np.inf
            for pose in starts
        ]
        chosen: list[np.ndarray] = []
        for k in np.argsort(gains)[::-1]:
            if len(chosen) == most or not np.isfinite(gains[k]):
                break
            if all(not self._alike(starts[k], other) for other in (*known, *chosen)):
                chosen.append(starts[k])
        return chosen

    def _admitted(self, pose: np.ndarray) -> bool:
        """Return whether a pose is where the user says that the body is."""
        if self.region is None:
            return True
        self.renderer.place(self.shape.row, pose)
        return self.region.admits(self.renderer, self.view, self.shape)

    def _refined(self, starts: list[np.ndarray]) -> list[_Candidate]:
        """Return what starts, shape (4, 4), become against the image, the best first."""
        found = []
        for pose in starts:
            fit = refine(
                self.renderer, [self.view], self.shape, pose, self.cfg.align, rough=True, iterations=FIRST_ITERATIONS
            )
            found.append(self._judged(fit))
        return sorted((c for c in found if c is not None), key=lambda c: -c.score)

    def _settled(self, candidates: list[_Candidate]) -> list[_Candidate]:
        """Return candidates after iterations until they no longer move, the best first."""
        found = []
        for candidate in candidates:
            fit: Fit | None = candidate.fit
            for _ in range(MAX_ROUNDS):
                before = fit.pose
                fit = refine(self.renderer, [self.view], self.shape, before, self.cfg.align)
                if fit is None:
                    break
                step = twist_between(before, fit.pose)
                if np.linalg.norm(step[:3]) + self.shape.radius * np.linalg.norm(step[3:]) < SETTLED:
                    break
            found.append(self._judged(fit))
        return sorted((c for c in found if c is not None), key=lambda c: -c.score)

    def _judged(self, fit: Fit | None) -> _Candidate | None:
        """Return a fit with its score; None where the image does not determine it."""
        if fit is None or fit.position_std() > self.cfg.accept.max_translation_std:
            return None
        agreed = agreement(self.renderer, [self.view], self.shape, fit.pose, fit.depth_std, self.cfg.accept)
        return _Candidate(fit, agreed, _score(agreed, fit, self.shape, self.points, self.cfg))

    def _accepted(self, candidates: list[_Candidate]) -> list[_Candidate]:
        """Return those that agree with the image and are where the user says, the best first."""
        good = [c for c in candidates if c.agreed.accepted(self.cfg.accept) and self._admitted(c.fit.pose)]
        return sorted(good, key=lambda c: -c.score)

    def _distinct(self, candidates: list[_Candidate]) -> list[_Candidate]:
        """Return candidates of which no two are the same, the first of each."""
        found: list[_Candidate] = []
        for candidate in candidates:
            if all(not self._same(candidate, other) for other in found):
                found.append(candidate)
        return found

    def _same(self, first: _Candidate, second: _Candidate) -> bool:
        """Return whether two candidates are the same up to symmetry."""
        return self._alike(first.fit.pose, second.fit.pose)

    def _alike(self, first: np.ndarray, second: np.ndarray) -> bool:
        """Return whether two poses, shape (4, 4), are the same up to symmetry."""
        cfg, alike = self.cfg.search, self.symmetry.nearest(second, first)
        shift = (first[:3, :3] - alike[:3, :3]) @ self.symmetry.centre + first[:3, 3] - alike[:3, 3]
        near = bool(np.linalg.norm(shift) < cfg.same_translation)
        return near and rotation_angle(first, alike) < np.radians(cfg.same_rotation)


def rival_turns(shape: TrackedShape, angle: float | None = None) -> np.ndarray:
    """Return turns of a box around the shape along its principal axes, and smaller ones about each of these, as
    transforms in the body frame, shape (k, 4, 4).

    They lead to other explanations of what a shape shows that looks alike from one side, such as a wedge (turned over)
    or a mug whose handle is hidden (turned a little), which random orientations may miss.

    Args:
        shape: The shape.
        angle: Return only the turns by this angle [rad] about each axis, in both directions.
    """
    axes = np.linalg.eigh(np.cov(shape.points.T))[1]
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    along = shape.points @ axes
    middle = axes @ (along.min(axis=0) + along.max(axis=0)) / 2
    angles = 2 * np.pi / RIVAL_STEPS * np.arange(1, RIVAL_STEPS) if angle is None else np.array([angle, -angle])
    turns = Rotation.from_rotvec((angles[:, None, None] * np.eye(3)).reshape(-1, 3)).as_matrix()
    if angle is None:
        turns = np.concatenate([Rotation.create_group("O").as_matrix(), turns])
    result = np.repeat(np.eye(4)[None], len(turns), axis=0)
    result[:, :3, :3] = axes @ turns @ axes.T
    result[:, :3, 3] = middle - result[:, :3, :3] @ middle
    return result


def preference(renderer: RayRenderer, view: View, shape: TrackedShape, first: Fit, second: Fit) -> tuple[float, int]:
    """Return the share of the pixels, of those at which two poses predict different depths, that are nearer to what
    the first predicts, and how many there are.

    Depths differ where they are farther apart than noise explains; pixels without measured depth do not count.
    """
    middles = [_middle(f.pose, shape) for f in (first, second)]
    centre = (middles[0] + middles[1]) / 2
    window = view.window(centre, shape.reach + float(np.linalg.norm(middles[0] - middles[1])) / 2)
    if window is None:
        return 0.5, 0
    area = (window[0].stop - window[0].start) * (window[1].stop - window[1].start)
    stride = max(1, int(np.sqrt(area / COMPARED_PIXELS)))
    pixels = pixel_grid(*view.shape)[window][::stride, ::stride].reshape(-1, 2)
    measured = view.depth[window][::stride, ::stride].ravel().astype(float)
    depths = []
    for fit in (first, second):
        renderer.place(shape.row, fit.pose)
        depth = renderer.cast(view.camera, pixels).depth
        depths.append(np.where(np.isfinite(depth), depth, NO_SURFACE))
    known = [f.depth_std for f in (first, second) if np.isfinite(f.depth_std)]
    different = (measured > 0) & (np.abs(depths[0] - depths[1]) > DIFFERENT * min(known, default=0.0))
    count = int(different.sum())
    nearer = np.abs(measured - depths[0]) < np.abs(measured - depths[1])
    return (float(nearer[different].mean()) if count else 0.5), count


def _nearest(best: _Candidate, clusters: list[Cluster], shape: TrackedShape) -> Cluster:
    """Return the cluster that a candidate explains, the largest of those that are as near."""
    middle = _middle(best.fit.pose, shape)
    return min(clusters, key=lambda c: float(np.median(np.linalg.norm(c.points - middle, axis=1))))


def _middle(pose: np.ndarray, shape: TrackedShape) -> np.ndarray:
    """Return where the middle of a body is at a pose [m], shape (3,)."""
    return pose[:3, :3] @ shape.centre + pose[:3, 3]


def _score(agreed: Agreement, fit: Fit, shape: TrackedShape, points: np.ndarray, cfg: TrackCfg) -> float:
    """Return how well a pose explains object, edges and unknown points (n, 3), 0 to 1."""
    near = points[np.linalg.norm(points - _middle(fit.pose, shape), axis=1) < 1.5 * shape.reach]
    local = (near - fit.pose[:3, 3]) @ fit.pose[:3, :3]
    tolerance = max(cfg.accept.depth_tolerance, 4 * fit.depth_std if np.isfinite(fit.depth_std) else 0.0)
    explained = float((np.abs(shape.surface.signed_distance(local)) < tolerance).mean()) if len(near) else 0.0
    edge = fit.edge_share if np.isfinite(fit.edge_share) else 0.0
    smooth = 1 / (1 + (agreed.misfit / cfg.accept.max_misfit) ** 2)
    return _fairness(agreed, cfg) * (0.6 * explained + 0.4 * edge) * smooth


def _fairness(agreed: Agreement, cfg: TrackCfg) -> float:
    """Return how well a pose agrees with depth and with where other bodies are, 0 to 1."""
    free = min(1.0, cfg.accept.max_penetration / max(agreed.penetration, 1e-9)) ** 2
    fair = max(agreed.share - agreed.behind, 0.0) * (1 - agreed.unexplained)
    return fair * free * min(agreed.visible, 1.0)
