"""A start for the evolution strategy by gradients, and the rule by which gradients count as no help.

Gradients help where the best iterate, evaluated again in MuJoCo over all frames, lies below the start by a given share.
Elsewhere, and where Newton cannot simulate the scene stably, the evolution strategy begins as if there had been none.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from concent_warp.errors import EngineError, ModelError
from concent_warp.fit.geometry.perturbation import Perturbation
from concent_warp.fit.geometry.search import Search, Survey, WarmStart
from concent_warp.fit.newton.descent import (
    Descent,
    GradientCfg,
    Metric,
    chosen_iterates,
    descend,
    descent_identity,
    start_descent,
)
from concent_warp.fit.newton.horizon import gradient_segments
from concent_warp.fit.newton.loss import NewtonLoss, mujoco_loss
from concent_warp.fit.newton.scene import newton_scene
from concent_warp.recording.recording import Demonstration


class GradientWarmStart:
    """Gradients from the state of a fit before its first generation."""

    def __init__(self, search: Search, demonstrations: Sequence[Demonstration], cfg: GradientCfg) -> None:
        """Replay the starting geometry.

        Args:
            search: The fit.
            demonstrations: Where its segments come from, one for each; empty where they are windows already.
            cfg: Settings of the descent.
        """
        self.search, self.cfg, self.demonstrations = search, cfg, demonstrations
        self.begun = time.perf_counter()
        self.segments = [*search.used, *(s for s in search.held_out if s not in search.used)]
        self.survey: Survey = search.flattened(search.survey(self.segments), self.segments)
        evolution = search.evolution
        evolution.scale_to(self.metres(self.survey.loss))
        self.start = evolution.mean.copy()
        self.base = evolution.geometry(self.start).position
        self.before = (self.survey.loss + self.survey.held_out) / 2

    def run(self, file: Path | None, resume: bool, progress: Callable[[int, float, float], None] | None) -> WarmStart:
        """Descend, score again, and judge.

        Args:
            file: Where the state is kept after each iteration.
            resume: Go on from it.
            progress: Called with the iteration, the lowest loss [m] and the time left [s].

        Raises:
            ModelError: The file has another state.
        """
        search, cfg = self.search, self.cfg
        segments = gradient_segments(
            search.model, search.used, self.demonstrations, cfg.horizon,
            held_out=search.cfg.held_out, block=search.cfg.block,
        )  # fmt: skip
        mine = descent_identity(cfg, search.cfg.seed, self.base, [s.name for s in segments])
        state = start_descent(self.starts(), self.first_step())
        if resume and file is not None and file.is_file():
            state = Descent.load(file, mine)
        if not state.finished:
            model = search.model.with_geometry(search.evolution.geometry(self.start))
            try:
                scene = newton_scene(model, segments, cfg.newton)
                loss = NewtonLoss(scene, cfg.starts, squared=search.cfg.squared, device=cfg.device)
            except (EngineError, ModelError) as error:
                return self.without_help(f"gradients are not to be had here: {error}", [])

            def keep(left: float) -> None:
                if file is not None:
                    state.save(file, mine)
                if progress is not None:
                    progress(len(state.losses), self.metres(float(state.lowest.min())), left)

            self.descend(state, loss, keep)
        best, after = self.best_in_mujoco(state)
        if best is None:
            return self.without_help("gradients do not help here: Newton simulates another motion", state.losses)
        text = (
            f"best iterate {1e3 * self.metres(after):.2f} mm in MuJoCo, start {1e3 * self.metres(self.before):.2f} mm"
        )
        if after > (1 - cfg.min_gain) * self.before:
            return self.without_help(f"gradients do not help here ({text})", state.losses)
        search.seconds += time.perf_counter() - self.begun
        return WarmStart(True, best, self.before, after, f"gradients helped: {text}", state.losses)

    def descend(self, state: Descent, loss: NewtonLoss, keep: Callable[[float], None]) -> None:
        """Descend to the end; `keep` is called after each iteration with the time left [s]."""
        search, cfg = self.search, self.cfg
        evolution = search.evolution
        metric = Metric(
            evolution.start, self.survey.mask, evolution.growth, evolution.cfg.length, evolution.cfg.swelling,
            evolution.cfg.swelling_length,
        )  # fmt: skip
        begun, before = time.perf_counter(), len(state.losses)
        while not state.finished:
            descend(state, loss, self.base, metric, cfg, self.bounded)
            count = len(state.losses)
            if count == 1 and min(state.losses[0]) > cfg.max_engine_ratio * mujoco_loss(loss.objective, loss.scene):
                state.kept, state.kept_start, state.finished = [], [], True
            if count == cfg.first_rescoring and not state.finished:
                state.finished = self.best_in_mujoco(state)[1] >= self.before
            keep((time.perf_counter() - begun) / (count - before) * (cfg.iterations - count))
        search.simulations += loss.simulations

    def metres(self, loss: float) -> float:
        """Return a loss as a distance [m]."""
        return float(np.sqrt(loss)) if self.search.cfg.squared else loss

    def without_help(self, why: str, losses: list[list[float]]) -> WarmStart:
        """Return the start, and what is to be said."""
        self.search.seconds += time.perf_counter() - self.begun
        remark = f"{why.rstrip('.')}; the evolution strategy goes on without them"
        return WarmStart(False, self.start, self.before, self.before, remark, losses)

    def starts(self) -> np.ndarray:
        """Return the displacements to start from, shape (P, S, 3): the start itself, and disturbed ones."""
        search = self.search
        evolution = search.evolution
        perturbation = Perturbation(
            evolution.geometry(self.start),
            self.survey.mask,
            evolution.cfg.noise,
            evolution.cfg.length,
            growth=evolution.growth,
            swelling=evolution.cfg.swelling,
            swelling_length=evolution.cfg.swelling_length,
        )
        rng = np.random.default_rng([search.cfg.seed, 1])
        noise = perturbation.sample(self.cfg.starts, 3, rng) * evolution.sigma
        noise[0] = 0.0
        return self.bounded(noise)

    def bounded(self, displacement: np.ndarray) -> np.ndarray:
        """Return displacements from the start (P, S, 3) that keep within the strategy's bounds."""
        start = self.start[:, :3]
        return self.search.evolution.bounded(start + displacement) - start

    def first_step(self) -> float:
        """Return the length of the first step [m]."""
        if self.cfg.step is not None:
            return self.cfg.step
        return min(self.metres(self.before) / 3, self.cfg.largest_step)

    def best_in_mujoco(self, state: Descent) -> tuple[np.ndarray | None, float]:
        """Return the best iterate in MuJoCo, in the strategy's channels, shape (S, C), and its distance [m]."""
        search = self.search
        iterates = chosen_iterates(state, self.cfg.rescored_iterates)
        if not len(iterates):
            return None, np.inf
        values = np.repeat(self.start[None], len(iterates), axis=0)
        values[:, :, :3] += iterates
        losses = search.objective(search.full, self.segments)(search.evolution.candidates(values))
        search.simulations += len(iterates) * len(self.segments)
        total = (losses.fit + losses.held_out) / 2
        return values[int(total.argmin())], float(total.min())
