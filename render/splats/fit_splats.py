"""A fit of splats from its images to its files: splats, scores of images that were not fitted, and a picture."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import torch

from concent_warp.errors import RenderError
from concent_warp.files import write_bytes, write_text
from concent_warp.render.splats.cfg import SplatFitCfg
from concent_warp.render.splats.fit import Score, SplatFit
from concent_warp.render.splats.initial import read_start, visual_hull
from concent_warp.render.splats.views import SplatViews
from concent_warp.run_folder import CHECKPOINT

SPLATS, SCORES, PICTURE = "splats.ply", "scores.json", "held_out.png"
"""Files of a fit in its folder."""
MAX_PICTURES = 6
"""Images in the picture."""
Progress = Callable[[float, str, float | None], None]
"""Called with the share done, 0..1, a text, and the time left [s]."""


def fit_splats(
    views: SplatViews,
    folder: Path,
    cfg: SplatFitCfg | None = None,
    *,
    points: Path | np.ndarray | None = None,
    scale: float = 1.0,
    device: str | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> tuple[SplatFit, list[Score]]:
    """Fit splats to posed images and write the files of the fit.

    Args:
        views: Posed images.
        folder: Folder to write to, which exists.
        cfg: Settings.
        points: Mesh or point cloud to start from, in the frame of the object, or its points [m], shape (n, 3); by
            default the hull that the masks agree on.
        scale: Factor from the unit of a file of points to metres.
        device: torch's name of the device; the first CUDA device by default where there is one.
        resume: Whether to continue from the checkpoint in the folder, if there is one.
        progress: Called after steps.

    Returns:
        The fit, and the scores of the images that were not fitted.

    Raises:
        RenderError: There is no such device, or points or checkpoint cannot be used.
    """
    cfg = cfg or SplatFitCfg()
    device = device or ("cuda:0" if torch.cuda.is_available() else "cpu")
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise RenderError(
            "no such device", expected='"cpu" or "cuda:0"', found=f"{device!r} ({str(error).splitlines()[0]})"
        ) from None
    rng = np.random.default_rng(cfg.seed)
    if isinstance(points, np.ndarray):
        start = points[rng.permutation(len(points))[: cfg.start]]
    else:
        start = visual_hull(views, cfg.start, rng) if points is None else read_start(points, cfg.start, scale, rng)
    fit, checkpoint = SplatFit(views, start, cfg, device=device), folder / CHECKPOINT
    if resume and checkpoint.exists():
        fit.resume(checkpoint)
    first, begun = fit.iteration, time.monotonic()

    def report(done: int, loss: float) -> None:
        if progress is not None:
            left = (time.monotonic() - begun) / (done - first) * (cfg.iterations - done)
            progress(done / cfg.iterations, f"{len(fit):,} splats, loss {loss:.4f}", left)

    fit.learn(report, checkpoint)
    return fit, _write_results(fit, folder)


def _write_results(fit: SplatFit, folder: Path) -> list[Score]:
    """Write the splats, their scores and the picture, and return the scores."""
    with torch.no_grad():
        fit.splats().write(folder / SPLATS)
    scores = fit.evaluate()
    write_text(folder / SCORES, json.dumps([asdict(score) for score in scores], indent=1))
    if scores:
        picture = np.hstack([fit.picture(v) for v in fit.held_out[:MAX_PICTURES]])
        write_bytes(folder / PICTURE, cv2.imencode(Path(PICTURE).suffix, picture[..., ::-1])[1].tobytes())
    return scores
