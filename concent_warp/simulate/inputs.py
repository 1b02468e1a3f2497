"""Checked inputs of a simulation run, the same for every engine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, get_args

import mujoco
import numpy as np

from concent_warp.errors import EngineError
from concent_warp.simulate.engine import Contacts, Variants

if TYPE_CHECKING:
    from concent_warp.model import Model

SPHERE_FIELDS = ("sphere_position", "sphere_radius", "sphere_friction")

FIXED_PREFIXES = ("mesh_", "bvh_", "oct_", "hfield_", "flex", "key_", "efm0_", "numeric_", "tuple_", "wrap_")
"""Model fields that the compiler builds others from: editing them afterwards leaves those stale."""

FIXED = {
    "geom_pos": "sphere_position for spheres, or move the body with body_pos",
    "geom_quat": "body_quat of the body, or edit the scene",
    "geom_size": "sphere_radius for spheres, or edit the scene",
    "geom_aabb": "sphere_radius for spheres, or edit the scene",
    "geom_rbound": "sphere_radius for spheres, or edit the scene",
    "body_margin": "geom_margin, from which it follows",
    "opt.timestep": "a model with another time step: the variants of a run share their times",
}
"""Model fields that go wrong when edited after compilation, with what to use instead."""


@dataclass(frozen=True)
class SimulationRun:
    """What an engine is asked to simulate, checked and with defaults filled in."""

    variants: Variants
    """Arrays have the right shapes and are finite."""
    ctrl: np.ndarray
    """Commands, shape (n, K, nu), float64; variant i follows row i % n."""
    steps: int
    """K."""
    record: np.ndarray
    """Steps to record, shape (R,), int."""
    bodies: tuple[str, ...]
    """Bodies to record."""
    body_ids: np.ndarray
    """Their ids, shape (B,), int."""
    contacts: Contacts


def compile_model(model: Model, collidable: np.ndarray | None) -> tuple[mujoco.MjModel, np.ndarray]:
    """Compile a model for simulation.

    Args:
        model: The model.
        collidable: Spheres to keep, shape (S,) bool; None keeps all.

    Returns:
        The compiled model and the geom id of each sphere, shape (S,) int, -1 for those left out.
    """
    count = 0 if model.geometry is None else len(model.geometry)
    if collidable is not None and (np.shape(collidable) != (count,) or np.asarray(collidable).dtype != bool):
        raise EngineError(
            "`collidable` must say of each sphere whether it collides",
            expected=f"bool of shape ({count},)",
            found=f"{np.asarray(collidable).dtype} of shape {np.shape(collidable)}",
        )
    try:
        compiled = model.compile(collidable)
    except (ValueError, mujoco.FatalError) as error:
        raise EngineError(
            "MuJoCo cannot compile the model", where=model.scene.source, found=" ".join(str(error).split())
        ) from None
    names = [] if model.geometry is None else model.geometry.names()
    ids = [mujoco.mj_name2id(compiled, mujoco.mjtObj.mjOBJ_GEOM, name) for name in names]
    return compiled, np.array(ids, dtype=int)


def check_run(
    compiled: mujoco.MjModel,
    sphere_count: int,
    variants: Variants,
    ctrl: np.ndarray,
    record: Sequence[int] | np.ndarray | None,
    bodies: Sequence[str] | None,
    contacts: Contacts,
) -> SimulationRun:
    """Check the arguments of `Engine.run` against the compiled model.

    Raises:
        EngineError: A count, shape, name or value is not right; the message says what was expected and found.
    """
    if contacts not in get_args(Contacts):
        raise EngineError("unknown `contacts`", expected=f"one of {list(get_args(Contacts))}", found=repr(contacts))
    _check_variants(compiled, sphere_count, variants)
    values = np.asarray(to_host(ctrl), dtype=float)
    found = values.shape
    values = values[None] if values.ndim == 2 else values
    if values.ndim != 3 or values.shape[2] != compiled.nu or not len(values) or variants.count % len(values):
        raise EngineError(
            "wrong shape of the commands",
            expected=f"(steps, {compiled.nu}), or (n, steps, {compiled.nu}) where n divides {variants.count}",
            found=found,
        )
    if not np.isfinite(values).all():
        raise EngineError("the commands hold values that are not finite", fix="fill or cut the gaps first")
    steps = values.shape[1]
    return SimulationRun(
        variants, values, steps, _check_record(record, steps), *_check_bodies(compiled, bodies), contacts
    )


def _check_variants(compiled: mujoco.MjModel, sphere_count: int, variants: Variants) -> None:
    """Check counts, shapes and values of all that varies."""
    n = variants.count
    if n < 1:
        raise EngineError("there is nothing to simulate", expected="at least one variant", found=n)
    shapes = {
        "sphere_position": (n, sphere_count, 3),
        "sphere_radius": (n, sphere_count),
        "sphere_friction": (n, sphere_count),
        "qpos": (n, compiled.nq),
        "qvel": (n, compiled.nv),
    }
    for name, shape in shapes.items():
        if (value := getattr(variants, name)) is not None:
            _check_array(f"variants.{name}", value, shape)
    if variants.sphere_radius is not None and not bool((variants.sphere_radius > 0).all()):
        raise EngineError("variants.sphere_radius holds radii that are not positive", expected="> 0 m")
    if variants.sphere_friction is not None:
        if not bool((variants.sphere_friction >= 0).all()):
            raise EngineError("variants.sphere_friction holds negative coefficients", expected=">= 0")
        if "geom_friction" in variants.fields:
            raise EngineError(
                "friction is given twice", found="variants.sphere_friction and fields['geom_friction']", fix="give one"
            )
    for force_model, values in variants.force_models or ():
        _check_array(f"parameters of {type(force_model).__name__}", values, (n, *np.shape(values)[1:]))
    for name, value in variants.fields.items():
        _check_array(f"variants.fields[{name!r}]", value, (n, *np.shape(_model_field(compiled, name))))


def _model_field(compiled: mujoco.MjModel, name: str) -> np.ndarray | float:
    """Return the value of a model field that may vary, ``opt.<name>`` for an option.

    Raises:
        EngineError: There is no such field, or it cannot be edited once a model is compiled.
    """
    if name in FIXED:
        raise EngineError(f"{name} cannot vary in a compiled model", fix=f"use {FIXED[name]}")
    if name.startswith(FIXED_PREFIXES):
        raise EngineError(f"{name} cannot vary in a compiled model", fix="edit the scene and run it as another model")
    owner, attribute = (compiled.opt, name[4:]) if name.startswith("opt.") else (compiled, name)
    value = getattr(owner, attribute, None)
    if isinstance(value, float) or (isinstance(value, np.ndarray) and value.dtype.kind == "f"):
        return value
    raise EngineError(
        f"no field {name!r} of real numbers in the compiled model",
        expected="the name of a float field of mujoco.MjModel, or opt.<name>",
    )


def _check_array(name: str, value: Any, shape: tuple[int, ...]) -> None:
    """Check the shape of an array or a tensor, and that all its values are finite."""
    found = tuple(value.shape) if hasattr(value, "shape") else np.shape(value)
    if found != shape:
        raise EngineError(f"wrong shape of {name}", expected=shape, found=found)
    finite = value.isfinite() if hasattr(value, "isfinite") else np.isfinite(np.asarray(value, dtype=float))
    if not bool(finite.all()):
        raise EngineError(f"{name} holds values that are not finite", expected="finite numbers")


def _check_record(record: Sequence[int] | np.ndarray | None, steps: int) -> np.ndarray:
    """Return the steps to record, shape (R,) int; all of 0..steps by default."""
    if record is None:
        return np.arange(steps + 1)
    rows = np.asarray(record)
    if rows.ndim != 1 or (rows.size and rows.dtype.kind not in "iu"):
        raise EngineError("`record` is not a list of steps", expected="integers, shape (R,)", found=rows.dtype)
    rows = rows.astype(int)
    if rows.size and (rows[0] < 0 or rows[-1] > steps or (np.diff(rows) <= 0).any()):
        raise EngineError("`record` is not right", expected=f"increasing steps in 0..{steps}")
    return rows


def _check_bodies(compiled: mujoco.MjModel, bodies: Sequence[str] | None) -> tuple[tuple[str, ...], np.ndarray]:
    """Return names and ids, shape (B,), of the bodies to record; all by default. ``body<id>`` names a nameless one."""
    known = tuple(compiled.body(i).name or f"body{i}" for i in range(compiled.nbody))
    if bodies is None:
        return known, np.arange(compiled.nbody)
    if unknown := [name for name in bodies if name not in known]:
        raise EngineError("bodies to record that the model lacks", expected=f"names among {list(known)}", found=unknown)
    return tuple(bodies), np.array([known.index(name) for name in bodies], dtype=int)


def to_host(value: Any) -> Any:
    """Return a tensor as a NumPy array, anything else as it is."""
    return value.detach().cpu().numpy() if hasattr(value, "detach") else value


def host_variants(variants: Variants) -> Variants:
    """Return the same variants with float64 NumPy arrays."""
    arrays = {
        name: None if (value := getattr(variants, name)) is None else np.asarray(to_host(value), dtype=float)
        for name in (*SPHERE_FIELDS, "qpos", "qvel")
    }
    fields: Mapping[str, np.ndarray] = {k: np.asarray(to_host(v), dtype=float) for k, v in variants.fields.items()}
    force_models = None
    if variants.force_models is not None:
        given = variants.force_models
        force_models = tuple((force_model, np.asarray(to_host(values), dtype=float)) for force_model, values in given)
    return Variants(variants.count, fields=fields, force_models=force_models, **arrays)


def with_force_models(model: Model, compiled: mujoco.MjModel, variants: Variants) -> Variants:
    """Return the variants, with the force models of the model's effects if they name none themselves."""
    if variants.force_models is not None:
        return variants
    force_models = []
    for added in model.effects:
        if (force_model := added.effect.force_model(compiled)) is not None:
            force_models.append((force_model, np.tile(added.array, (variants.count, 1))))
    return replace(variants, force_models=tuple(force_models))
