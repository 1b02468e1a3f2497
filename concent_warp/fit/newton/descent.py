"""Descent of the Chamfer distance by gradients through Newton, from many starts at once, judged in MuJoCo.

A step follows the gradient in the metric of the evolution strategy's noise: its covariance times the gradient, so that
faces move together and single touched spheres do not. It is normalised, since gradients grow with the horizon. Each
start keeps its best iterate, goes back to it where the loss rises or is not finite, and shortens its step. A weight on
the displacement keeps the geometry near the prior. Newton's optimum is not MuJoCo's: several iterates of each start are
scored again in MuJoCo, and the best of those counts.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from concent_warp.array_file import write_arrays
from concent_warp.checks import Bounds, Count, Factor, OpenShare, Positive
from concent_warp.errors import ModelError
from concent_warp.fit.geometry.perturbation import rbf
from concent_warp.fit.newton.horizon import HorizonCfg
from concent_warp.fit.newton.loss import NewtonLoss
from concent_warp.fit.newton.physics import NewtonCfg
from concent_warp.fit.newton.worlds import Parameters
from concent_warp.scene.spheres.contact_geometry import ContactGeometry


@dataclass(frozen=True)
class GradientCfg:
    """Settings of the descent."""

    starts: Annotated[int, Bounds(1, 10_000)] = 2
    """Geometries to start from, all at once: the model's, then disturbed ones."""
    iterations: int = 16
    """Steps of each start at most."""
    step: Positive | None = None
    """Length of the first step of the sphere that moves farthest [m]. None takes a third of the starting distance, at
    most `largest_step`."""
    largest_step: Positive = 1.5e-3
    """Longest first step that is chosen automatically [m]."""
    step_increase: Factor = 1.2
    """Factor by which a step grows after one that lowers the loss [-]. Empirical."""
    step_decrease: OpenShare = 0.5
    """Factor by which a step shrinks after one that does not [-]: bisection."""
    plateau_iterations: Count = 4
    """Steps in which the lowest loss must fall below `plateau_ratio`, or the descent ends [-]. Empirical."""
    plateau_ratio: float = 0.97
    """Lowest loss over that `plateau_iterations` before, above which the descent ends [-]. Empirical."""
    smallest_step: Positive = 2e-5
    """A start whose steps are shorter is finished [m]."""
    prior: float = 5.0
    """Weight of the mean squared displacement in the loss [1/m]."""
    rescored_iterates: Count = 4
    """Iterates of each start that are evaluated again in MuJoCo [-]."""
    first_rescoring: Count = 8
    """Steps after which iterates are evaluated in MuJoCo for the first time [-]: where none of them is better than the
    start, the descent ends."""
    max_engine_ratio: Positive = 5.0
    """Loss in Newton of the best start over that of the model in MuJoCo, on the same segments, above which gradients
    are not used [-]: Newton then simulates another motion, such as a slipping grasp. Empirical."""
    min_gain: float = 0.05
    """Relative fall of the loss in MuJoCo below which gradients count as without effect [-]."""
    device: str | None = None
    """Where Newton runs, "cpu" or "cuda:0"; None takes CUDA where there is a device."""
    horizon: HorizonCfg = field(default_factory=HorizonCfg)
    """Settings of the lengths of the segments."""
    newton: NewtonCfg = field(default_factory=NewtonCfg)
    """Settings of Newton's contacts and solver."""


@dataclass
class Descent:
    """State of each of P starts; all displacements are relative to the starting geometry [m]."""

    now: np.ndarray
    """Displacements to try next, shape (P, S, 3)."""
    best: np.ndarray
    """Best displacements so far, shape (P, S, 3)."""
    direction: np.ndarray
    """Direction of descent at the best, longest row 1, shape (P, S, 3)."""
    lowest: np.ndarray
    """Loss with the prior's at the best [m], shape (P,)."""
    step: np.ndarray
    """Length of the next step [m], shape (P,)."""
    kept: list[np.ndarray]
    """Displacements of every iterate that was better than those before it, each (S, 3)."""
    kept_start: list[int]
    """To which start each of them belongs."""
    lows: list[float]
    """Lowest of these over all starts after each iteration [m]."""
    finished: bool
    """Whether no start goes on."""
    losses: list[list[float]]
    """Loss in Newton of each start at each iteration, without the prior's [m]; infinite where it was not finite."""

    def save(self, path: Path, identity: dict[str, Any]) -> None:
        """Write the state in one piece, with what it belongs to."""
        path.parent.mkdir(parents=True, exist_ok=True)
        kept = np.array(self.kept).reshape(-1, *self.now.shape[1:])
        content = {name: getattr(self, name) for name in ("now", "best", "direction", "lowest", "step")}
        content |= {"kept": kept, "kept_start": np.array(self.kept_start, dtype=int), "finished": self.finished}
        content |= {"losses": np.array(json.dumps([self.losses, self.lows]))}
        write_arrays(path, content | {"identity": np.array(json.dumps(identity))})

    @staticmethod
    def load(path: Path, identity: dict[str, Any]) -> Descent:
        """Read what `save` wrote.

        Raises:
            ModelError: The file is no state of a descent, or of another one.
        """
        try:
            with np.load(path, allow_pickle=False) as data:
                arrays = {name: data[name] for name in ("now", "best", "direction", "lowest", "step")}
                kept, starts = list(data["kept"]), [int(k) for k in data["kept_start"]]
                finished = bool(data["finished"])
                (losses, lows), found = json.loads(str(data["losses"])), json.loads(str(data["identity"]))
        except Exception as error:  # NumPy, zipfile and json raise whatever their parsers do
            raise ModelError(
                "not a state of a descent", where=path, found=error, fix="delete it to start anew"
            ) from None
        if found != json.loads(json.dumps(identity)):
            raise ModelError(
                "the state belongs to a descent with other settings or another geometry",
                where=path,
                fix="repeat the settings, or start anew without --resume",
            )
        return Descent(**arrays, kept=kept, kept_start=starts, lows=lows, finished=finished, losses=losses)


