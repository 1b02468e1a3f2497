"""Reading of MJCF that may be damaged or hostile: scanned first, tried in another process where it is unusual."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np

from concent_warp.errors import SceneError, printable
from concent_warp.scene.mjcf_scan import scan_file, scan_text
from concent_warp.scene.quiet_mujoco import quiet_mujoco
from concent_warp.scene.trial_compile import try_compile

SHORTEST_STEP, LONGEST_STEP = 1e-6, 1.0
"""Time steps [s] within which a simulation of contacts makes sense: from a hundredth of the finest that are used to the
one in which a falling object passes through 10 m."""
MOST_GRAVITY = 100.0
"""Gravity that no robot meets [m/s^2]: four times Jupiter's, and a tenth of the Earth's in cm/s^2."""
CHECKED_FIELDS = (
    "qpos0", "body_pos", "body_quat", "body_mass", "body_inertia", "geom_pos", "geom_quat", "geom_size",
    "geom_friction", "jnt_pos", "jnt_axis", "jnt_range", "jnt_stiffness", "dof_damping", "dof_armature",
    "dof_frictionloss", "actuator_gainprm", "actuator_biasprm", "actuator_gear", "actuator_ctrlrange", "tendon_range",
)  # fmt: skip
"""Fields of a compiled model in which a NaN would make every result NaN."""
SHOWN_FILES = 3
"""Files outside the folder that a warning names."""


def spec_from_file(path: Path, *, warn_outside: bool = True) -> mujoco.MjSpec:
    """Return the spec of an MJCF file.

    Args:
        path: The file.
        warn_outside: Whether files that it reads from outside its folder are fine, and named in a warning; else they
            are refused.

    Raises:
        SceneError: The file is missing, MuJoCo cannot read it, or it asks for more than `Limits` allow.
    """
    found = scan_file(path)
    if found.outside:
        named = ", ".join(found.outside[:SHOWN_FILES])
        more = f" and {len(found.outside) - SHOWN_FILES} more" if len(found.outside) > SHOWN_FILES else ""
        if not warn_outside:
            raise SceneError(
                "the scene reads files outside its folder", where=path, found=named + more, fix="move them beside it"
            )
        warnings.warn(printable(f"{path}: the scene reads files outside its folder: {named}{more}"), stacklevel=2)
    if found.unusual:
        try_compile(str(path), path=path)
    with readable(path), quiet_mujoco():
        return mujoco.MjSpec.from_file(str(path))


def spec_from_text(text: str, source: str) -> mujoco.MjSpec:
    """Return the spec of an MJCF text.

    Raises:
        SceneError: MuJoCo cannot read it, or it asks for more than `Limits` allow.
    """
    _check_text(text, source)
    with readable(source), quiet_mujoco():
        return mujoco.MjSpec.from_string(text)


def compile_spec(spec: mujoco.MjSpec, source: object) -> mujoco.MjModel:
    """Return the compiled model of a spec.

    Raises:
        SceneError: MuJoCo cannot compile it, or its time step or another number makes no sense.
    """
    with readable(source, "compile"), quiet_mujoco():
        model = spec.compile()
    check_compiled(model, source)
    return model


def check_compiled(model: mujoco.MjModel, source: object) -> None:
    """Check time step, numbers and names of a compiled scene.

    Raises:
        SceneError: The time step is not one of a simulation, a number is NaN, or a name steers a terminal.
    """
    if not SHORTEST_STEP <= model.opt.timestep <= LONGEST_STEP:
        raise SceneError(
            "the time step of the scene makes no sense",
            where=source,
            expected=f"{SHORTEST_STEP:g} to {LONGEST_STEP:g} s",
            found=f"{model.opt.timestep:g}",
            fix='set <option timestep="0.002"/> or the like',
        )
    if not np.isfinite([*model.opt.gravity, *model.opt.wind, model.opt.density, model.opt.viscosity]).all():
        raise SceneError("gravity or the medium of the scene is not finite", where=source, found=model.opt.gravity)
    if (gravity := float(np.linalg.norm(model.opt.gravity))) > MOST_GRAVITY:
        raise SceneError(
            "the gravity of the scene is that of another unit of length",
            where=source,
            expected=f"m/s^2, at most {MOST_GRAVITY:g}",
            found=f"{gravity:g}",
            fix="write the scene, meshes included, in metres, kilograms and seconds",
        )
    for name in CHECKED_FIELDS:
        if np.isnan(getattr(model, name)).any():
            raise SceneError(f"the scene holds NaN in {name}", where=source, expected="numbers")
    try:
        names = bytes(model.names).decode()
    except UnicodeDecodeError as error:
        raise SceneError("a name in the scene is not UTF-8 text", where=source, found=error) from None
    if names.isascii() and names.replace("\0", "").isprintable():
        return
    for name in names.split("\0"):
        if name != printable(name):
            raise SceneError("a name in the scene holds characters that are not printable", where=source, found=name)


@contextmanager
def readable(source: object, what: str = "read") -> Iterator[None]:
    """Turn what MuJoCo says of a scene into `SceneError`."""
    try:
        yield
    except SceneError:
        raise
    except (ValueError, RuntimeError, MemoryError, mujoco.FatalError) as error:
        said = " ".join(str(error).split()) or type(error).__name__
        raise SceneError(f"MuJoCo cannot {what} this MJCF", where=source, found=said) from None


def _remark(text: str) -> None:
    """Make what MuJoCo warns of a warning of Python: MuJoCo itself would write MUJOCO_LOG.TXT to the working folder."""
    with suppress(Exception):  # nothing can be raised through MuJoCo
        warnings.warn(f"MuJoCo: {printable(text.partition(' Time =')[0])}", stacklevel=1)


if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(_remark)


@lru_cache(maxsize=4)
def _check_text(text: str, source: str) -> None:
    """Scan a text, and try it where it is unusual; one that has passed is not looked at again."""
    if scan_text(text, source).unusual:
        try_compile(source, text=text)
