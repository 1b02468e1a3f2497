"""Tracking on a data set of the BOP benchmark: ADD, ADD-S, the areas under their curves, and the challenge's file.

python -m benchmarks.perception.bop                          # on a data set of our own, rendered in BOP's format
python -m benchmarks.perception.bop ycbv                     # every scene of ycbv/test; goes on where it stopped
python -m benchmarks.perception.bop ycbv --scenes 48 49 --csv concent_ycbv-test.csv --targets
python -m benchmarks.perception.bop ycbv --table             # the page from the stored results

Every object starts at its true pose in the first image, as is usual for trackers, and is followed from there; with
--search it is searched. The table on which the objects stand is unknown, so what is beside an object says nothing
against a pose (TrackCfg.accept.max_unexplained).
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from benchmarks.measurements import Measurements
from benchmarks.pages import FOLDER, machine, machine_line, table, write_page
from benchmarks.perception.bop_scene import Orbit, write_bop_scene
from concent_warp.errors import RecordingError
from concent_warp.perception.evaluation.bop_results import BopEstimate, bop_errors, bop_estimates, write_results
from concent_warp.perception.evaluation.pose_errors import area_under_curve
from concent_warp.perception.tracking.cfg import AcceptCfg, TrackCfg
from concent_warp.perception.tracking.track import track
from concent_warp.recording.logs.bop.dataset import models_folder, read_scene, scene_folders, symmetric_objects
from concent_warp.recording.logs.bop.import_bop import open_bop
from concent_warp.recording.logs.cfg import BopCfg, ImportCfg

NAME = "bop"
ORBITS = tuple(Orbit(start=start, speed=speed) for start, speed in ((0.0, 0.35), (1.6, -0.5), (3.4, 0.8), (4.9, -1.1)))
"""Scenes of the data set of our own."""
TRACK = TrackCfg(accept=AcceptCfg(max_unexplained=1.0))
OWN = "rendered"
CENTIMETRE = 0.01


@dataclass(frozen=True)
class Args:
    """Command line."""

    folder: Annotated[Path | None, tyro.conf.Positional] = None
    """Data set in BOP's format, with models and scenes; one of our own is rendered by default."""
    split: str = "test"
    """Part of it."""
    scenes: tuple[int, ...] = ()
    """Numbers of scenes; all by default."""
    models: str | None = None
    """Folder of the meshes that are tracked; ``models`` by default."""
    last_image: int = 999_999
    """Number of the last image of each scene."""
    search: bool = False
    """Search the objects instead of starting at their true poses."""
    targets: bool = False
    """Evaluate and write only the images of test_targets_bop19.json."""
    csv: Path | None = None
    """Result file of the BOP challenge to write."""
    seconds: float | None = None
    """Time after which no scene is begun [s]."""
    data: Path = FOLDER / "data" / f"{NAME}.jsonl"
    """Where results are kept."""
    table: bool = False
    """Only write the page from the results."""


def measure(folder: Path, args: Args) -> tuple[dict[str, Any], list[BopEstimate]]:
    """Track one scene and return its figures, and the poses."""
    cfg = ImportCfg(bop=BopCfg(last_image=args.last_image, models=args.models))
    bop = open_bop(folder, cfg)
    recording = bop.recording()
    count = len(bop.numbers)
    begun = time.perf_counter()
    refused = ""
    try:
        tracks = track(recording, TRACK, pose="none" if args.search else "initial").tracks
    except RecordingError as error:
        tracks, refused = (), str(error)
    seconds = (time.perf_counter() - begun) / count
    estimates = bop_estimates(bop, tracks, only_targets=args.targets, seconds=seconds)
    symmetric = symmetric_objects(models_folder(bop.bop.root, args.models))
    objects = {
        str(one.object): {
            "symmetric": one.object in symmetric,
            "add": [None if np.isinf(e) else round(float(e), 6) for e in one.add],
            "adds": [None if np.isinf(e) else round(float(e), 6) for e in one.adds],
        }
        for one in bop_errors(estimates, bop.bop.root)
    }
    row = {"images": count, "seconds": round(seconds, 4), "objects": objects, "refused": refused}
    return row, estimates


def kept_poses(kept: Measurements, args: Args, root: Path, name: str) -> list[BopEstimate]:
    """Measure the scenes that are missing and return the poses of those measured in this run."""
    every: list[BopEstimate] = []
    for folder in scene_folders(root, args.split):
        number = read_scene(folder).number
        key = f"{name}/{args.split}/{number}{' searched' * args.search}{' targets' * args.targets}"
        if (not args.scenes or number in args.scenes) and (args.csv is not None or kept.wanted(key)):
            row, estimates = measure(folder, args)
            every += estimates
            about = {"dataset": name, "split": args.split, "scene": number, "search": args.search}
            kept.add(key, {**about, **row, "machine": machine()})
    return every


