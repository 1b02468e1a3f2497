"""``concent splat-fit``: posed images of an object, or a recording of it, become Gaussian splats."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tyro

from concent_warp.checks import Pixels, Positive
from concent_warp.cli.options import DeviceOption, OptionalOutPath
from concent_warp.cli.terminal import quiet_warp, say, say_written, status_bar
from concent_warp.errors import RenderError
from concent_warp.recording.load import load_recording
from concent_warp.render.splats.cfg import SplatFitCfg
from concent_warp.render.splats.recorded_views import RecordedViewsCfg, recorded_views
from concent_warp.run_folder import check_run_folder, run_folder, write_settings

if TYPE_CHECKING:
    from concent_warp.render.splats.fit import Score

RECORDINGS = (".h5", ".hdf5")
"""Suffixes of recordings."""


@dataclass(frozen=True)
class Arguments:
    """Fit Gaussian splats to posed images of an object, or to the frames of a recording in which its pose is known.

    Writes splats.ply, the peak signal-to-noise ratios of images that were not fitted (scores.json), and a picture of
    these beside the splats (held_out.png) to a run folder.
    """

    images: tyro.conf.Positional[Path]
    """Folder with a transforms.json, or such a file: images with an alpha channel, and where their cameras were; or a
    recording (.h5) with images and measured or tracked poses."""
    out: OptionalOutPath = None
    """Run folder; by default runs/splats_<name of the folder or recording>."""
    body: str | None = None
    """Object in the recording; by default the only one."""
    camera: tuple[str, ...] = ()
    """Cameras of the recording; all by default."""
    points: Path | None = None
    """Mesh or point cloud to start from, in the frame of the object; by default the hull that the masks agree on,
    and of a recording the shape in the scene."""
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
    frames: RecordedViewsCfg = field(default_factory=RecordedViewsCfg)


def run(arguments: Arguments) -> list[Score]:
    """Fit and write the run folder."""
    from concent_warp.render.splats.views import read_views

    source = arguments.images if arguments.images.is_dir() else arguments.images.parent
    name = arguments.images.stem if arguments.images.suffix in RECORDINGS else source.resolve().name
    folder = arguments.out or Path("runs") / f"splats_{name}"
    check_run_folder(folder, overwrite=arguments.overwrite, resume=arguments.resume)
    if arguments.points is not None and not arguments.points.is_file():
        raise RenderError("no such mesh or point cloud", where=arguments.points)
    points: Path | np.ndarray | None = arguments.points
    if arguments.images.suffix in RECORDINGS:
        recording = load_recording(arguments.images)
        views, surface = recorded_views(recording, arguments.body, arguments.camera, arguments.frames)
        points = surface if points is None else points
    elif arguments.body is not None or arguments.camera:
        raise RenderError("posed images have neither bodies nor cameras to name", where=arguments.images)
    else:
        views = read_views(arguments.images)
    views = views.shrunk(arguments.longest)
    quiet_warp()
    from concent_warp.render.splats.fit_splats import PICTURE, SCORES, SPLATS, fit_splats

    with run_folder(folder, overwrite=arguments.overwrite, resume=arguments.resume) as claimed:
        write_settings(claimed.path, arguments)
        with status_bar("fitting splats") as progress:
            fit, scores = fit_splats(
                views,
                claimed.path,
                arguments.fit,
                points=points,
                scale=arguments.scale,
                device=arguments.device,
                resume=arguments.resume,
                progress=progress,
            )
    if scores:
        psnr, over_object = (sum(getattr(s, name) for s in scores) / len(scores) for name in ("psnr", "psnr_object"))
        say(
            f"{len(fit):,} splats; {len(scores)} images that were not fitted: {psnr:.1f} dB, "
            f"{over_object:.1f} dB over the object alone"
        )
    say_written(*(folder / name for name in (SPLATS, SCORES, PICTURE) if (folder / name).exists()))
    return scores
