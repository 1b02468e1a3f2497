"""Effects of a model in training: each world has parameters of its own, drawn from what the fit left open.

A fit gives each parameter a 95 % interval. The worlds draw from the normal distribution that has it, cut at the
parameter's bounds, so that the policy meets what the effect may be and not only its most likely value.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.effects.effect import AddedEffect, Effect, Parameter, written
from concent_warp.train.environment.command_dynamics import CommandDynamics
from concent_warp.train.task.task import Task

if TYPE_CHECKING:
    from concent_warp.effects.force_model import ForceModel

QUANTILE = 1.959964
"""Half width of the 95 % interval of a normal distribution in standard deviations."""
Laws = list[tuple["ForceModel", np.ndarray]]


@dataclass(frozen=True)
class WorldEffects:
    """What effects are in each of N worlds."""

    fields: dict[str, np.ndarray]
    """Values of the model fields that differ between worlds, shape (N, ...) each."""
    laws: Laws
    """Force laws with their parameters in each world, shape (N, P) each."""
    late: tuple[CommandDynamics, ...]
    """Delays and lags of the commands, of each effect on them."""
    values: tuple[np.ndarray, ...]
    """Parameters of each effect, shape (N, P) each."""
    kept: tuple[str, ...]
    """Names of effects that have intervals and cannot be varied."""


def sample_world_effects(
    task: Task, worlds: int, seed: int, *, draw: bool, variable: Callable[[str], bool] | None = None
) -> WorldEffects:
    """Return the effects of a task's model in N worlds.

    Args:
        task: The task.
        worlds: N.
        seed: Seed of what is drawn.
        draw: Whether parameters are drawn, or as they are in the model everywhere.
        variable: Whether the simulator can vary a model field between worlds; by default it can vary all.
    """
    m, effects = task.compiled, task.model.effects
    bare = task.model.spec(task.collidable).compile() if effects else m
    rng = np.random.default_rng([seed, 3])
    values, varied, kept = [], [], []
    for added in effects:
        rows = np.tile(added.array, (worlds, 1))
        if draw and _any_open(added):
            if _can_vary(added.effect, added.effect.fields(m), variable):
                parameters = added.effect.parameters(bare)
                rows = _drawn(parameters, added, worlds, rng)
                varied.append(added.effect)
            elif _acts(added.effect):
                kept.append(added.effect.name)
        values.append(rows)
    if kept:
        warnings.warn(
            f"the simulator cannot vary {', '.join(kept)} between worlds: all have the fitted value", stacklevel=2
        )
    laws = [(law, v) for added, v in zip(effects, values, strict=True) if (law := added.effect.law(m)) is not None]
    late = tuple(_following(m, a.effect, v) for a, v in zip(effects, values, strict=True) if a.effect.commands)
    fields = _written_fields(bare, [added.effect for added in effects], varied, values)
    return WorldEffects(fields, laws, late, tuple(values), tuple(kept))


def _following(m: mujoco.MjModel, effect: Effect, values: np.ndarray) -> CommandDynamics:
    """Return how commands are followed under an effect on them; its parameters in the worlds are of shape (N, P)."""
    found = [effect.late(m, row) for row in values]
    delay, lag = (np.array([late[k] for late in found if late is not None]) for k in range(2))
    return CommandDynamics(delay, (lag,))


def _any_open(added: AddedEffect) -> bool:
    """Return whether an interval leaves anything open."""
    return any(np.isfinite([low, high]).all() and high > low for low, high in added.intervals)


def _acts(effect: Effect) -> bool:
    """Return whether an effect changes the motion, and not only what instruments read."""
    law, write = type(effect).law is not Effect.law, type(effect).write is not Effect.write
    return law or write or effect.edits or effect.commands


def _can_vary(effect: Effect, fields: tuple[str, ...], variable: Callable[[str], bool] | None) -> bool:
    """Return whether the parameters of an effect can differ between worlds that share what is compiled."""
    return _acts(effect) and not effect.edits and all(map(variable or bool, fields))


def _drawn(parameters: tuple[Parameter, ...], added: AddedEffect, worlds: int, rng: np.random.Generator) -> np.ndarray:
    """Return parameters of an effect for N worlds, shape (N, P)."""
    from scipy.stats import truncnorm

    rows = np.tile(added.array, (worlds, 1))
    for k, (parameter, (low, high)) in enumerate(zip(parameters, added.intervals, strict=True)):
        if not (np.isfinite([low, high]).all() and high > low):
            continue
        centre, std = 0.5 * (low + high), 0.5 * (high - low) / QUANTILE
        ends = (np.array([parameter.low, parameter.high]) - centre) / std
        rows[:, k] = truncnorm.rvs(*ends, loc=centre, scale=std, size=worlds, random_state=rng)
    return rows


def _written_fields(
    bare: mujoco.MjModel, effects: list[Effect], varied: list[Effect], values: list[np.ndarray]
) -> dict[str, np.ndarray]:
    """Return the model fields that varied effects set, shape (N, ...) each.

    Args:
        bare: The model, prepared for all effects, before any has set its fields.
        effects: All effects; they are written in this order.
        varied: Those whose values differ between worlds.
        values: Values of each effect, shape (N, P).
    """
    names = {name for effect in varied for name in effect.fields(bare)}
    if not names:
        return {}
    ends = np.cumsum([0, *(v.shape[1] for v in values)])
    split = [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]
    fields = written(bare, effects, np.concatenate(values, axis=1), split)
    return {name: np.asarray(fields[name]) for name in sorted(names)}
