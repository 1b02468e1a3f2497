"""Tosses of a cube on a board, as ContactNets publishes them (Pfrommer, Halm, Posa, CoRL 2020).

Each ``<number>.pt`` is one toss: a PyTorch tensor (T, 13) of quaternion wxyz, position [m], angular velocity [rad/s,
body frame] and velocity [m/s, world frame] of the cube. The velocities there are backward differences of the poses:
row k is the mean over the interval that ends at row k. So velocities are given the time half a step before their row,
the first row has none, and the velocity at time 0 is the mean of the first two.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.limits import limits
from concent_warp.recording.naming import PREFIX, by_number
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.recording.validation.validate import validate

if TYPE_CHECKING:
    import torch

PERIOD = 0.0068
"""Time between rows [s], as in the code published with the data."""
EDGE = 0.1048
"""Edge of the cube [m]."""
MASS = 0.37
"""Mass of the cube [kg]."""
INERTIA = 0.00081
"""Moment of inertia of the cube about each axis [kg m^2]."""
FRICTION = 0.15
"""Published friction coefficient between cube and board [-]."""
COLUMNS = 13


def read_contactnets(
    path: Path, limit: int | None = None, *, period: float = PERIOD, board_height: float = 0.0
) -> Recording:
    """Read and validate one toss, or all tosses of a folder in the order of their numbers.

    Args:
        path: A ``.pt`` file or a folder of them.
        limit: How many tosses to read at most; None reads all.
        period: Time between rows [s].
        board_height: Height of the board's surface [m] in the frame of the measured positions.

    Returns:
        One demonstration per toss, named ``demo_<number>``, in the scene of `_toss_scene`.

    Raises:
        RecordingError: A file is missing, is no plain tensor (a pickle is refused, never run) or has another shape.
    """
    path = Path(path)
    if not (math.isfinite(period) and period > 0):
        raise RecordingError("the period between rows is not a time", where=path, expected="> 0 s", found=period)
    if limit is not None and limit < 1:
        raise RecordingError("the limit leaves no toss", where=path, expected="at least 1", found=limit)
    if not path.exists():
        raise RecordingError("no such toss or folder of tosses", where=path, fix="check the path")
    paths = sorted(path.glob("*.pt"), key=lambda p: by_number(p.stem))[:limit] if path.is_dir() else [path]
    if not 0 < len(paths) <= limits().demonstrations:
        raise RecordingError("no tosses in the folder", where=path, expected=".pt files", found=len(paths))
    tosses = tuple(_toss(_read_rows(p), f"{PREFIX}{p.stem}", period) for p in paths)
    recording = Recording(_toss_scene(board_height), tosses, str(path))
    validate(recording)
    return recording


def _toss_scene(board_height: float = 0.0) -> str:
    """Return the MJCF of a free cube above a board at `board_height` [m]; the gyro reads in the body frame."""
    half = EDGE / 2
    return f"""
<mujoco model="cube toss">
  <option timestep="0.001"/>
  <custom><text name="concent_objects" data="cube"/></custom>
  <worldbody>
    <light pos="0 0 2"/>
    <geom name="board" type="plane" size="1 1 0.1" pos="0 0 {board_height!r}" friction="{FRICTION} 0.005 0.0001"
          rgba="0.8 0.8 0.8 1"/>
    <body name="cube" pos="0 0 {board_height + half!r}">
      <freejoint name="cube"/>
      <inertial pos="0 0 0" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
      <geom name="cube" type="box" size="{half!r} {half!r} {half!r}" friction="{FRICTION} 0.005 0.0001"
            rgba="0.9 0.5 0.2 1"/>
      <site name="cube"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="cube_position" objtype="xbody" objname="cube"/>
    <framequat name="cube_orientation" objtype="xbody" objname="cube"/>
    <framelinvel name="cube_velocity" objtype="xbody" objname="cube"/>
    <gyro name="cube_angular_velocity" site="cube"/>
  </sensor>
</mujoco>
"""


def _toss(rows: np.ndarray, name: str, period: float) -> Demonstration:
    """Return one toss, shape (T, 13), as a demonstration."""
    quaternion, position, angular, linear = np.split(rows, [4, 7, 10], axis=1)
    time = period * np.arange(len(rows))
    between = time[1:] - period / 2
    return Demonstration(
        name=name,
        task="toss",
        qpos=np.concatenate([position[0], quaternion[0]]),
        qvel=np.concatenate([linear[:2].mean(axis=0), angular[:2].mean(axis=0)]),
        measured={
            "cube_position": Channel(time, position),
            "cube_orientation": Channel(time, quaternion),
            "cube_velocity": Channel(between, linear[1:]),
            "cube_angular_velocity": Channel(between, angular[1:]),
        },
    )


def _read_rows(path: Path) -> np.ndarray:
    """Return the tensor of one toss, shape (T, 13)."""
    if not path.is_file():
        raise RecordingError("no such toss", where=path, expected="a .pt file", fix="check the path")
    if not 0 < path.stat().st_size <= limits().file_bytes:
        raise RecordingError(
            "not a toss", where=path, expected=f"1 to {limits().file_bytes} bytes", found=path.stat().st_size
        )
    tensor = _load_tensor(path)
    import torch

    if not isinstance(tensor, torch.Tensor):
        raise RecordingError("not a toss", where=path, expected="one tensor", found=type(tensor).__name__)
    shape = tuple(tensor.shape)
    plain = tensor.layout == torch.strided and tensor.device.type == "cpu" and tensor.is_floating_point()
    if not plain or len(shape) != 2 or shape[1] != COLUMNS or not 2 <= shape[0] <= limits().samples:
        raise RecordingError(
            "wrong shape of a toss", where=path, expected=f"(T, {COLUMNS}) floats", found=f"{shape} {tensor.dtype}"
        )
    return tensor.detach().double().numpy()


def _load_tensor(path: Path) -> torch.Tensor:
    """Load what a ``.pt`` file holds, as data: a pickle that names code is refused."""
    import pickle
    import warnings

    import torch

    try:
        with warnings.catch_warnings(action="ignore"):
            return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError:
        raise RecordingError(
            "the file is not a plain tensor and is not run",
            where=path,
            expected="a tensor written by torch.save",
            found="a pickle that names code, or a damaged file",
            fix="save the tensor alone",
        ) from None
    except Exception as error:  # torch reports damage as RuntimeError, EOFError, KeyError, AttributeError and more
        found = " ".join(str(error).split())[:200] or type(error).__name__
        raise RecordingError("not a tensor written by torch.save", where=path, found=found) from error
