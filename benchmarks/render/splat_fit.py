"""Splats fitted to photographs of Reality's objects, scored on held-out photographs.

    python -m benchmarks.render.splat_fit  measure on the CPU; writes the data, the page and the picture
    python -m benchmarks.render.splat_fit --photographs runs/photos --make      only make the photographs of all cases
    python -m benchmarks.render.splat_fit --device cuda:0 --photographs runs/photos --out F.jsonl    the same on a GPU
    python -m benchmarks.render.splat_fit --table                 the page from the stored data, without runs

Block and box of the shape sorter with their printed pattern are photographed from all sides by Reality's camera against
black, three by three rays a pixel; every eighth photograph is held out. `concent splat-fit` does the same with a folder
of photographs. *before black* is the peak signal-to-noise ratio of whole images, which are mostly empty; *object* is
that over the pixels that mask or splats cover. *noise of 2/255* is added to each colour of each photograph, held-out
ones included: 42 dB is the limit there. Photographs are rendered on a CPU; a host where Warp has none reads them from
a folder. The figures do not show real photographs, with inexact camera poses, backgrounds and masks.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measurements import Measurements
from benchmarks.pages import FOLDER, machine, machine_line, table, write_page
from concent_warp.reality.sensors.photographs import PhotographsCfg, photographs
from concent_warp.reality.world import WorldCfg
from concent_warp.render.splats.cfg import SplatFitCfg
from concent_warp.render.splats.fit import SplatFit
from concent_warp.render.splats.initial import visual_hull
from concent_warp.render.splats.views import FILE, SplatViews, read_views
from concent_warp.scene.shape_sorter import ShapeSorterCfg

NAME = "splat_fit"
DATA = FOLDER / "data" / f"{NAME}.jsonl"
CASES: dict[str, tuple[str, PhotographsCfg, dict[str, Any]]] = {
    "block": ("block", PhotographsCfg(count=56), {}),
    "box": ("box", PhotographsCfg(count=56), {}),
    "block, noise of 2/255": ("block", PhotographsCfg(count=56, rgb_std=2.0), {}),
    "block, without view dependence": ("block", PhotographsCfg(count=56), {"degree": 0}),
    "block, 24 photographs": ("block", PhotographsCfg(count=24), {}),
    "box, 120 photographs": ("box", PhotographsCfg(count=120), {}),
    "box, 24,000 splats": ("box", PhotographsCfg(count=120), {"most": 24_000, "views": 4}),
}
"""Object, photographs, changes of the settings."""


def views_of(case: str, folder: Path | None) -> SplatViews:
    """Return the photographs of a case, from a folder if they are there."""
    body, photographing, _ = CASES[case]
    path = None if folder is None else folder / f"{body}_{photographing.count}_{photographing.rgb_std:g}"
    if path is not None and (path / FILE).exists():
        return read_views(path)
    world = WorldCfg().build(ShapeSorterCfg().build())
    views = SplatViews(*photographs(world, body, photographing), masked=True)
    if path is not None:
        views.write(path)
    return views


def measure(case: str, device: str, iterations: int, folder: Path | None) -> tuple[dict[str, Any], np.ndarray]:
    _, photographing, changes = CASES[case]
    views = views_of(case, folder)
    cfg = SplatFitCfg(iterations=iterations, **changes)
    begun = time.perf_counter()
    fit = SplatFit(views, visual_hull(views, cfg.start, np.random.default_rng(cfg.seed)), cfg, device=device)
    fit.learn()
    seconds = time.perf_counter() - begun
    scores = fit.evaluate()
    row = {
        "photographs": len(fit.fitted),
        "held_out": len(scores),
        "size": photographing.size,
        "iterations": iterations,
        "splats": len(fit),
        "seconds": seconds,
        "psnr": float(np.mean([score.psnr for score in scores])),
        "worst": float(min(score.psnr for score in scores)),
        "worst_view": int(min(scores, key=lambda score: score.psnr).view),
        "psnr_object": float(np.mean([score.psnr_object for score in scores])),
        "machine": machine(device),
    }
    return row, np.hstack([fit.picture(v) for v in fit.held_out[:6]])


def write(rows: dict[str, dict[str, Any]]) -> None:
    head = ("object", "fitted", "held out", "steps", "splats", "time, s", "before black, dB", "worst, dB", "object, dB")
    parts = [
        "# Splats fitted to photographs\n\nWritten by `benchmarks/render/splat_fit.py`; do not edit.\n",
        *(f"{part}\n" for part in (__doc__ or "").split("\n\n")[2:]),
    ]
    for device in dict.fromkeys(row["device"] for row in rows.values()):
        of_device = [row for row in rows.values() if row["device"] == device]
        parts += [f"## {device}\n", machine_line(of_device[-1]["machine"]) + "\n"]
        lines = [
            (
                row["case"], f"{row['photographs']}", f"{row['held_out']}", f"{row['iterations']:,}",
                f"{row['splats']:,}", f"{row['seconds']:.0f}", f"{row['psnr']:.1f}", f"{row['worst']:.1f}",
                f"{row['psnr_object']:.1f}",
            )
            for row in of_device
        ]  # fmt: skip
        parts.append(table(head, lines))
    parts.append("![Held-out photographs, and below them the splats](splat_fit.png)\n")
    parts.append("*Above: held-out photographs of block and box. Below: the splats.*")
    write_page(NAME, "\n".join(parts))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    parser.add_argument("--iterations", type=int, default=1500, help="steps of a fit")
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES), help="what to measure")
    parser.add_argument("--photographs", type=Path, help="folder that photographs are taken from, and kept in")
    parser.add_argument("--make", action="store_true", help="only make the photographs")
    parser.add_argument("--pictures", type=Path, default=FOLDER, help="folder of the pictures")
    parser.add_argument("--out", type=Path, default=DATA, help="file of JSON lines")
    parser.add_argument("--seconds", type=float, default=None, help="time after which no fit is begun [s]")
    parser.add_argument("--table", action="store_true", help="write the page from the stored data")
    arguments = parser.parse_args()
    if arguments.make:
        for case in arguments.cases:
            views_of(case, arguments.photographs)
        return
    kept = Measurements(arguments.out, seconds=arguments.seconds)
    if not arguments.table:
        import cv2

        pictures = {}
        for case in arguments.cases:
            if kept.wanted(f"{arguments.device} {case}"):
                row, pictures[case] = measure(case, arguments.device, arguments.iterations, arguments.photographs)
                kept.add(f"{arguments.device} {case}", {"device": arguments.device, "case": case, **row})
        kept.close()
        if {"block", "box"} <= set(pictures):
            both = np.vstack([pictures["block"], pictures["box"]])
            cv2.imwrite(str(arguments.pictures / f"{NAME}.png"), both[..., ::-1])
    if arguments.out == DATA:
        write(kept.rows)


if __name__ == "__main__":
    main()
