"""Length of the windows over which gradients are useful, estimated from the observed motion of the objects.

Gradients grow with the number of impacts that they pass through. An object that is pushed or settles keeps its tilt:
gradients serve for seconds. One that tumbles changes it, and each corner that hits the ground multiplies them: there
the recording is cut into short windows, each from its measured state, or where that was not measured, cut short.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.checks import Count, PositiveDuration
from concent_warp.errors import RecordingError
from concent_warp.estimation.object_tracks import BodyTarget, Segment, observed_poses
from concent_warp.estimation.windows import cut_windows
from concent_warp.model import Model
from concent_warp.recording.recording import Demonstration


@dataclass(frozen=True)
class HorizonCfg:
    """Lengths of the windows over which gradients are computed.

    "Empirical" values were set on recordings of pushed, settling and tumbling cubes.
    """

    tumbling_tilt: float = 0.35
    """Change of an object's tilt above which it counts as tumbling [rad]: 20 degrees."""
    tumbling_window: PositiveDuration = 0.25
    """Length of a window of a demonstration in which an object tumbles [s]. Empirical: a few impacts."""
    calm_window: PositiveDuration = 3.0
    """Longest window of a demonstration in which none does [s]. Empirical."""
    max_windows: Count = 24
    """Most windows [-]; more are thinned out evenly."""


def gradient_segments(
    model: Model,
    segments: Sequence[Segment],
    demonstrations: Sequence[Demonstration],
    cfg: HorizonCfg,
    *,
    held_out: float = 0.0,
    block: float = 0.2,
) -> list[Segment]:
    """Return the stretches for gradients, without the frames that a fit holds out.

    Args:
        model: Model with contact geometry.
        segments: Segments that the fit simulates; held-out ones are left out.
        demonstrations: Where they come from, one for each; empty where they are windows already.
        cfg: Settings.
        held_out: Share of the frames that are held out, in blocks.
        block: Length of these blocks [s].
    """
    result = []
    for i, segment in enumerate(segments):
        if segment.held_out:
            continue
        used = segment
        if segment.held_out is None:
            used = replace(segment, targets=tuple(_without(t, t.held_out(held_out, block)) for t in segment.targets))
        limit = cfg.tumbling_window if max(map(_tilt, segment.targets)) > cfg.tumbling_tilt else cfg.calm_window
        if len(segment.ctrl) * model.scene.model.opt.timestep <= 1.2 * limit:
            result.append(used)
            continue
        found = _windows_of(model, demonstrations[i], limit, used) if demonstrations else []
        result += found or [shortened(model.scene.model, used, limit)]
    if len(result) > cfg.max_windows:
        result = [result[k] for k in np.linspace(0, len(result) - 1, cfg.max_windows).round().astype(int)]
    return result


def _without(target: BodyTarget, frames: np.ndarray) -> BodyTarget:
    """Return a target in which nothing was seen in some frames, shape (T,) bool."""
    return replace(target, points=np.where(frames[:, None, None], np.nan, target.points))


def _tilt(target: BodyTarget) -> float:
    """Return the largest change of the angle between a body and the vertical, as observed [rad]."""
    frames = np.flatnonzero(np.isfinite(target.points).all(axis=2).sum(axis=1) >= 3)
    if not len(frames):
        return 0.0
    quaternion = observed_poses(target, frames)[:, 3:]
    up = Rotation.from_quat(quaternion, scalar_first=True).inv().apply([0.0, 0.0, 1.0])
    return float(np.arccos(np.clip(up @ up[0], -1.0, 1.0)).max())


def _windows_of(model: Model, demonstration: Demonstration, length: float, whole: Segment) -> list[Segment]:
    """Return windows of a demonstration in which something is touched; none where states were not measured.

    What `whole`, the demonstration as one segment, has not seen is not seen in the windows.
    """
    assert model.geometry is not None
    try:
        found = cut_windows(model.scene, demonstration, model.geometry.bodies, length)
    except RecordingError:
        return []
    unseen = {t.body: t.time[~np.isfinite(t.points).any(axis=(1, 2))] for t in whole.targets}
    result = []
    for segment in found:
        start = float(segment.name.rsplit("@", 1)[1])
        targets = []
        for target in segment.targets:
            times = unseen[target.body]
            off = np.abs(target.time[:, None] + start - times[None]).min(axis=1, initial=np.inf)
            targets.append(_without(target, off < 2e-3))
        targets = [t for t in targets if np.isfinite(t.points).any()]
        if targets:
            result.append(replace(segment, targets=tuple(targets)))
    return result


def shortened(m: mujoco.MjModel, segment: Segment, length: float) -> Segment:
    """Return the beginning of a segment."""
    targets = []
    for target in segment.targets:
        inside = target.time <= length
        targets.append(replace(target, time=target.time[inside], points=target.points[inside]))
    steps = int(np.ceil(length / m.opt.timestep - 1e-9))
    return replace(segment, ctrl=segment.ctrl[:steps], targets=tuple(targets))
