"""Bounds of the settings of a training."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

from concent_warp.checks import check_seed
from concent_warp.errors import TrainError

COUNTS = (
    "checkpoint", "environment.worlds", "environment.decimation", "environment.stride", "environment.nconmax",
    "environment.njmax", "environment.solver_iterations", "environment.ls_iterations", "environment.observation.slots",
    "environment.virtual.candidates", "environment.virtual.threads",
    "environment.reset.states", "environment.reset.passes", "environment.reset.posture_solver.iterations",
    "environment.reset.newton_solver.iterations", "environment.reset.newton_solver.seeds", "environment.chain.hold",
    "ppo.iterations", "ppo.steps", "ppo.epochs", "ppo.batches", "ppo.hidden",
)  # fmt: skip
"""Settings of at least 1."""
POSITIVE = (
    "environment.episode", "environment.success", "environment.dropped", "environment.lost", "environment.max_position",
    "environment.max_velocity", "environment.buffer_factor", "environment.action.turn", "environment.action.slide",
    "environment.action.gripper", "environment.action.turn_lead", "environment.action.slide_lead",
    "environment.chain.tolerance", "ppo.learning_rate", "ppo.std", "ppo.max_mean", "ppo.max_observation", "ppo.clip",
    "ppo.divergence", "ppo.gradient",
)  # fmt: skip
"""Settings above 0."""
SHARES = (
    "target", "environment.randomisation.perturbation_share", "environment.reset.demonstrated",
    "environment.reset.free", "ppo.discount", "ppo.lam",
)  # fmt: skip
"""Settings from 0 to 1."""
SIGNED = ("seed", "environment.reward.engineered.hole", "environment.reward.engineered.seat")
"""Settings that may be negative; all others may not."""
INTERVALS = ("friction", "grip", "stiffness", "damping", "mass", "joint_friction", "delay", "lag")
"""Settings of the randomisation that are a smallest and a largest value."""
FACTORS = ("friction", "grip", "stiffness", "damping", "mass")
"""Those that are factors, above 0."""


def check_cfg(cfg: Any) -> None:
    """Check the settings of a training, a `TrainCfg`.

    Raises:
        TrainError: A setting is out of bounds.
    """
    check_seed(cfg.seed, TrainError)
    for name, value in _numbers(cfg):
        expected = _expected(name, value)
        if expected is not None:
            raise TrainError(f"{name.split('.')[-1]} is out of bounds", expected=expected, found=value)
    e, p = cfg.environment, cfg.ppo
    for name in INTERVALS:
        low, high = getattr(e.randomisation, name)
        if low > high or (name in FACTORS and low <= 0):
            expected = "a smallest and a largest value" + ", above 0" * (name in FACTORS)
            raise TrainError(f"{name} is out of bounds", expected=expected, found=(low, high))
    if not p.hidden:
        raise TrainError("hidden is empty", expected="at least one layer")
    if e.decimation % e.stride:
        raise TrainError(
            "an action is not a whole number of simulation steps",
            expected=f"a divisor of the decimation, {e.decimation}",
            found=f"stride {e.stride}",
        )
    if e.worlds * p.steps < p.batches:
        raise TrainError(
            "an iteration has fewer environment steps than mini-batches",
            expected=f"at least {p.batches}",
            found=e.worlds * p.steps,
        )


def _expected(name: str, value: float) -> str | None:
    """Return what is expected of a setting if a value is not, None if it is."""
    if not math.isfinite(value):
        return "a finite number"
    if name in COUNTS:
        return None if value >= 1 else "at least 1"
    if name in POSITIVE:
        return None if value > 0 else "above 0"
    if name in SHARES:
        return None if 0 <= value <= 1 else "0 to 1"
    return None if value >= 0 or name in SIGNED else "at least 0"


def _numbers(value: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """Yield the numbers of a tree of settings by their dotted names, each item of a list by the name of the list."""
    if is_dataclass(value):
        for field in fields(value):
            yield from _numbers(getattr(value, field.name), f"{name}.{field.name}".lstrip("."))
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _numbers(item, name)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield name, value
