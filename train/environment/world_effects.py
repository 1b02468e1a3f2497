"""Effects of a model in training: each world samples their parameters from the uncertainty of the fit.

A fit gives each parameter a 95 % interval. Worlds sample from the normal distribution with this interval, truncated at
the parameter's bounds, so that the policy is trained for all plausible values and not only for the most likely one.
Parameters that were fitted together have a joint normal distribution (`JointPosterior`): what the data determine only
together, such as a sum of two frictions, varies as little as they say.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.effects.effect import AddedEffect, Effect, Parameter, variant_fields
from concent_warp.train.environment.command_dynamics import CommandDynamics
from concent_warp.train.task.task import Task

if TYPE_CHECKING:
    from concent_warp.effects.force_model import ForceModel

QUANTILE_95 = 1.959964
"""Half width of the 95 % interval of a normal distribution [standard deviations]."""
ForceModels = list[tuple["ForceModel", np.ndarray]]


@dataclass(frozen=True)
class WorldEffects:
    """Effects of a model with their parameters in N worlds."""

    fields: dict[str, np.ndarray]
    """Values of the model fields that differ between worlds, shape (N, ...) each."""
    force_models: ForceModels
    """Force models with their parameters in each world, shape (N, P) each."""
    command_dynamics: tuple[CommandDynamics, ...]
    """Delays and lags of each effect on the commands."""
    values: tuple[np.ndarray, ...]
    """Parameters of each effect, shape (N, P) each."""
    fixed: tuple[str, ...]
    """Names of effects with intervals whose parameters cannot differ between worlds."""


def sample_world_effects(
    task: Task, worlds: int, seed: int, *, sample: bool, variable: Callable[[str], bool] | None = None
) -> WorldEffects:
    """Return the effects of a task's model in N worlds.

    Args:
        task: The task.
        worlds: N.
        seed: Seed.
        sample: Whether parameters are sampled; otherwise all worlds have the model's values.
        variable: Returns whether the simulator can vary a model field between worlds; by default all.
    """
    m, effects = task.compiled, task.model.effects
    bare = task.model.spec(task.collidable).compile() if effects else m
    rng = np.random.default_rng([seed, 3])
    together = _sample_together(bare, effects, worlds, seed) if sample else {}
    values, varied, fixed = [], [], []
    for k, added in enumerate(effects):
        rows = np.tile(added.array, (worlds, 1))
        if sample and _is_uncertain(added):
            if _can_vary(added.effect, added.effect.fields(m), variable):
                parameters = added.effect.parameters(bare)
                rows = together[k] if k in together else _sample_parameters(parameters, added, worlds, rng)
                varied.append(added.effect)
            elif _changes_motion(added.effect):
                fixed.append(added.effect.name)
        values.append(rows)
    if fixed:
        warnings.warn(
            f"the simulator cannot vary {', '.join(fixed)} between worlds: all have the fitted value", stacklevel=2
        )
    force_models = [
        (force_model, v)
        for added, v in zip(effects, values, strict=True)
        if (force_model := added.effect.force_model(m)) is not None
    ]
    dynamics = tuple(
        _command_dynamics(m, a.effect, v) for a, v in zip(effects, values, strict=True) if a.effect.commands
    )
    fields = _written_fields(bare, [added.effect for added in effects], varied, values)
    return WorldEffects(fields, force_models, dynamics, tuple(values), tuple(fixed))


def _command_dynamics(m: mujoco.MjModel, effect: Effect, values: np.ndarray) -> CommandDynamics:
    """Return delays and lags of an effect on the commands with parameters (N, P) in N worlds."""
    found = [effect.delay_and_lag(m, row) for row in values]
    delay, lag = (np.array([late[k] for late in found if late is not None]) for k in range(2))
    return CommandDynamics(delay, (lag,))


def _is_uncertain(added: AddedEffect) -> bool:
    """Return whether any parameter has an interval of positive width."""
    return any(np.isfinite([low, high]).all() and high > low for low, high in added.intervals)


def _changes_motion(effect: Effect) -> bool:
    """Return whether an effect changes the motion, not only sensor readings."""
    force_model, write = type(effect).force_model is not Effect.force_model, type(effect).write is not Effect.write
    return force_model or write or effect.edits or effect.commands


def _can_vary(effect: Effect, fields: tuple[str, ...], variable: Callable[[str], bool] | None) -> bool:
    """Return whether the parameters of an effect can differ between worlds of one compiled model."""
    return _changes_motion(effect) and not effect.edits and all(map(variable or bool, fields))


def _sample_together(
    bare: mujoco.MjModel, effects: tuple[AddedEffect, ...], worlds: int, seed: int
) -> dict[int, np.ndarray]:
    """Return sampled parameters of the effects that have a joint posterior, by their index, shape (worlds, P) each.

    Those of the posterior whose effects the model lacks vary too, and are left out: the others have their marginal
    distribution.
    """
    found: dict[int, np.ndarray] = {}
    known = dict.fromkeys(a.posterior for a in effects if a.posterior is not None)
    for number, posterior in enumerate(known):
        mean, members = np.full(len(posterior.scale), np.nan), []
        for k, added in enumerate(effects):
            if added.posterior != posterior:
                continue
            part = slice(added.first, added.first + len(added.values))
            mean[part] = added.array
            members.append((k, part))
        rows = posterior.sample(mean, worlds, np.random.default_rng([seed, 3, number]))
        for k, part in members:
            bounds = effects[k].effect.parameters(bare)
            found[k] = np.clip(rows[:, part], [p.low for p in bounds], [p.high for p in bounds])
    return found


def _sample_parameters(
    parameters: tuple[Parameter, ...], added: AddedEffect, worlds: int, rng: np.random.Generator
) -> np.ndarray:
    """Return sampled parameters of an effect for N worlds, shape (N, P)."""
    from scipy.stats import truncnorm

    rows = np.tile(added.array, (worlds, 1))
    for k, (parameter, (low, high)) in enumerate(zip(parameters, added.intervals, strict=True)):
        if not (np.isfinite([low, high]).all() and high > low):
            continue
        centre, std = 0.5 * (low + high), 0.5 * (high - low) / QUANTILE_95
        ends = (np.array([parameter.low, parameter.high]) - centre) / std
        rows[:, k] = truncnorm.rvs(*ends, loc=centre, scale=std, size=worlds, random_state=rng)
    return rows


def _written_fields(
    bare: mujoco.MjModel, effects: list[Effect], varied: list[Effect], values: list[np.ndarray]
) -> dict[str, np.ndarray]:
    """Return the values of the model fields that varied effects set, by name, shape (N, ...) each.

    Args:
        bare: Compiled model, prepared for all effects, with none of their fields set.
        effects: All effects, in the order in which they are written.
        varied: Effects whose parameters differ between worlds.
        values: Values of each effect, shape (N, P).
    """
    names = {name for effect in varied for name in effect.fields(bare)}
    if not names:
        return {}
    ends = np.cumsum([0, *(v.shape[1] for v in values)])
    split = [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]
    fields = variant_fields(bare, effects, np.concatenate(values, axis=1), split)
    return {name: np.asarray(fields[name]) for name in sorted(names)}
