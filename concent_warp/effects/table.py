"""Effects in a model file: a table each with name, target, values and intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from concent_warp.documents import is_number
from concent_warp.effects.effect import AddedEffect, Effect, with_unit
from concent_warp.effects.posterior import JointPosterior
from concent_warp.effects.registry import effect_class
from concent_warp.errors import ModelError


def checked_values(
    effect: Effect, m: mujoco.MjModel, values: Mapping[str, float] | Sequence[float] | None
) -> tuple[float, ...]:
    """Return the values of an effect's parameters in their order.

    Args:
        effect: The effect.
        m: The model without it, which its null values are taken from.
        values: By name or in their order; None or a name that is missing gives the null value.

    Raises:
        ModelError: A name is unknown, a number is missing, or a value is out of bounds.
    """
    parameters = effect.parameters(m)
    known = [p.name for p in parameters]
    if values is None:
        values = {}
    if isinstance(values, Mapping):
        if unknown := sorted(set(values) - set(known)):
            raise ModelError(f"{effect.name} has no such parameter", expected=f"some of {known}", found=unknown)
        values = [values.get(p.name, p.null) for p in parameters]
    if len(values) != len(parameters):
        raise ModelError(f"wrong number of values for {effect.name}", expected=f"{known}", found=len(values))
    for parameter, value in zip(parameters, values, strict=True):
        if not (parameter.low <= value <= parameter.high or value == parameter.null):
            raise ModelError(
                f"{effect.name}: {parameter.name} is out of bounds",
                expected=with_unit(f"{parameter.low:g} to {parameter.high:g}", parameter.unit),
                found=value,
            )
    return tuple(float(value) for value in values)


def effects_table(effects: Sequence[AddedEffect]) -> list[dict[str, Any]]:
    """Return effects as the tables of a model file."""
    rows = []
    for added in effects:
        row: dict[str, Any] = {"name": added.effect.name, "target": list(added.effect.target)}
        row["values"] = list(added.values)
        if added.intervals:
            row["intervals"] = [list(pair) for pair in added.intervals]
        rows.append(row)
    return rows


def read_effects(rows: Any, path: Path) -> list[AddedEffect]:
    """Read the ``[[effect]]`` tables of a model file, strictly; values are checked against the model elsewhere.

    Raises:
        ModelError: An entry is missing, unknown or of another type.
    """
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ModelError("effects are not tables", where=path, expected="[[effect]] tables")
    found = []
    for i, row in enumerate(rows):
        where = f"{path}: effect {i}"
        if unknown := sorted(set(row) - {"name", "target", "values", "intervals"}):
            raise ModelError("unknown entries", where=where, expected="name, target, values, intervals", found=unknown)
        name, target, values = row.get("name"), row.get("target", []), row.get("values", [])
        if not isinstance(name, str):
            raise ModelError("the effect has no name", where=where, expected='name = "..."', found=name)
        if not isinstance(target, list) or not all(isinstance(t, str) for t in target):
            raise ModelError("target is not right", where=where, expected="a list of names", found=target)
        intervals = row.get("intervals", [])
        if (
            not _numbers(values)
            or not isinstance(intervals, list)
            or not all(_numbers(p) and len(p) == 2 for p in intervals)
        ):
            raise ModelError("values and intervals are not right", where=where, expected="lists of numbers")
        if wrong := next((pair for pair in intervals if pair[0] > pair[1]), None):
            raise ModelError("an interval is reversed", where=where, expected="its lower end first", found=wrong)
        pairs = tuple((float(low), float(high)) for low, high in intervals)
        found.append(AddedEffect(effect_class(name)(*target), tuple(float(v) for v in values), pairs))
    return found


def posteriors_table(effects: Sequence[AddedEffect]) -> list[dict[str, Any]]:
    """Return the joint posteriors of effects as the tables of a model file, each of the effects that are left of it."""
    rows = []
    for posterior in dict.fromkeys(a.posterior for a in effects if a.posterior is not None):
        members = [k for k, a in enumerate(effects) if a.posterior is posterior or a.posterior == posterior]
        kept = [effects[k].first + i for k in members for i in range(len(effects[k].values))]
        row: dict[str, Any] = {"effects": members}
        for name in ("scale", "low", "high"):
            row[name] = [getattr(posterior, name)[i] for i in kept]
        row["covariance"] = [[posterior.covariance[i][j] for j in kept] for i in kept]
        rows.append(row)
    return rows


def with_posteriors(effects: Sequence[AddedEffect], rows: Any, path: Path) -> list[AddedEffect]:
    """Return effects with the ``[[posterior]]`` tables of a model file, read strictly.

    Raises:
        ModelError: An entry is missing, unknown, of another type or size, or a covariance is none.
    """
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ModelError("posteriors are not tables", where=path, expected="[[posterior]] tables")
    found = list(effects)
    for i, row in enumerate(rows):
        where = f"{path}: posterior {i}"
        if set(row) != set(POSTERIOR_ENTRIES):
            expected = ", ".join(POSTERIOR_ENTRIES)
            raise ModelError("entries are missing or unknown", where=where, expected=expected, found=sorted(row))
        members = row["effects"]
        if not (
            isinstance(members, list)
            and all(type(k) is int and 0 <= k < len(found) for k in members)
            and len(set(members)) == len(members)
        ):
            raise ModelError(
                "effects are not right",
                where=where,
                expected=f"different numbers of 0 to {len(found) - 1}",
                found=members,
            )
        size, matrix = sum(len(found[k].values) for k in members), row["covariance"]
        vectors = [row[name] for name in ("scale", "low", "high")]
        if (
            not all(_numbers(v) and len(v) == size for v in vectors)
            or not isinstance(matrix, list)
            or len(matrix) != size
            or not all(_numbers(v) and len(v) == size for v in matrix)
        ):
            raise ModelError("numbers are missing", where=where, expected=f"{size} for each entry, a row each")
        covariance, scale = np.array(matrix, dtype=float).reshape(size, size), np.array(vectors[0])
        largest = float(np.abs(covariance).max(initial=0.0))
        if (
            not (np.isfinite(covariance).all() and np.isfinite(scale).all() and (scale > 0).all())
            or np.abs(covariance - covariance.T).max(initial=0.0) > 1e-9 * largest
            or np.linalg.eigvalsh(covariance).min(initial=0.0) < -1e-9 * largest
        ):
            raise ModelError("covariance or scale is none", where=where, expected="symmetric, not negative, finite")
        scales, low, high = (tuple(float(v) for v in values) for values in vectors)
        rows_of = tuple(tuple(float(v) for v in values) for values in matrix)
        posterior, first = JointPosterior(scales, rows_of, low, high), 0
        for k in members:
            found[k] = replace(found[k], posterior=posterior, first=first)
            first += len(found[k].values)
    return found


POSTERIOR_ENTRIES = ("effects", "scale", "low", "high", "covariance")
"""Entries of a ``[[posterior]]`` table."""


def _numbers(values: Any) -> bool:
    """Return whether something is a list of numbers, none of them NaN."""
    return isinstance(values, list) and all(is_number(v) or v in (np.inf, -np.inf) for v in values)
