"""Fits of contact geometry from video alone: unseen error and contacts beside those from measured poses.

python -m benchmarks.perception.fit_from_video                # goes on where the last run stopped
python -m benchmarks.perception.fit_from_video --seconds 500  # begins nothing after that time
python -m benchmarks.perception.fit_from_video --table        # the page from the stored results
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from benchmarks.fit.shape_sorter import interval, judge, starting_geometry
from benchmarks.measurements import Measurements
from benchmarks.pages import FOLDER, machine, machines, table, write_page
from benchmarks.perception.track import BODY, IMPERFECT
from concent_warp.errors import RecordingError
from concent_warp.fit.fit_geometry import fit_geometry
from concent_warp.model import Model
from concent_warp.perception.tracking.track import track
from concent_warp.reality.record import RealityCfg, Truth, record
from concent_warp.reality.sensors.camera import CAMERA, record_depth_images
from concent_warp.reality.sensors.sensing import SensingCfg
from concent_warp.recording.formats.hdf5 import read_hdf5
from concent_warp.recording.recording import Recording
from concent_warp.scene.scene import Scene

NAME = "track_fit"
Source = Literal["video", "instruments"]
SOURCES: tuple[Source, ...] = ("video", "instruments")
SEEDS = (40, 41, 42, 43, 44)
"""Of which none was used before."""
RATE = 30.0
"""Frames a second [Hz]."""
BAR = 0.5
"""Most by which the unseen error may exceed that from measured poses [mm]."""
INTRODUCTION = f"""\
`python -m benchmarks.perception.fit_from_video`: one demonstration of the insertion, filmed whole by one RGB-D camera
(640 x 480, {RATE:g} frames/s, noise, blur and holes as for [tracking](track.md)), tracked by `concent track --pose
none`, and fitted from the disturbed start of [the fit's page](fit_shape_sorter.md), whose errors these are: mean block
position error over align and insert [mm] of two unseen demonstrations. *Instruments*: the same with the poses and
points that Reality's pose tracker measures (0.3 mm, 0.17 degrees). Contacts: overlap (IoU) of the frames in which block
and box touch / of all body pairs with the block, unseen. The block is textured. Tracked before the tracker was made to
follow balls and impacts, by which the track of a block hardly changes; not repeated since.
"""


@dataclass(frozen=True)
class Args:
    """Command line."""

    seeds: tuple[int, ...] = SEEDS
    """Objects and demonstrations."""
    seconds: float | None = None
    """Time after which nothing is begun [s]."""
    out: Path = Path("runs") / NAME
    """Where tracked recordings are kept."""
    data: Path = FOLDER / "data" / f"{NAME}.jsonl"
    """Where results are kept."""
    table: bool = False
    """Only write the page from the results."""


def main(args: Args) -> None:
    """Track and fit what is not done yet, and write the page."""
    kept = Measurements(args.data, seconds=args.seconds)
    for seed in () if args.table else args.seeds:
        for source in SOURCES:
            if kept.wanted(f"{seed}/{source}"):
                kept.add(f"{seed}/{source}", {"machine": machine(), **study(seed, source, args.out)})
    if not args.table:
        kept.close()
    write_page(NAME, page(kept.rows))


def study(seed: int, source: Source, out: Path) -> dict[str, Any]:
    """Return the errors of a fit, before and after it."""
    recording, truths = record(RealityCfg(), [1000 * seed + k for k in range(3)])
    scene = Scene(recording.scene)
    model = Model(scene, starting_geometry(scene, "disturbed", seed))
    row: dict[str, Any] = {"seed": seed, "source": source}
    observed = recording
    try:
        if source == "video":
            observed, errors = tracked(recording, truths[0], seed, out)
            row |= errors
    except RecordingError as error:
        return row | {"failed": str(error)}
    begun = time.perf_counter()
    fit = fit_geometry(model, observed, demonstrations=["demo_0"])
    row["seconds"] = time.perf_counter() - begun
    for name, judged in (("before", model), ("after", fit.model)):
        row[name] = [judge(judged, d, t) for d, t in zip(recording.demonstrations, truths, strict=True)]
    return row


def tracked(recording: Recording, truth: Truth, seed: int, out: Path) -> tuple[Recording, dict[str, Any]]:
    """Return the first demonstration as the tracker sees it, and the position's errors [mm]."""
    cfg, demonstration, scene = RealityCfg(), recording[0], Scene(recording.scene)
    sensing = SensingCfg(**IMPERFECT, image_samples=1)
    at = np.arange(0, truth.time[-1], 1 / RATE)
    rows = np.round(at / cfg.world.timestep).astype(int)
    world = cfg.world.build(scene)
    stream = record_depth_images(
        sensing, world, scene.objects(), at, truth.qpos[rows], np.random.default_rng([seed, 1])
    )
    measured = {n: c for n, c in demonstration.measured.items() if not n.startswith(BODY)}
    film = replace(demonstration, qpos=None, qvel=None, measured=measured, points={}, image={CAMERA: stream})
    path = out / f"seed_{seed}.h5"
    (found,) = track(replace(recording, demonstrations=(film,)), bodies=(BODY,), pose="none", out=path).tracks
    seen = ~found.lost
    error = 1e3 * np.linalg.norm(found.pose[seen, :3, 3] - truth.block_position[rows][seen], axis=1)
    return read_hdf5(path), {
        "position": float(error.mean()), "largest": float(error.max()), "lost": int(found.lost.sum()),
        "frames": len(at),
    }  # fmt: skip


def page(rows: dict[str, dict[str, Any]]) -> str:
    """Return the page."""
    lines, differences = [], []
    for seed in SEEDS:
        here = {source: rows.get(f"{seed}/{source}") for source in SOURCES}
        done = {s: r for s, r in here.items() if r is not None and "after" in r}
        video = here["video"] or {}
        line = [str(seed)]
        line.append(
            f"{video['position']:.2f}, {video['lost']} of {video['frames']} lost" if "position" in video else "-"
        )
        any_row = next(iter(done.values()), None)
        line.append("-" if any_row is None else f"{unseen(any_row, 'before', 'mean'):.2f}")
        for source in SOURCES:
            row = done.get(source)
            line.append(video.get("failed", "not begun") if row is None else f"{unseen(row, 'after', 'mean'):.2f}")
        for source in SOURCES:
            row = done.get(source)
            line.append("-" if row is None else "/".join(f"{unseen(row, 'after', k):.2f}" for k in ("frames", "pairs")))
        lines.append(line)
        if len(done) == len(SOURCES):
            first, second = (unseen(done[s], "after", "mean") for s in SOURCES)
            differences.append(first - second)
    heads = [
        "seed", "tracked position [mm]", "unseen error before", "after, video", "after, instruments",
        "contacts, video", "contacts, instruments",
    ]  # fmt: skip
    text = f"# Fit from video\n\n{INTRODUCTION}\n{machines(rows)}\n\n{table(heads, lines)}"
    if not differences:
        return text
    low, high = interval(np.array(differences))
    return (
        f"{text}\nFrom video the unseen error is {np.mean(differences):+.2f} mm ({low:+.2f} to {high:+.2f}, bootstrap"
        f" over {len(differences)} seeds) above that from instruments (bar: {BAR:g} mm).\n"
    )


def unseen(row: dict[str, Any], model: str, key: str) -> float:
    """Return the mean of a figure over the unseen demonstrations."""
    return float(np.mean([d[key] for d in row[model][1:]]))


if __name__ == "__main__":
    main(tyro.cli(Args))
