"""``concent splat-fit``: posed images of an object become Gaussian splats."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from concent_warp.checks import Pixels, Positive
from concent_warp.cli.options import DeviceOption, OptionalOutPath
from concent_warp.cli.terminal import quiet_warp, say, say_written, status_bar
from concent_warp.errors import RenderError
from concent_warp.files import write_bytes, write_text
from concent_warp.render.splats.cfg import SplatFitCfg
from concent_warp.run_folder import CHECKPOINT, check_run_folder, run_folder, write_settings

if TYPE_CHECKING:
    import numpy as np

    from concent_warp.render.splats.fit import Score, SplatFit
    from concent_warp.render.splats.views import SplatViews

SPLATS, SCORES, PICTURE = "splats.ply", "scores.json", "held_out.png"
MOST_PICTURES = 6
"""Images in the picture."""


@dataclass(frozen=True)
class Arguments:
    """Fit Gaussian splats to posed images of an object.

    Writes splats.ply, the peak signal-to-noise ratios of images that were not fitted (scores.json), and a picture of
    these beside the splats (held_out.png) to a run folder.
    """

    images: tyro.conf.Positional[Path]
    """Folder with a transforms.json, or such a file: images with an alpha channel, and where their cameras were."""
    out: OptionalOutPath = None
    """Run folder; by default runs/splats_<name of the folder>."""
    points: Path | None = None
    """Mesh or point cloud to start from, in the frame of the object; by default the hull that the masks agree on."""
    scale: Positive = 1.0
    """Factor from the unit of the points to metres."""
    longest: Pixels = 800
    """Larger images are made smaller, so that their longer edge has so many pixels."""
    device: DeviceOption = None
    resume: bool = False
    """Continue an interrupted fit; the result is the same as without the interruption."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""
    fit: SplatFitCfg = field(default_factory=SplatFitCfg)


def run(arguments: Arguments) -> list[Score]:
    """Fit and write the run folder."""
    from concent_warp.render.splats.views import read_views

    source = arguments.images if arguments.images.is_dir() else arguments.images.parent
    folder = arguments.out or Path("runs") / f"splats_{source.resolve().name}"
    check_run_folder(folder, overwrite=arguments.overwrite, resume=arguments.resume)
    views = read_views(arguments.images).shrunk(arguments.longest)
    if arguments.points is not None and not arguments.points.is_file():
        raise RenderError("no such mesh or point cloud", where=arguments.points)
    quiet_warp()
    with run_folder(folder, overwrite=arguments.overwrite, resume=arguments.resume) as claimed:
        write_settings(claimed.path, arguments)
        fit = _fitted(arguments, views, claimed.path / CHECKPOINT)
        scores = _write_results(fit, claimed.path)
    say_written(*(folder / name for name in (SPLATS, SCORES, PICTURE) if (folder / name).exists()))
    return scores


def _fitted(arguments: Arguments, views: SplatViews, checkpoint: Path) -> SplatFit:
    """Return the fit, gone through to its end."""
    import numpy as np
    import torch

    from concent_warp.render.splats.fit import SplatFit

    cfg = arguments.fit
    device = arguments.device or ("cuda:0" if torch.cuda.is_available() else "cpu")
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise RenderError(
            "no such device", expected='"cpu" or "cuda:0"', found=f"{device!r} ({str(error).splitlines()[0]})"
        ) from None
    fit = SplatFit(views, _start(arguments, views, np.random.default_rng(cfg.seed)), cfg, device=device)
    if arguments.resume and checkpoint.exists():
        fit.resume(checkpoint)
    first, begun = fit.iteration, time.monotonic()
    with status_bar("fitting splats") as update:

        def show(done: int, loss: float) -> None:
            left = (time.monotonic() - begun) / (done - first) * (cfg.iterations - done)
            update(done / cfg.iterations, f"{len(fit):,} splats, loss {loss:.4f}", left)

        fit.learn(show, checkpoint)
    return fit


def _start(arguments: Arguments, views: SplatViews, rng: np.random.Generator) -> np.ndarray:
    """Return the points to start from [m], shape (n, 3)."""
    from concent_warp.render.splats.initial import read_start, visual_hull

    if arguments.points is None:
        return visual_hull(views, arguments.fit.start, rng)
    return read_start(arguments.points, arguments.fit.start, arguments.scale, rng)


def _write_results(fit: SplatFit, folder: Path) -> list[Score]:
    """Write the splats, their scores and the picture, and say what came out."""
    import cv2
    import numpy as np
    import torch

    with torch.no_grad():
        fit.splats().write(folder / SPLATS)
    scores = fit.evaluate()
    write_text(folder / SCORES, json.dumps([asdict(score) for score in scores], indent=1))
    if scores:
        psnr = np.array([[score.psnr, score.psnr_object] for score in scores]).mean(axis=0)
        say(
            f"{len(fit):,} splats; {len(scores)} images that were not fitted: {psnr[0]:.1f} dB, "
            f"{psnr[1]:.1f} dB over the object alone"
        )
        picture = np.hstack([fit.picture(v) for v in fit.held_out[:MOST_PICTURES]])
        write_bytes(folder / PICTURE, cv2.imencode(Path(PICTURE).suffix, picture[..., ::-1])[1].tobytes())
    return scores
