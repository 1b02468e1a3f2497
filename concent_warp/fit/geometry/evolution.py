"""The evolution strategy of the paper's appendix A: localised, RBF-smoothed perturbations, elites, moving average."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from concent_warp.checks import Bounds, Positive, PositiveShare, Share, SmallShare
from concent_warp.fit.geometry.faces import FaceCfg, Faces
from concent_warp.fit.geometry.objective import Candidates
from concent_warp.fit.geometry.offset import OffsetCfg
from concent_warp.fit.geometry.perturbation import Noise, Perturbation, smoothed
from concent_warp.scene.spheres.contact_geometry import ContactGeometry


@dataclass(frozen=True)
class EvolutionCfg:
    """Settings of the strategy."""

    population: Annotated[int, Bounds(2, 100_000)] = 32
    """Candidates a generation. On six seeds of the shape sorter that no page reports, 20 to 40 reached the same errors;
    the time of a fit grows with it."""
    sigma: Positive | None = None
    """Standard deviation of a sphere's displacement in the first generation [m]. None takes `sigma_share` of the
    starting Chamfer distance (both directions together), at most `max_sigma`: large steps far from the goal, small ones
    near it."""
    sigma_share: Positive = 1 / 6
    """That share of the Chamfer distance [-]. Empirical."""
    max_sigma: Positive = 3e-3
    """Largest standard deviation that is chosen automatically [m]."""
    sigma_decay: PositiveShare = 0.975
    """Factor on sigma from one generation to the next."""
    length: Positive = 0.03
    """Length scale of the RBF kernel [m]: how far a dent reaches."""
    noise: Noise = "gaussian_process"
    """Gaussian-process samples; "centroid" is the paper's wording taken literally; "independent" for comparison."""
    swelling: float = 1.0
    """Displacement outward, of all faces of a region by the same distance, relative to sigma; 0 for none."""
    swelling_length: Positive = 0.1
    """Length over which the swelling varies [m]."""
    flat_start: bool = True
    """Flatten the faces of the starting geometry unless that makes the replay worse: noise of single spheres, which
    one demonstration cannot distinguish from the true shape, is removed."""
    flattening: Share = 0.1
    """Share by which each generation takes the roughness out of the faces inside the mask; 0 for none."""
    face_length: Positive = 0.03
    """Length over which a face is flat [m]: its distance from the nominal surface varies linearly."""
    faces: FaceCfg = field(default_factory=FaceCfg)
    """Settings of the search for faces and of their flattening."""
    offset: OffsetCfg = field(default_factory=OffsetCfg)
    """Settings of the directions in which spheres move when their body grows."""
    antithetic: bool = True
    """Sample candidates in pairs of opposite displacement."""
    elite_share: PositiveShare = 0.25
    """Share of the candidates that move the estimate."""
    momentum: SmallShare = 0.6
    """Weight of the elites' mean in the exponential moving average [-]."""
    mean_smoothing: float = 0.0
    """Length [m] of a further smoothing of the update inside the mask; 0 leaves it as smooth as the noise is."""
    neighbours: int = 8
    """Neighbours of each touched sphere that may move too [-]."""
    freeze_gripped: bool = True
    """Keep the spheres that the robot touches where they are: otherwise the fit changes the grasp."""
    max_displacement: Positive = 0.012
    """How far a sphere may end from where it started [m]."""
    fit_radius: bool = False
    """Fit radii too."""
    radius_sigma: float = 0.05
    """Standard deviation of the logarithm of a radius [-]."""
    fit_friction: bool = False
    """Fit friction coefficients too."""
    friction_sigma: float = 0.1
    """Standard deviation of the logarithm of a friction coefficient [-]."""

    @property
    def flattens(self) -> bool:
        """Whether faces are flattened."""
        return self.flat_start or self.flattening > 0

    def scales(self, sigma: float) -> np.ndarray:
        """Return the standard deviation of each channel in the first generation, shape (C,); `sigma` is in m."""
        radius = [self.radius_sigma] if self.fit_radius else []
        friction = [self.friction_sigma] if self.fit_friction else []
        return np.array([sigma] * 3 + radius + friction)


