"""Cases of a machine from a table of causes: what is different in the true machine, and which answers are right."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar
from zlib import crc32

import numpy as np

from benchmarks.foreign.log import Case, Kind, Log, Recorded

Truth = TypeVar("Truth")
Rng = np.random.Generator

LEAST, MOST = 0.003, 0.02
"""Bounds of the share by which a true value differs from the nominal one, also where nothing is hidden."""


@dataclass(frozen=True)
class Cause:
    """What is hidden in a log."""

    name: str
    kind: Kind
    accepted: tuple[tuple[str, ...], ...] = ()
    factors: Mapping[str, float] = field(default_factory=dict)
    """Factors on true values, by name."""
    values: Mapping[str, Any] = field(default_factory=dict)
    """True values that replace the nominal ones, by name."""
    noise_stated: bool = False


def changed(machine: Truth, values: Mapping[str, Any]) -> Truth:
    """Return a machine, a dataclass or a named tuple, with some values replaced."""
    if isinstance(machine, tuple):
        return machine._replace(**values)  # type: ignore[attr-defined]
    return replace(machine, **values)  # type: ignore[type-var]


def varied(rng: Rng, nominal: Truth, names: Sequence[str]) -> Truth:
    """Return a machine of which each of these values is off by its own share."""
    shares = {name: rng.choice([-1, 1]) * rng.uniform(LEAST, MOST) for name in names}
    return changed(nominal, {name: getattr(nominal, name) * (1 + share) for name, share in shares.items()})


def true_machine(machine: str, cause: Cause, nominal: Truth, names: Sequence[str]) -> tuple[Truth, Rng]:
    """Return the machine of a log with its cause, and the source of noise that goes on from there."""
    rng = np.random.default_rng(crc32(f"{machine}-{cause.name}".encode()))
    truth = varied(rng, nominal, names)
    hidden: dict[str, Any] = {name: getattr(truth, name) * factor for name, factor in cause.factors.items()}
    return changed(truth, hidden | dict(cause.values)), rng


def cases(
    machine: str,
    model: str,
    nominal: Truth,
    names: Sequence[str],
    causes: Sequence[Cause],
    record: Callable[[Truth, Rng], tuple[Sequence[Recorded], Mapping[str, float]]],
) -> tuple[Case, ...]:
    """Return the cases of a machine.

    Args:
        machine: Name of the machine.
        model: The model of the laboratory, as MJCF.
        nominal: Dataclass or named tuple of the values that the model has.
        names: Fields of it whose true values differ from the nominal ones.
        causes: What is hidden, one by one.
        record: Returns what is recorded of a true machine, and the noise of each sensor.
    """

    def make(cause: Cause) -> Log:
        truth, rng = true_machine(machine, cause, nominal, names)
        motions, noise = record(truth, rng)
        return Log(model, motions, noise if cause.noise_stated else {})

    return tuple(Case(machine, c.name, c.kind, c.accepted, partial(make, c)) for c in causes)