class Metric:
    """The covariance of the evolution strategy's noise over the spheres of a mask, shape (3 S, 3 S), by body."""

    def __init__(
        self,
        geometry: ContactGeometry,
        mask: np.ndarray,
        growth: np.ndarray,
        length: float,
        swelling: float,
        far: float,
    ) -> None:
        """Prepare.

        Args:
            geometry: Where the spheres are.
            mask: Spheres that may move, shape (S,) bool.
            growth: Displacement of each sphere where its body grows by one, shape (S, 3).
            length: Length scale of dents [m].
            swelling: Weight of the swelling.
            far: Length scale of the swelling [m].
        """
        self.growth, self.swelling = growth, swelling
        self.blocks = []
        for body in geometry.bodies:
            rows = geometry.of(body)
            rows = rows[mask[rows]]
            points = geometry.position[rows]
            if len(rows):
                self.blocks.append((rows, rbf(points, points, length), rbf(points, points, far)))

    def direction(self, gradient: np.ndarray) -> np.ndarray:
        """Return the direction of descent of gradients (P, S, 3), the longest row of each being 1; zero for NaN."""
        gradient = np.where(np.isfinite(gradient).all(axis=(1, 2), keepdims=True), gradient, 0.0)
        result = np.zeros_like(gradient)
        for rows, near, far in self.blocks:
            mine, growth = gradient[:, rows], self.growth[rows]
            result[:, rows] = -np.einsum("rk,pkc->prc", near, mine)
            along = np.einsum("rk,pk->pr", far, np.einsum("pkc,kc->pk", mine, growth))
            result[:, rows] -= self.swelling**2 * along[:, :, None] * growth
        longest = np.linalg.norm(result, axis=2).max(axis=1)
        return result / np.maximum(longest, 1e-30)[:, None, None]


def start_descent(displacement: np.ndarray, step: float) -> Descent:
    """Return the state before the first step from displacements (P, S, 3)."""
    count = len(displacement)
    return Descent(
        now=displacement.copy(),
        best=displacement.copy(),
        direction=np.zeros_like(displacement),
        lowest=np.full(count, np.inf),
        step=np.full(count, step),
        kept=[],
        kept_start=[],
        lows=[],
        finished=False,
        losses=[],
    )


def descend(
    state: Descent,
    loss: NewtonLoss,
    base: np.ndarray,
    metric: Metric,
    cfg: GradientCfg,
    bounded: Callable[[np.ndarray], np.ndarray],
) -> None:
    """Try the next iterate of each start and choose the one after it.

    Args:
        state: Where the starts stand, changed in place.
        loss: Loss of as many candidates as there are starts.
        base: Sphere centres of the starting geometry [m], shape (S, 3).
        metric: Turns gradients into directions.
        cfg: Settings.
        bounded: Keeps displacements (P, S, 3) within bounds.
    """
    found = loss(Parameters(base + state.now))
    squared = (state.now**2).sum(axis=2)
    moving = np.maximum((squared > 0).sum(axis=1), 1)
    total = found.loss + cfg.prior * squared.sum(axis=1) / moving
    gradient = found.by["position"] + 2 * cfg.prior * state.now / moving[:, None, None]
    fine = np.isfinite(total) & np.isfinite(gradient).all(axis=(1, 2))
    better = fine & (total < state.lowest)
    state.losses.append([float(x) for x in np.where(fine, found.loss, np.inf)])
    direction = metric.direction(gradient)
    for p in np.flatnonzero(better):
        state.kept.append(state.now[p].copy())
        state.kept_start.append(int(p))
    first = len(state.losses) == 1
    state.step = np.where(better, state.step * (1.0 if first else cfg.step_increase), state.step * cfg.step_decrease)
    state.lowest = np.where(better, total, state.lowest)
    state.best[better], state.direction[better] = state.now[better], direction[better]
    state.now = bounded(state.best + state.step[:, None, None] * state.direction)
    goes_on = (state.step > cfg.smallest_step) & np.isfinite(state.lowest)
    state.lows.append(float(state.lowest.min()))
    count = cfg.plateau_iterations
    stale = len(state.lows) > count and state.lows[-1] > cfg.plateau_ratio * state.lows[-1 - count]
    state.finished = len(state.losses) >= cfg.iterations or stale or not goes_on.any()


def chosen_iterates(state: Descent, each: int) -> np.ndarray:
    """Return iterates to score again, shape (Q, S, 3): of each start the last that was better and some before it.

    The first of each start is not among them where there are others.
    """
    result = []
    starts = np.array(state.kept_start, dtype=int)
    for p in range(len(state.now)):
        mine = np.flatnonzero(starts == p)
        mine = mine[1:] if len(mine) > 1 and p == 0 else mine
        if len(mine):
            picked = np.unique(np.linspace(0, len(mine) - 1, min(each, len(mine))).round().astype(int))
            result += [state.kept[k] for k in mine[picked]]
    return np.array(result).reshape(-1, *state.now.shape[1:])


def descent_identity(cfg: GradientCfg, seed: int, base: np.ndarray, names: Sequence[str]) -> dict[str, Any]:
    """Return what identifies the descent that a state file belongs to."""
    start = zlib.crc32(np.ascontiguousarray(base).tobytes())
    return {"cfg": asdict(cfg), "seed": seed, "start": start, "segments": list(names)}
