"""``concent demo``: the main job where no robot is at hand, in Reality, a simulated world."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from concent_warp.cli.options import EngineOption, OutPath
from concent_warp.cli.summary import fit_progress, say_grounded
from concent_warp.cli.terminal import progress_bar, say
from concent_warp.fit.fit_geometry import FitCfg
from concent_warp.ground import GroundCfg, Grounded, ground
from concent_warp.reality.record import RealityCfg, record
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.run_folder import run_folder, write_settings
from concent_warp.scene.spheres.build import ContactGeometryCfg


@dataclass(frozen=True)
class Arguments:
    """Record demonstrations of the shape sorter in Reality, fit the contact geometry, extract the contact
    events, compare, and write a report. The fit starts from the paper's geometry: spheres centred on the surface.
    """

    out: OutPath = Path("runs/demo")
    """Run folder."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the demonstrations to fit."""
    unseen_seeds: tuple[int, ...] = (1, 2)
    """Seeds of further demonstrations, on which the fit is evaluated and which it does not use."""
    engine: EngineOption = "auto"
    resume: bool = False
    """Continue an interrupted run; the result is the same as without the interruption."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""
    geometry: Annotated[ContactGeometryCfg, tyro.conf.OmitArgPrefixes] = field(
        default_factory=lambda: ContactGeometryCfg(placement="surface")
    )
    fit: FitCfg = field(default_factory=FitCfg)
    reality: RealityCfg = field(default_factory=RealityCfg)


def run(arguments: Arguments) -> Grounded:
    """Run the demonstration and write the run folder."""
    folder = arguments.out
    with run_folder(folder, overwrite=arguments.overwrite, resume=arguments.resume) as claimed:
        settings = write_settings(claimed.path, arguments)
        with progress_bar("recording") as progress:
            seeds = [*arguments.seeds, *arguments.unseen_seeds]
            recording, truths = record(arguments.reality, seeds, progress=progress)
        write_hdf5(recording, claimed.path / "demo.h5")
        names = tuple(d.name for d in recording.demonstrations)
        say(f"recorded {len(names)} demonstrations")
        truth = {name: (found.time, found.contacts) for name, found in zip(names, truths, strict=True)}
        cfg = GroundCfg(arguments.geometry, arguments.fit, names[: len(arguments.seeds)])
        with fit_progress() as progress:
            found = ground(
                recording,
                claimed.path,
                cfg,
                truth=truth,
                settings=settings,
                engine=arguments.engine,
                resume=arguments.resume,
                progress=progress,
            )
    say_grounded(found, folder)
    return found