class Evolution:
    """The estimate and how it moves. Displacements are relative to the starting geometry, shape (S, C).

    Channels are x, y, z [m], then the logarithms of radius and friction where these are fitted.
    """

    def __init__(
        self, start: ContactGeometry, growth: np.ndarray, cfg: EvolutionCfg, faces: Faces | None = None
    ) -> None:
        """Start at the given geometry, whose spheres move by `growth` (S, 3) where their body grows by one.

        `faces` are those of the starting geometry; without them the estimate is not flattened.
        """
        self.start, self.growth, self.cfg, self.faces = start, growth, cfg, faces
        self.sigma = cfg.max_sigma if cfg.sigma is None else cfg.sigma
        self.mean = np.zeros((len(start), len(cfg.scales(self.sigma))))
        self.generation = 0

    def scale_to(self, distance: float) -> None:
        """Choose sigma by the Chamfer distance of the start [m], unless the settings give it."""
        if self.cfg.sigma is None and np.isfinite(distance):
            self.sigma = min(self.cfg.sigma_share * distance, self.cfg.max_sigma)

    @property
    def shrink(self) -> float:
        """Factor on the standard deviations in this generation."""
        return self.cfg.sigma_decay**self.generation

    def ask(self, mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return displacements of the candidates, shape (population, S, C); the estimate itself is not among them."""
        cfg = self.cfg
        perturbation = Perturbation(
            self.geometry(self.mean),
            mask,
            cfg.noise,
            cfg.length,
            growth=self.growth,
            swelling=cfg.swelling,
            swelling_length=cfg.swelling_length,
        )
        pairs = (cfg.population + 1) // 2 if cfg.antithetic else cfg.population
        noise = perturbation.sample(pairs, self.mean.shape[1], rng) * cfg.scales(self.sigma) * self.shrink
        if cfg.antithetic:
            noise = np.stack([noise, -noise], axis=1).reshape(-1, *self.mean.shape)[: cfg.population]
        return self.bounded(self.mean + noise)

    def tell(self, candidates: np.ndarray, losses: np.ndarray, mask: np.ndarray) -> None:
        """Move the estimate towards the best of the candidates and go on to the next generation."""
        cfg = self.cfg
        count = max(1, round(cfg.elite_share * len(candidates)))
        order = np.argsort(losses, kind="stable")[:count]
        order = order[np.isfinite(losses[order])]
        if len(order):
            step = cfg.momentum * (candidates[order].mean(axis=0) - self.mean)
            if cfg.mean_smoothing > 0:
                step = smoothed(self.geometry(self.mean), mask, step, cfg.mean_smoothing)
            self.mean = self.bounded(self.mean + step)
        if self.faces is not None and cfg.flattening > 0:
            flatter = self.mean.copy()
            flatter[mask, :3] += cfg.flattening * self.faces.flattening(self.mean[:, :3])[mask]
            self.mean = self.bounded(flatter)
        self.generation += 1

    def bounded(self, values: np.ndarray) -> np.ndarray:
        """Return displacements (..., S, C) no longer than `max_displacement`."""
        length = np.linalg.norm(values[..., :3], axis=-1, keepdims=True)
        shrink = np.minimum(1.0, self.cfg.max_displacement / np.maximum(length, 1e-12))
        return np.concatenate([values[..., :3] * shrink, values[..., 3:]], axis=-1)

    def candidates(self, values: np.ndarray) -> Candidates:
        """Return what displacements (P, S, C) mean for the spheres."""
        position, radius, friction = self.properties(values)
        return Candidates(position, radius, friction)

    def geometry(self, values: np.ndarray) -> ContactGeometry:
        """Return the geometry that displacements (S, C) make."""
        position, radius, friction = self.properties(values)
        return replace(
            self.start,
            position=position,
            radius=self.start.radius if radius is None else radius,
            friction=self.start.friction if friction is None else friction,
        )

    def properties(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
        """Return positions (..., S, 3) [m], radii (..., S) [m] and frictions (..., S); None what is not fitted."""
        channel = 3
        radius = friction = None
        if self.cfg.fit_radius:
            radius = self.start.radius * np.exp(values[..., channel])
            channel += 1
        if self.cfg.fit_friction:
            friction = self.start.friction * np.exp(values[..., channel])
        return self.start.position + values[..., :3], radius, friction
