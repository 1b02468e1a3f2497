"""The search of the paper's equation 1 over sphere positions, generation by generation, with checkpoints."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any

import mujoco
import numpy as np

from concent_warp.checks import Bounds, Count, Share, SmallShare, WindowLength
from concent_warp.estimation.object_tracks import Segment, observed_states
from concent_warp.fit.geometry.checkpoint import Checkpoint
from concent_warp.fit.geometry.evolution import Evolution, EvolutionCfg
from concent_warp.fit.geometry.faces import Faces, flattened
from concent_warp.fit.geometry.mask import robot_bodies, spheres_near, touched_spheres, with_neighbours
from concent_warp.fit.geometry.objective import Objective
from concent_warp.fit.geometry.offset import offset_directions
from concent_warp.model import Model
from concent_warp.simulate.engine import Engine
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.select import EngineName, make_engine


@dataclass(frozen=True)
class GeometrySearchCfg:
    """Settings of the evolution strategy's search."""

    evolution: EvolutionCfg = field(default_factory=EvolutionCfg)
    """Settings of the evolution strategy."""
    generations: Annotated[int, Bounds(0, 1_000_000)] = 70
    """Generations at most."""
    plateau_generations: Count = 20
    """Generations without progress after which the search ends: neither the lowest distance over the frames of the fit
    nor the one over the held-out frames has fallen by `min_gain`. Chosen on seeds of the shape sorter that no page
    reports: shorter ones stop on the flat stretch after the first generations."""
    min_gain: Share = 0.02
    """Relative fall of the distance that counts as progress [-], measured from its value at the last progress."""
    held_out: SmallShare = 0.2
    """Share of the frames that choose the best estimate and do not move it."""
    block: WindowLength = 0.2
    """Length of the held-out blocks [s]."""
    window: WindowLength | None = None
    """Length of windows to simulate on their own [s], each from the measured state at its start; None simulates whole
    demonstrations. Motion with impacts or tumbling asks for 0.1-0.3 s."""
    window_stride: WindowLength | None = None
    """Time from the start of one window to that of the next [s]; None takes the length."""
    batch: Count | None = None
    """Segments that a generation tries its candidates on, sampled anew each time; None takes all. With hundreds of
    windows a sample of 40-80 gives the same result at less cost."""
    jitter: float = 7e-4
    """Spread [m] of horizontal displacements of the free bodies at the start, sampled anew for each generation, with
    turns by `jitter_turn`. All candidates share them, so that the fit does not specialise on one path."""
    jitter_turn: float = float(np.radians(1.0) / 1e-3)
    """Turn of a jittered body relative to its displacement [rad/m]: 1 degree a millimetre."""
    grip_distance: float = 5e-4
    """Distance from the robot in the observed motion within which a sphere counts as gripped [m]."""
    max_flattening_rise: float = 0.1
    """Largest relative rise of the distance by flattening the starting geometry [-]; beyond it the faces stay as they
    are."""
    squared: bool = False
    """Squared form of the Chamfer distance."""
    reach: float = 0.004
    """Spheres that stay farther than this from everything else [m] are left out of the collisions of the search."""
    seed: int = 0
    """Seed of all random numbers."""


@dataclass(frozen=True)
class WarmStart:
    """Result of the gradient start."""

    helped: bool
    mean: np.ndarray
    """Displacements of the best iterate, in the strategy's channels, shape (S, C); those of the start without help."""
    before: float
    """Chamfer distance of the start in MuJoCo, mean of fitted and held-out frames [m]."""
    after: float
    """That of the best iterate [m]."""
    remark: str
    """Remark on the result."""
    losses: list[list[float]]
    """Loss in Newton of each start at each iteration [m]."""


@dataclass(frozen=True)
class Progress:
    """Progress of a fit."""

    generation: int
    generations: int
    loss: float
    """Chamfer distance of the present estimate [m]."""
    best: float
    """Chamfer distance of the best estimate so far, over the held-out frames [m]."""
    seconds_left: float
    """Estimate of the time to the last generation [s]."""
    simulations: int
    what: str = "generation"
    """Unit of the count."""


