"""The replay of a demonstration as a file: one ``.npz`` of plain arrays with names, readable without this package."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from concent_warp.array_file import write_arrays

if TYPE_CHECKING:
    import mujoco

    from concent_warp.simulate.engine import Rollout


def save_rollout(rollout: Rollout, compiled: mujoco.MjModel, path: Path, variant: int = 0) -> None:
    """Write one variant of a rollout, atomically.

    Arrays: `time` (R,) [s], `qpos` (R, nq), `qvel` (R, nv), `bodies` (B,), `body_position` (R, B, 3) [m],
    `body_quaternion` (R, B, 4), and ``sensor/<name>`` (R, dim) for each sensor; with contacts also ``contact/step``,
    ``contact/geom`` (C, 2) geom names, ``contact/position`` [m], ``contact/normal``, ``contact/distance`` [m] and
    ``contact/force`` [N] on the second geom.
    """
    rollout = rollout.numpy()
    arrays = {
        "time": rollout.time,
        "qpos": rollout.qpos[variant],
        "qvel": rollout.qvel[variant],
        "bodies": np.array(rollout.bodies),
        "body_position": rollout.body_position[variant],
        "body_quaternion": rollout.body_quaternion[variant],
    }
    for i in range(compiled.nsensor):
        start = compiled.sensor_adr[i]
        arrays[f"sensor/{compiled.sensor(i).name}"] = rollout.sensordata[variant][
            :, start : start + compiled.sensor_dim[i]
        ]
    if (log := rollout.contacts) is not None:
        mine = log.variant == variant
        names = np.array([compiled.geom(g).name for g in range(compiled.ngeom)])
        arrays["contact/geom"] = names[log.geom[mine]]
        for name in ("step", "position", "normal", "distance", "force"):
            arrays[f"contact/{name}"] = getattr(log, name)[mine]
    write_arrays(path, arrays, compressed=True)
