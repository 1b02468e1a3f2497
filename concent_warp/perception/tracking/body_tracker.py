"""Tracking of one body from moment to moment: prediction, refinement, keyframes, loss and recovery."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from concent_warp.perception.tracking.alignment.align import FREE, Agreement, Fit, agreement, refine
from concent_warp.perception.tracking.alignment.clusters import Region
from concent_warp.perception.tracking.alignment.registration import relocated
from concent_warp.perception.tracking.alignment.rows import bias_stds, rendered_crop
from concent_warp.perception.tracking.alignment.search import find_pose
from concent_warp.perception.tracking.alignment.texture import Keyframe, TextureMap
from concent_warp.perception.tracking.cfg import TrackCfg
from concent_warp.perception.tracking.geometry.pose import moved, rotation_angle, twist_between
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.symmetry import Symmetry
from concent_warp.perception.tracking.geometry.view import View

NEARBY = np.diag([1 / 0.015**2] * 3 + [1 / 0.25**2] * 3)
"""Information of a prediction from the frame before [1/m^2, 1/rad^2]: 15 mm and 0.25 rad."""
CHOSEN_TURN = 0.002
"""Standard deviation of turns that a shape does not show, in the first keyframe, which defines them [rad]."""
MAX_TRIES = 3
"""Renewed attempts at the last pose, in a row, before only searches may find a lost body again."""


class BodyTracker:
    """State of the tracking of one body."""

    def __init__(self, shape: TrackedShape, symmetry: Symmetry, cfg: TrackCfg) -> None:
        """Create a tracker of a body that is not found yet."""
        self.shape, self.symmetry, self.cfg = shape, symmetry, cfg
        self.pose: np.ndarray | None = None
        """Last pose, shape (4, 4)."""
        self.tracked = False
        """Whether it was seen in the last moment."""
        self.speed = np.zeros(6)
        """Twist a second, shape (6,)."""
        self.time = 0.0
        """Time of the last pose [s]."""
        self.searched = -np.inf
        """Time of the last search [s]."""
        self.reason = ""
        """Why it was not found last."""
        self.misses = 0
        """Moments since it was seen."""
        self.fits: list[Fit | None] = []
        """One for each moment."""
        self.reasons: list[str] = []
        """Why no pose was accepted in each moment, in words; empty where one was."""
        self.objections: list[str] = []
        """What spoke against each pose that was tried in this moment."""
        self.regions: tuple[Region | None, ...] = ()
        """Where a user says that it is, in each view of the moment; None in views that are not searched."""
        self.textures = TextureMap(cfg.texture)
        """Keyframes."""
        self.first_keyframe = 0
        """Number of the first keyframe that is compared: those before show a turn that is no longer known."""

    def begin(self, renderer: RayRenderer, time: float, views: Sequence[View], pose: np.ndarray) -> Agreement:
        """Take up a given first pose if the first moment agrees with it after a small correction; return the
        agreement.
        """
        fit = refine(renderer, views, self.shape, pose, self.cfg.align, rough=True, symmetry=self.symmetry)
        if fit is None:
            return Agreement(0, 0.0, 0.0, 0.0, 0.0)
        agreed = agreement(renderer, views, self.shape, fit.pose, fit.depth_std, self.cfg.accept)
        if agreed.accepted(self.cfg.accept) and self.certain(fit):
            self.pose, self.tracked, self.time = fit.pose, True, time
            self.fits.append(replace(self.settled(renderer, views, fit), agreement=agreed))
            self.reasons.append("")
        renderer.place(self.shape.row, self.pose)
        return agreed

    def advance(
        self,
        renderer: RayRenderer,
        time: float,
        views: Sequence[View],
        rng: np.random.Generator,
    ) -> None:
        """Process one moment."""
        fit, self.objections = None, []
        if self.pose is not None and (self.tracked or self.misses < MAX_TRIES):
            fit = self.followed(renderer, time, views)
        if fit is None and not self.tracked and time - self.searched >= self.cfg.search.interval:
            fit = self.recovered(renderer, time, views, rng)
        self.reasons.append("" if fit is not None else (self.objections or [self.reason or "not searched yet"])[-1])
        if fit is None:
            self.reason = self.reasons[-1]
            self.tracked, self.misses = False, self.misses + 1
            if self.misses >= MAX_TRIES:
                self.speed = np.zeros(6)
            renderer.place(self.shape.row, None)
        else:
            if self.tracked and self.pose is not None and time > self.time:
                speed = twist_between(self.pose, fit.pose) / (time - self.time)
                self.speed = 0.3 * self.speed + 0.7 * speed
            self.pose, self.tracked, self.time, self.misses = fit.pose, True, time, 0
            renderer.place(self.shape.row, fit.pose)
        self.fits.append(fit)

    def followed(self, renderer: RayRenderer, time: float, views: Sequence[View]) -> Fit | None:
        """Return the fit near the predicted pose, or None where nothing agrees."""
        assert self.pose is not None
        predicted = moved(self.pose, (time - self.time) * self.speed)
        fit = self.accepted(renderer, views, predicted, self.chosen(views, predicted), rough=False)
        if fit is None and not self.tracked:
            predicted = self.pose
            fit = self.accepted(renderer, views, predicted, self.chosen(views, predicted), rough=False)
        if fit is None:
            starts = [
                relocated(renderer, v, self.shape, predicted, self.cfg.search.reach, self.cfg.search) for v in views
            ]
            for start in (*starts, predicted):
                if fit is None and start is not None:
                    fit = self.accepted(renderer, views, start, self.chosen(views, start), rough=True)
                    fit = None if fit is None else self.same_representative(renderer, views, fit, predicted)
        if fit is None and self.is_round():
            fit = self.turned(renderer, views, predicted)
        return None if fit is None else self.settled(renderer, views, fit)

    def turned(self, renderer: RayRenderer, views: Sequence[View], predicted: np.ndarray) -> Fit | None:
        """Return the fit of a round body by depth and edges alone: it may have turned more than its texture tells."""
        unknown: list[tuple[int, Keyframe] | None] = [None] * len(views)
        fit = self.accepted(renderer, views, predicted, unknown, rough=False)
        if fit is not None:
            self.first_keyframe = len(self.textures.keyframes)
        return fit

    def is_round(self) -> bool:
        """Return whether there are turns that depth and edges do not show at all."""
        return self.symmetry.axis is not None or self.symmetry.sphere

    def accepted(
        self,
        renderer: RayRenderer,
        views: Sequence[View],
        start: np.ndarray,
        keyframes: list[tuple[int, Keyframe] | None],
        *,
        rough: bool,
    ) -> Fit | None:
        """Return the fit from a start if the frames agree with it."""
        cfg = self.cfg
        fit = refine(
            renderer, views, self.shape, start, cfg.align,
            prior=FREE if rough else NEARBY, keyframes=keyframes, texture=cfg.texture, rough=rough,
            symmetry=self.symmetry,
        )  # fmt: skip
        if fit is None:
            self.objections.append("it is out of the image")
            return None
        if not self.certain(fit):
            std, most = 1e3 * fit.position_std(), 1e3 * cfg.accept.max_translation_std
            known = f"its position is known to {std:.0f} mm only (at most {most:g})"
            self.objections.append(known if std < 10 * most else "too little of it is seen to determine its position")
            return None
        if np.isfinite(fit.texture_correlation) and fit.texture_correlation < cfg.accept.min_texture:
            correlation, least = fit.texture_correlation, cfg.accept.min_texture
            self.objections.append(f"its texture is not seen there (correlation {correlation:.2f}, at least {least:g})")
            return None
        agreed = agreement(renderer, views, self.shape, fit.pose, fit.depth_std, cfg.accept)
        if against := agreed.objections(cfg.accept, followed=self.misses < MAX_TRIES and self.pose is not None):
            self.objections.append("; ".join(against))
            return None
        return replace(fit, agreement=agreed)

    def certain(self, fit: Fit) -> bool:
        """Return whether a fit's position is known well enough."""
        return fit.position_std() < self.cfg.accept.max_translation_std

    def chosen(self, views: Sequence[View], pose: np.ndarray) -> list[tuple[int, Keyframe] | None]:
        """Return number and keyframe for each view, None where none fits."""
        result: list[tuple[int, Keyframe] | None] = []
        for view in views:
            keyframe = self.textures.choose(view, pose, self.first_keyframe)
            if keyframe is None and self.is_round():  # which texture alone shows to turn
                keyframe = self.textures.choose(view, pose, self.first_keyframe, 1.6)
            index = next((i for i, k in enumerate(self.textures.keyframes) if k is keyframe), -1)
            result.append(None if keyframe is None else (index, keyframe))
        return result

    def settled(self, renderer: RayRenderer, views: Sequence[View], fit: Fit) -> Fit:
        """Return a fit, after a keyframe was made of each view that has none near."""
        for view in views:
            if self.textures.choose(view, fit.pose, self.first_keyframe) is not None:
                continue
            renderer.place(self.shape.row, fit.pose)
            crop = rendered_crop(renderer, view, self.shape, fit.pose, 20_000)
            if crop is not None:
                self.textures.add(view, crop, fit.pose, self.covariance(fit))
        return fit

    def covariance(self, fit: Fit) -> np.ndarray:
        """Return the covariance of a fit's pose, shape (6, 6), common errors included."""
        information = fit.geometry.information + sum(
            np.linalg.inv(np.linalg.inv(n.information + 1e-3 * FREE) + self.textures.keyframes[k].covariance)
            for k, n in fit.texture
        )
        if not self.textures.keyframes:
            turn = fit.pose[:3, :3]
            information[3:, 3:] += turn @ self.symmetry.chosen_turns() @ turn.T / CHOSEN_TURN**2
        inverse = np.linalg.inv(information + FREE)
        std = bias_stds(self.cfg.align)
        bias = inverse @ fit.geometry.bias * std
        return inverse + bias @ bias.T

    def recovered(
        self,
        renderer: RayRenderer,
        time: float,
        views: Sequence[View],
        rng: np.random.Generator,
    ) -> Fit | None:
        """Return the fit of a search in all views, in the representative that follows on from what was known."""
        regions = self.regions or (None,) * len(views)
        if self.regions and not any(regions):
            return None
        self.searched = time
        best = None
        for view, region in zip(views, regions, strict=True):
            if self.regions and region is None:
                continue
            found = find_pose(renderer, view, self.shape, self.symmetry, self.cfg, rng, region)
            if found.reason:
                self.objections.append(found.reason)
            if found.fit is not None and (best is None or found.score > best.score):
                best = found
        if best is None or best.fit is None:
            return None
        pose = self.representative(renderer, views, best.fit.pose)
        fit = self.accepted(renderer, views, pose, self.chosen(views, pose), rough=False)
        return None if fit is None else self.settled(renderer, views, fit)

    def representative(self, renderer: RayRenderer, views: Sequence[View], pose: np.ndarray) -> np.ndarray:
        """Return that pose, of all that the symmetries make alike, whose texture fits, else the nearest to the last."""
        if len(self.symmetry.turns) == 1:
            return pose
        best, most = None, self.cfg.texture.min_correlation
        if self.textures.keyframes:
            for other in self.symmetry.equivalents(pose):
                keyframes = self.chosen(views, other)
                if not any(keyframes):
                    continue
                fit = refine(
                    renderer, views, self.shape, other, self.cfg.align,
                    keyframes=keyframes, texture=self.cfg.texture, iterations=1,
                )  # fmt: skip
                if fit is not None and fit.texture_correlation > most:
                    best, most = fit.pose, fit.texture_correlation
        if best is not None:
            return best
        reference = np.eye(4) if self.pose is None else self.pose
        return self.symmetry.nearest(pose, reference)

    def same_representative(
        self, renderer: RayRenderer, views: Sequence[View], fit: Fit, predicted: np.ndarray
    ) -> Fit | None:
        """Return a fit in that pose, of all that the symmetries make alike, which is nearest to the predicted one.

        The points of a part of the body may be aligned in another; texture is compared in the nearest one.
        """
        pose = self.symmetry.nearest(fit.pose, predicted)
        if rotation_angle(pose, fit.pose) < np.radians(self.cfg.search.same_rotation):
            return fit
        nearest = self.accepted(renderer, views, pose, self.chosen(views, pose), rough=False)
        # Of a round shape hardly any texture may tell turns about its axis, and none of them is an exchange.
        return fit if nearest is None and self.is_round() else nearest

    def numbered_fits(self) -> tuple[list[Fit | None], int]:
        """Return the fits of all moments and the number of keyframes that their texture refers to."""
        return self.fits, len(self.textures.keyframes)

    def keyframe_turns(self) -> list[np.ndarray]:
        """Return what is known of each keyframe's turn about axes about which the shape is round.

        For the first it was chosen, for the others texture has told it.

        Returns:
            Information in the body's frame, shape (3, 3) each [1/rad^2].
        """
        open_turns = self.symmetry.chosen_turns()
        found = []
        for keyframe in self.textures.keyframes:
            turn = keyframe.pose[:3, :3]
            within = open_turns @ turn.T @ keyframe.covariance[3:, 3:] @ turn @ open_turns
            found.append(np.linalg.pinv(within, rcond=1e-6, hermitian=True) if open_turns.any() else open_turns)
        return found

    def correction(self, given: np.ndarray) -> tuple[float, float]:
        """Return how far the pose is from a given one: distance of the middle [m] and angle [rad]."""
        assert self.pose is not None
        middle = self.shape.centre
        shift = (self.pose[:3, :3] - given[:3, :3]) @ middle + self.pose[:3, 3] - given[:3, 3]
        return float(np.linalg.norm(shift)), rotation_angle(self.pose, given)
