"""Tracking with masks and tracked points beside the default: errors, losses and frames per second of processor time.

python -m benchmarks.perception.backends                  # goes on where the last run stopped
python -m benchmarks.perception.backends --seconds 280    # stops after that time
python -m benchmarks.perception.backends --table          # the page from the stored results
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.measurements import Measurements
from benchmarks.pages import FOLDER, machine, machine_line, table, write_page
from benchmarks.perception.track import BODY, SETS, Filmed, errors, film
from concent_warp.errors import RecordingError
from concent_warp.perception.backends.depth import DepthMasker
from concent_warp.perception.backends.features import FeatureTracker
from concent_warp.perception.backends.flow import FlowTracker
from concent_warp.perception.backends.protocols import Masker, PointTracker
from concent_warp.perception.pinhole import Pinhole
from concent_warp.perception.tracking.cfg import RegistrationCfg, TrackCfg
from concent_warp.perception.tracking.track import track
from concent_warp.recording.recording import ImageStream

NAME = "backends"
SEEDS = tuple(range(6))
"""Seeds from 1000 on were used while this was developed."""
STEP = 5
"""Frames of which one is kept in the slow videos."""
COVERED = (10, 30)
"""Frames in which a half of the block is covered."""
HAND = 0.06
"""Distance of what covers it in front of its middle [m]."""
ALONE = TrackCfg(registration=RegistrationCfg(shape=False, fallback=False))
"""Points without depth and edges of the shape, but for keyframes and searches."""


@dataclass(frozen=True)
class Method:
    """A way of tracking."""

    options: str
    """Options of the command line, or what is set in Python."""
    cfg: TrackCfg | None = None
    masker: Callable[[], Masker] | None = None
    points: Callable[[], PointTracker] | None = None


DEFAULT, FLOW, MASKED = "model to frame", "flow", "model to frame, masks"
METHODS = {
    DEFAULT: Method("none (default)"),
    MASKED: Method("`--masker depth`", masker=DepthMasker),
    FLOW: Method("`--points flow`", points=FlowTracker),
    "flow, masks": Method("`--points flow --masker depth`", points=FlowTracker, masker=DepthMasker),
    "flow alone": Method("`--points flow`, alone", cfg=ALONE, points=FlowTracker),
    "features": Method("`--points features`", points=FeatureTracker),
    "features alone": Method("`--points features`, alone", cfg=ALONE, points=FeatureTracker),
}
VIDEOS = {"20 frames/s": tuple(METHODS), "4 frames/s": tuple(METHODS), "half covered": tuple(list(METHODS)[:4])}
"""Videos, and the methods that are tried on each."""
INTRODUCTION = f"""\
`python -m benchmarks.perception.backends`: the textured block of {{count}} of the videos of
[the tracker's page](track.md), seeds {{first}} to {{last}}, from the true first pose; these methods were developed on
seeds from 1000 on. *4 frames/s*: every {STEP}th frame. *Half covered*: something that is not in the scene covers one
half of the block, {1e3 * HAND:.0f} mm in front of it, in {COVERED[1] - COVERED[0]} of the 40 frames. *Alone*
(`TrackCfg.registration.shape` and `.fallback` off): depth and edges of the shape accept or refuse the poses of points
but do not improve them; keyframes and searches are the default tracker's. Frames per second are of processor time, of
one thread. *In interval*: within the 95 % ellipsoid of position, of rotation.
"""


@dataclass(frozen=True)
class Args:
    """Command line."""

    seeds: tuple[int, ...] = SEEDS
    """One video each."""
    seconds: float | None = None
    """Time after which no video is begun [s]."""
    data: Path = FOLDER / "data" / f"{NAME}.jsonl"
    """Where results are kept."""
    table: bool = False
    """Only write the page from the results."""


def variant(filmed: Filmed, name: str) -> Filmed:
    """Return one of the videos made of a film."""
    stream = filmed.recording[0].image["camera"]
    poses = filmed.poses
    if name == "4 frames/s":
        kept = slice(None, None, STEP)
        stream = replace(stream, time=stream.time[kept], rgb=stream.rgb[kept], depth=stream.depth[kept])
        poses = poses[kept]
    elif name == "half covered":
        stream = covered(stream, poses)
    demonstration = replace(filmed.recording[0], image={"camera": stream})
    return Filmed(replace(filmed.recording, demonstrations=(demonstration,)), poses)


def covered(stream: ImageStream, poses: np.ndarray) -> ImageStream:
    """Return a video in which something unknown covers the right half of the body at poses (T, 4, 4)."""
    rgb, depth, camera = stream.rgb.copy(), stream.depth.copy(), Pinhole.of(stream)
    rng = np.random.default_rng(0)
    for frame in range(*COVERED):
        (column, row), away = camera.project(poses[frame][:3, 3])
        hand = np.s_[max(round(row) - 90, 0) : round(row) + 90, round(column) : round(column) + 80]
        size = depth[frame][hand].shape
        rgb[frame][hand] = np.clip(rng.normal((200, 160, 140), 3, (*size, 3)), 0, 255).astype(np.uint8)
        depth[frame][hand] = away - HAND + rng.normal(0, 1e-3, size)
    return replace(stream, rgb=rgb, depth=depth)


def measure(filmed: Filmed, name: str) -> dict[str, Any]:
    """Return the figures of one method on one video."""
    method = METHODS[name]
    masker = None if method.masker is None else method.masker()
    points = None if method.points is None else method.points()
    begun = time.process_time()
    try:
        found = track(filmed.recording, method.cfg, pose={BODY: filmed.poses[0]}, masker=masker, points=points)
    except RecordingError as error:
        return {"refused": str(error)}
    spent = time.process_time() - begun
    return {**errors(found.track(BODY), filmed.poses, symmetric=False), "seconds": round(spent, 3)}


def main() -> None:
    """Measure what is missing and write the page."""
    args = tyro.cli(Args)
    kept = Measurements(args.data, seconds=args.seconds)
    if not args.table:
        _one_thread()
        for seed in args.seeds:
            wanted = [(v, m) for v, methods in VIDEOS.items() for m in methods if f"{m}, {v}, {seed}" not in kept.rows]
            if not wanted or not kept.wanted(f"seed {seed}", 90.0):
                continue
            filmed = film(seed, SETS["textured"])
            for video, method in wanted:
                row = {"method": method, "video": video, "seed": seed, **measure(variant(filmed, video), method)}
                kept.add(f"{method}, {video}, {seed}", {**row, "machine": machine()})
        kept.close()
    if args.data.parent == FOLDER / "data":
        write_page(NAME, page(kept.rows))


def _one_thread() -> None:
    """Let all libraries use one thread."""
    import cv2
    import torch

    os.environ["OMP_NUM_THREADS"] = "1"
    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def page(rows: dict[str, Any]) -> str:
    """Return the page of results."""
    seeds = sorted({row["seed"] for row in rows.values()})
    head = ("video", "method", "options", "position [mm]", "largest", "rotation [deg]", "largest", "frames lost",
            "positions in interval", "rotations in interval", "frames/s")  # fmt: skip
    lines = []
    for video, methods in VIDEOS.items():
        for name in methods:
            every = [r for r in rows.values() if r["video"] == video and r["method"] == name]
            good = [r for r in every if "position" in r]
            if not good:
                continue
            position, rotation, inside, turned = (
                np.concatenate([r[key] for r in good])
                for key in ("position", "rotation", "position_inside", "rotation_inside")
            )
            frames, lost = sum(r["frames"] for r in good), sum(r["lost"] for r in good)
            spent = sum(r["seconds"] for r in good)
            refused = f" ({len(every) - len(good)} videos refused)" if len(good) < len(every) else ""
            lines.append((
                video, name, METHODS[name].options, f"{position.mean():.2f}", f"{position.max():.2f}",
                f"{rotation.mean():.2f}", f"{rotation.max():.2f}", f"{lost} of {frames}{refused}",
                f"{inside.mean():.1%}", f"{turned.mean():.1%}", f"{frames / spent:.0f}",
            ))  # fmt: skip
    return "\n".join([
        "# Masks and tracked points\n",
        INTRODUCTION.format(count=len(seeds), first=seeds[0], last=seeds[-1]),
        machine_line(next(iter(rows.values()))["machine"]) + "\n",
        table(head, lines),
        "What the figures do not show: SAM 2 and TAPIR, whose weights users bring: they ran with made-up weights;\n"
        "motion blur; a hand that touches the block, which depth alone cannot tell from it.\n",
    ])  # fmt: skip


if __name__ == "__main__":
    main()
