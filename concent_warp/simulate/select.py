"""The choice of an engine by name."""

from __future__ import annotations

import ctypes
import os
from typing import TYPE_CHECKING, Any, Literal, get_args

from concent_warp.errors import EngineError

if TYPE_CHECKING:
    import numpy as np

    from concent_warp.model import Model
    from concent_warp.simulate.engine import Engine

EngineName = Literal["auto", "warp", "mujoco"]
"""``auto`` takes MuJoCo-Warp where a CUDA device is found, else C MuJoCo, the faster one on a CPU."""


def make_engine(name: EngineName, model: Model, *, collidable: np.ndarray | None = None, **options: Any) -> Engine:
    """Return an engine for `model`.

    Args:
        name: Which engine.
        model: What to simulate.
        collidable: Spheres that take part in the physics, shape (S,) bool; None for all.
        options: Further options of `MujocoEngine` or `WarpEngine`.

    Raises:
        EngineError: The name is unknown, or the engine cannot simulate the model.
    """
    if name not in get_args(EngineName):
        raise EngineError("unknown engine", expected=f"one of {list(get_args(EngineName))}", found=repr(name))
    if name == "warp" or (name == "auto" and has_cuda()):
        from concent_warp.simulate.warp_engine import WarpEngine

        return WarpEngine(model, collidable=collidable, **options)
    from concent_warp.simulate.mujoco_engine import MujocoEngine

    return MujocoEngine(model, collidable=collidable, **options)


def has_cuda() -> bool:
    """Return whether Warp finds a CUDA device; without a driver, Warp is not even asked, since it prints a warning."""
    try:
        ctypes.CDLL("nvcuda.dll" if os.name == "nt" else "libcuda.so.1")
    except OSError:
        return False
    import warp

    return warp.is_cuda_available()