@dataclass(frozen=True)
class FitResult:
    """Result of a fit of contact geometry.

    Example:
        >>> import concent_warp as cw
        >>> cw.FitResult.__name__  # see `fit_geometry`
        'FitResult'
    """

    model: Model
    """The model with the fitted geometry."""
    start: Model
    """The model as it was."""
    history: list[dict[str, Any]]
    """One entry a generation: loss and held_out of the estimate [m], best, sigma [m], spheres, simulations, seconds."""
    mask: np.ndarray
    """Spheres that have moved, shape (S,) bool."""
    stopped: str
    """Why the fit ended."""
    gradients: WarmStart | None = None
    """What gradients found, where they were asked for."""


@dataclass(frozen=True)
class Survey:
    """Result of a replay of an estimate with all spheres."""

    mask: np.ndarray
    """Spheres that may move, shape (S,) bool."""
    reachable: np.ndarray
    """Spheres that may come into contact, shape (S,) bool."""
    loss: float
    """Chamfer distance over what the fit may use [m]."""
    held_out: float
    """Chamfer distance over what it is kept from [m]."""


class Search:
    """The state of a fit between generations."""

    def __init__(self, model: Model, segments: list[Segment], cfg: GeometrySearchCfg, engine: EngineName) -> None:
        """Prepare the first generation."""
        assert model.geometry is not None
        self.model, self.segments, self.cfg = model, segments, cfg
        self.engine_name: EngineName = engine
        strategy = cfg.evolution
        growth = offset_directions(model.geometry, model.scene, strategy.offset)
        faces = None
        if strategy.flattens:
            faces = Faces(model.geometry, model.scene, strategy.face_length, strategy.faces)
        self.evolution = Evolution(model.geometry, growth, cfg.evolution, faces)
        self.rng = np.random.default_rng(cfg.seed)
        self.robot = robot_bodies(model.scene.model)
        weld = np.array([model.scene.model.body(name).weldid[0] for name in model.geometry.bodies])
        self.movable = weld[model.geometry.body] != 0
        self.held_out = [s for s in segments if s.held_out]
        self.used = [s for s in segments if not s.held_out] or segments
        self.collidable = np.zeros(len(model.geometry), dtype=bool)
        self.frozen = np.zeros(len(model.geometry), dtype=bool)
        self.full = MujocoEngine(model)
        self.engine: Engine | None = None
        self.best, self.best_mean = np.inf, self.evolution.mean.copy()
        self.lowest, self.last_gain = np.inf, 0
        self.progress_from = np.inf, np.inf
        self.history: list[dict[str, Any]] = []
        self.simulations = 0
        self.seconds = 0.0
        self.stopped: str | None = None if cfg.generations > 0 else "no generations asked for"
        self.gradients: WarmStart | None = None

    def entry(self, survey: Survey, sigma: float, candidates: float | None = None) -> dict[str, Any]:
        """Return what the history says of the present generation."""
        return {
            "generation": self.evolution.generation,
            "loss": survey.loss,
            "held_out": survey.held_out,
            "best": min(self.best, survey.held_out) if candidates is None else self.best,
            "candidates": survey.loss if candidates is None else candidates,
            "sigma": sigma,
            "moving": int(survey.mask.sum()),
            "collidable": int(self.collidable.sum()),
            "simulations": self.simulations,
            "seconds": self.seconds,
        }

    def step(self) -> None:
        """Run one generation."""
        start = time.perf_counter()
        cfg, evolution = self.cfg, self.evolution
        segments = self.sample_segments()
        survey = self.survey([*segments, *self.held_out])
        if evolution.generation == 0 and not (self.gradients and self.gradients.helped):
            survey = self.flattened(survey, [*segments, *self.held_out])
        if evolution.generation == 0:
            loss = survey.loss
            if self.gradients and self.gradients.helped:
                # At the same distance the strategy itself would still take larger steps: it comes from farther away.
                loss = float(np.sqrt(self.gradients.before * self.gradients.after))
            evolution.scale_to(np.sqrt(loss) if cfg.squared else loss)
        self.note(survey)
        mask = survey.mask
        values = evolution.ask(mask, self.rng)
        objective = self.objective(self.prepared(survey.reachable | mask), self.jittered(segments))
        losses = objective(evolution.candidates(values))
        self.simulations += len(values) * len(segments)
        sigma = evolution.sigma * evolution.shrink
        evolution.tell(values, losses.fit, mask)
        self.seconds += time.perf_counter() - start
        self.history.append(self.entry(survey, sigma, float(np.median(losses.fit))))
        if evolution.generation >= cfg.generations:
            self.stopped = f"all {cfg.generations} generations done"
        elif evolution.generation - self.last_gain > cfg.plateau_generations:
            self.stopped = (
                f"error fell by less than {cfg.min_gain:.3g} of itself in {cfg.plateau_generations} generations"
            )
        if self.stopped is not None:
            self.note(self.survey([*segments, *self.held_out]))
            self.history[-1]["best"] = self.best

    def note(self, survey: Survey) -> None:
        """Keep the estimate if it is the best so far."""
        self.lowest = min(survey.loss, self.lowest)
        if survey.held_out < self.best:
            self.best, self.best_mean = survey.held_out, self.evolution.mean.copy()
        lowest = self.best, self.lowest
        share = 1 - self.cfg.min_gain
        if any(now < share * then for now, then in zip(lowest, self.progress_from, strict=True)):
            self.last_gain, self.progress_from = self.evolution.generation, lowest

    def flattened(self, rough: Survey, segments: list[Segment]) -> Survey:
        """Flatten the starting geometry's faces, unless that raises the distance by more than `max_flattening_rise`.

        Args:
            rough: What the geometry does as it is.
            segments: Segments of this generation, then those held out.
        """
        evolution = self.evolution
        if evolution.faces is None or not self.cfg.evolution.flat_start:
            return rough
        before, flat = evolution.mean.copy(), flattened(evolution.start, evolution.faces)
        evolution.mean[:, :3] = flat.position - evolution.start.position
        survey = self.survey(segments)
        if (
            survey.loss <= (1 + self.cfg.max_flattening_rise) * rough.loss
            and survey.held_out <= (1 + self.cfg.max_flattening_rise) * rough.held_out
        ):
            return survey
        evolution.mean = before
        return rough

    def sample_segments(self) -> list[Segment]:
        """Return the segments that the candidates of this generation are tried on."""
        if self.cfg.batch is None or self.cfg.batch >= len(self.used):
            return self.used
        return [self.used[i] for i in np.sort(self.rng.choice(len(self.used), self.cfg.batch, replace=False))]

    def jittered(self, segments: list[Segment]) -> list[Segment]:
        """Return segments whose free bodies start a little elsewhere."""
        if self.cfg.jitter <= 0:
            return segments
        m = self.model.scene.model
        free = np.flatnonzero(m.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE))
        result = []
        for segment in segments:
            qpos = segment.qpos.copy()
            for address in m.jnt_qposadr[free]:
                qpos[address : address + 2] += self.rng.normal(0, self.cfg.jitter, 2)
                turn = self.rng.normal(0, self.cfg.jitter) * self.cfg.jitter_turn / 2
                orientation = np.zeros(4)
                mujoco.mju_mulQuat(
                    orientation, np.array([np.cos(turn), 0, 0, np.sin(turn)]), qpos[address + 3 : address + 7]
                )
                qpos[address + 3 : address + 7] = orientation
            result.append(replace(segment, qpos=qpos))
        return result

    def survey(self, segments: list[Segment]) -> Survey:
        """Replay the estimate with all spheres.

        Args:
            segments: Segments of this generation, then those held out.
        """
        values = self.evolution.mean[None]
        geometry = self.evolution.geometry(values[0])
        objective = self.objective(self.full, segments)
        rollout = objective.simulate(self.evolution.candidates(values), contacts="touched").numpy()
        losses = objective.losses(rollout, 1)
        loss, held_out = float(losses.fit[0]), float(losses.held_out[0])
        touched, gripped = touched_spheres(rollout.touched.any(axis=0), self.full.sphere_geom, self.robot)
        every = slice(None, None, 2)
        simulated = rollout.qpos[:, every]
        observed = np.stack(
            [
                observed_states(self.model.scene.model, segment, rollout.time[every], states)
                for segment, states in zip(segments, simulated, strict=True)
            ]
        )
        current = self.model.with_geometry(geometry)
        states = np.concatenate([simulated, observed]).reshape(-1, simulated.shape[-1])
        if self.cfg.evolution.freeze_gripped:
            # A replay that fails lets the object slip through the gripper; the real grasp is where it was observed.
            seen = observed.reshape(-1, observed.shape[-1])
            self.frozen |= spheres_near(current, seen, self.cfg.grip_distance)[:, self.robot].any(axis=1) & self.movable
        mask = with_neighbours(geometry, touched, self.cfg.evolution.neighbours) & ~self.frozen
        reachable = spheres_near(current, states, self.cfg.reach).any(axis=1)
        self.simulations += len(segments)
        return Survey(mask, reachable | touched | gripped, loss, held_out)

    def prepared(self, needed: np.ndarray) -> Engine:
        """Return an engine with at least the needed spheres collidable."""
        if self.engine is None or (needed & ~self.collidable).any():
            self.collidable |= needed
            self.engine = make_engine(self.engine_name, self.model, collidable=self.collidable)
        return self.engine

    def objective(self, engine: Engine, segments: list[Segment]) -> Objective:
        """Return the objective on some segments."""
        cfg = self.cfg
        return Objective(engine, segments, held_out=cfg.held_out, block=cfg.block, squared=cfg.squared)

    def progress(self) -> Progress:
        """Return the progress of the fit."""
        done = self.evolution.generation
        left = self.seconds / max(done, 1) * (self.cfg.generations - done)
        return Progress(done, self.cfg.generations, self.history[-1]["loss"], self.best, left, self.simulations)

    def result(self) -> FitResult:
        """Return the best estimate."""
        moved = (self.best_mean != 0).any(axis=1)
        fitted = self.model.with_geometry(self.evolution.geometry(self.best_mean))
        return FitResult(fitted, self.model, self.history, moved, self.stopped or "interrupted", self.gradients)

    def checkpoint(self) -> Checkpoint:
        """Return all that is needed to go on."""
        return Checkpoint(
            cfg=asdict(self.cfg),
            start=self.evolution.start.position,
            mean=self.evolution.mean,
            best_mean=self.best_mean,
            collidable=self.collidable,
            frozen=self.frozen,
            random_state=dict(self.rng.bit_generator.state),
            numbers={
                "generation": self.evolution.generation,
                "best": self.best,
                "lowest": self.lowest,
                "last_gain": self.last_gain,
                "best_at_last_gain": self.progress_from[0],
                "lowest_at_last_gain": self.progress_from[1],
                "simulations": self.simulations,
                "seconds": self.seconds,
                "sigma": self.evolution.sigma,
            },
            history=self.history,
            stopped=self.stopped,
        )

    def restore(self, saved: Checkpoint) -> None:
        """Go on from a checkpoint."""
        saved.check(asdict(self.cfg), self.evolution.start.position)
        self.evolution.mean, self.best_mean = saved.mean, saved.best_mean
        self.collidable, self.frozen = saved.collidable, saved.frozen
        self.rng.bit_generator.state = saved.random_state
        self.evolution.sigma = saved.numbers["sigma"]
        self.evolution.generation = int(saved.numbers["generation"])
        self.best, self.lowest = saved.numbers["best"], saved.numbers["lowest"]
        self.last_gain = int(saved.numbers["last_gain"])
        self.progress_from = saved.numbers["best_at_last_gain"], saved.numbers["lowest_at_last_gain"]
        self.simulations, self.seconds = int(saved.numbers["simulations"]), saved.numbers["seconds"]
        self.history, self.stopped = saved.history, saved.stopped