def main() -> None:
    """Measure what is missing and write page and result file."""
    args = tyro.cli(Args)
    kept = Measurements(args.data, seconds=args.seconds)
    if not args.table:
        with tempfile.TemporaryDirectory() as place:
            root, name = Path(place) / OWN, OWN
            if args.folder is not None:
                root, name = args.folder, args.folder.resolve().name
            else:
                for k, orbit in enumerate(ORBITS):
                    write_bop_scene(root, k + 1, orbit, seed=k)
            poses = kept_poses(kept, args, root, name)
            if args.csv is not None:
                print(f"wrote {args.csv}: {write_results(args.csv, poses)} poses")
        kept.close()
    if args.data.parent == FOLDER / "data":
        write_page(NAME, page(kept.rows))


def errors_of(rows: list[dict[str, Any]], number: str, measure: str) -> np.ndarray:
    """Return the errors of an object in all scenes [m], infinite where it was lost, shape (n,)."""
    found = [row["objects"][number][measure] for row in rows if number in row["objects"]]
    return np.array([np.inf if e is None else e for scene in found for e in scene])


def page(rows: dict[str, Any]) -> str:
    """Return the page of results."""
    measured = list(rows.values())
    parts = [INTRODUCTION]
    for name, search in dict.fromkeys((row["dataset"], row["search"]) for row in measured):
        mine = [row for row in measured if (row["dataset"], row["search"]) == (name, search)]
        images = sum(row["images"] for row in mine)
        scenes = ", ".join(str(row["scene"]) for row in mine)
        start = "first poses searched" if search else "first poses true"
        parts += [f"## {name}: scenes {scenes}, {images} images, {start}\n", machine_line(mine[-1]["machine"]) + "\n"]
        parts.append(_objects(mine))
        speed = images / sum(row["images"] * row["seconds"] for row in mine)
        parts.append(f"{speed:.1f} images/s, all objects of an image together.\n")
        parts += [f"Scene {row['scene']} was refused: {row['refused']}\n" for row in mine if row["refused"]]
    parts.append(CLOSING)
    return "\n".join(parts)


def _objects(rows: list[dict[str, Any]]) -> str:
    """Return the table of objects with the mean over them and over all poses."""
    head = (
        "object",
        "poses",
        "lost",
        "AUC of ADD",
        "AUC of ADD-S",
        "AUC of ADD(-S)",
        "ADD < 2 cm",
        "median ADD-S [mm]",
    )
    numbers = sorted({number for row in rows for number in row["objects"]}, key=int)
    lines, values, pooled = [], [], [np.zeros(0)] * 3
    for number in numbers:
        add, adds = errors_of(rows, number, "add"), errors_of(rows, number, "adds")
        symmetric = any(row["objects"].get(number, {}).get("symmetric") for row in rows)
        either = adds if symmetric else add
        pooled = [np.concatenate(pair) for pair in zip(pooled, (add, adds, either), strict=True)]
        areas = [100 * area_under_curve(e) for e in (add, adds, either)]
        values.append(areas)
        middle = 1e3 * float(np.median(adds))
        lines.append((
            f"{number}{' (symmetric)' * symmetric}", str(len(add)), str(int(np.isinf(add).sum())),
            *(f"{area:.1f}" for area in areas), f"{np.mean(add < 2 * CENTIMETRE):.1%}",
            f"{middle:.2f}" if np.isfinite(middle) else "lost",
        ))  # fmt: skip
    count, lost = str(len(pooled[0])), str(int(np.isinf(pooled[0]).sum()))
    lines.append(("mean of objects", count, lost, *(f"{v:.1f}" for v in np.mean(values, axis=0)), "", ""))
    lines.append(("all poses", count, lost, *(f"{100 * area_under_curve(e):.1f}" for e in pooled), "", ""))
    return table(head, lines)


INTRODUCTION = """\
# Tracking on BOP data sets

`python -m benchmarks.perception.bop FOLDER` tracks the objects in every scene of a data set in
[BOP's format](../import.md#a-scene-of-a-bop-data-set), such as YCB-V, writes this page and, with `--csv`, the file
that bop_toolkit and the challenge's server take. ADD is the mean distance of model points from where they truly are,
ADD-S that of the nearest points, which does not see symmetries; AUC is the area under the share of poses below a
threshold, from 0 to 10 cm, in percent (PoseCNN's measure for YCB-V; a lost object counts as infinitely far). ADD(-S)
is ADD-S for the objects to which `models_info.json` gives a symmetry, else ADD.

**No data set of BOP was at hand where this page was written.** *rendered* is one of our own in the same format: a
carton and a stepped block with a pattern, a plain can, at rest on a table, 640 x 480, 30 images/s, seen by Reality's
camera with its noise, which orbits them at 0.2 to 0.7 m/s in four scenes of 60 images. Its figures show that reader,
tracker and evaluation work together, and are to be compared with no published ones: shapes are exact, the scenes
short, nothing hides the objects. Run it on YCB-V yourself. ADD of the can counts its spin, which nothing shows.
"""
CLOSING = """\
Results are kept in `docs/benchmarks/data/bop.jsonl`, scene by scene; `--table` writes the page from them. First poses
are those of the ground truth, as for ICG and other trackers, and not what BOP's challenge asks for (detection without
prior): `--search` finds them, which fails where an unknown table carries the objects. Poses are smoothed over the
whole scene, forward and backward, so that an image's pose draws on later images; the time in the result file is the
mean of a scene.
"""


if __name__ == "__main__":
    main()
