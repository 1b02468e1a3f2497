"""Free falls: motion that shows that positions are in metres, however far away they are."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from concent_warp.recording.recording import Demonstration
from concent_warp.recording.validation.cfg import FallCfg, UnitCheckCfg
from concent_warp.recording.validation.magnitudes import POSITION_SENSORS, max_distance


def units_of_falls(demonstration: Demonstration, model: mujoco.MjModel, cfg: UnitCheckCfg) -> UnitCheckCfg:
    """Return the thresholds for a demonstration: as far as something falls freely in it, positions may be.

    In millimetres, the acceleration of a free fall would be 9810 m/s^2.

    Args:
        demonstration: With channels that need not be valid yet.
        model: The compiled scene, for its gravity.
        cfg: The thresholds without a fall.
    """
    far = max_distance(model, cfg)
    tracks: list[tuple[np.ndarray, np.ndarray]] = []
    for name, channel in demonstration.measured.items():
        row = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, name)
        if row >= 0 and model.sensor_type[row] in POSITION_SENSORS and model.sensor_refid[row] < 0:
            tracks.append((np.asarray(channel.time), np.asarray(channel.value)))
    for track in demonstration.points.values():
        value, seen = np.asarray(track.value), np.asarray(track.visible)
        if value.ndim == 3 and value.dtype.kind == "f" and seen.shape == value.shape[:2] and seen.dtype == bool:
            point = int(seen.sum(axis=0).argmax()) if seen.size else -1
            if point >= 0:
                tracks.append((np.asarray(track.time), np.where(seen[:, point, None], value[:, point], np.nan)))
    gravity = np.array(model.opt.gravity)
    reached = max((_fallen_distance(*track, gravity, far, cfg.fall) for track in tracks), default=0.0)
    return replace(cfg, max_distance=reached) if reached > far else cfg


def _fallen_distance(time: np.ndarray, value: np.ndarray, gravity: np.ndarray, far: float, cfg: FallCfg) -> float:
    """Return how far from the origin positions may be [m] where these fall freely for a while; 0 where they do not.

    Args:
        time: [s], shape (T,).
        value: Positions [m], shape (T, 3), NaN where missing.
        gravity: [m/s^2], shape (3,).
        far: Distance that is allowed anyway [m].
        cfg: Settings.
    """
    if time.ndim != 1 or value.shape != (len(time), 3) or time.dtype.kind not in "fiu" or value.dtype.kind != "f":
        return 0.0
    known = np.asarray(np.isfinite(value).any(axis=0))
    kept = np.asarray(np.isfinite(value[:, known]).all(axis=1)) & np.isfinite(time)
    time, place = time[kept].astype(float), value[kept][:, known]
    size = float(np.linalg.norm(gravity))
    if len(time) < cfg.min_samples or not np.linalg.norm(gravity[known]) > 0.5 * size:
        return 0.0
    length, period = np.linalg.norm(place, axis=1), float(np.median(np.diff(time)))
    if length.max() <= far or not period > 0:
        return 0.0
    piece = np.floor((time - time[0]) / max(cfg.span, (cfg.min_samples + 1) * period))
    falling = 0
    for rows in np.split(np.arange(len(time)), np.flatnonzero(np.diff(piece)) + 1):
        if len(rows) >= cfg.min_samples:
            since = time[rows] - time[rows].mean()
            acceleration = 2 * np.polynomial.polynomial.polyfit(since, place[rows], 2)[2]
            if np.linalg.norm(acceleration - gravity[known]) < cfg.max_error * size:
                falling += len(rows)
    return cfg.margin * float(length.max()) if falling >= cfg.min_share * len(time) else 0.0
