"""Bodies that cannot move in the scene, of which readings say that they moved: a forgotten joint, or a mocap body."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.errors import printable
from concent_warp.recording.recording import Recording
from concent_warp.scene.scene import Scene
from concent_warp.scene.sensor_frame import sensor_frame


@dataclass(frozen=True)
class StillBodyCfg:
    """What tells a motion from noise and drift of a tracker."""

    min_distance: float = 0.01
    """Least distance between positions that were read [m]."""
    min_ratio: float = 10.0
    """Least standard deviation of a coordinate over that of its noise, from differences between samples [-]."""


def warn_of_still_bodies(recording: Recording, cfg: StillBodyCfg | None = None) -> None:
    """Warn of positions that moved although nothing in the scene moves what they are of: no model follows them.

    Args:
        recording: The recording, valid.
        cfg: Thresholds.
    """
    cfg, m = cfg or StillBodyCfg(), Scene(recording.scene, recording.source).model
    found: dict[str, tuple[str, str]] = {}
    for d in recording.demonstrations:
        for name, channel in d.measured.items():
            row = m.sensor(name).id
            frame = sensor_frame(m, row) if m.sensor_type[row] == mujoco.mjtSensor.mjSENS_FRAMEPOS else None
            if frame is None or _has_joint(m, frame.body) or not _moves(channel.value, cfg):
                continue
            mocap = m.body_mocapid[m.body_rootid[frame.body]] >= 0
            body = m.body(frame.body).name or f"body{frame.body}"
            still = (f"{body}, a mocap body,", "simulations leave it where the scene has it")
            found[name] = still if mocap else (body, "it has no joint")
    for name, (body, why) in found.items():
        warnings.warn(
            printable(
                f"{recording.source}: measured/{name} moves, but {body} cannot: {why}; give it the joints by which it"
                " moves, with actuators where it is driven, or leave the channel out"
            ),
            stacklevel=2,
        )


def _has_joint(m: mujoco.MjModel, body: int) -> bool:
    """Return whether a joint moves a body, its own or one of those that carry it."""
    while body and not m.body_jntnum[body]:
        body = int(m.body_parentid[body])
    return body > 0


def _moves(value: np.ndarray, cfg: StillBodyCfg) -> bool:
    """Return whether positions (T, 3), NaN where missing, move."""
    known = value[np.isfinite(value).all(axis=1)]
    if len(known) < 3 or np.ptp(known, axis=0).max() < cfg.min_distance:
        return False
    noise = np.diff(known, axis=0).std(axis=0) / np.sqrt(2)
    return bool((known.std(axis=0) > cfg.min_ratio * noise).any())
