"""``concent fit``: a recording becomes a grounded model, with its contact events, a comparison and a report."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from concent_warp.cli.given_model import given_model
from concent_warp.cli.options import EngineOption, OptionalOutPath
from concent_warp.cli.summary import fit_progress, say_grounded
from concent_warp.fit.fit_geometry import FitCfg, Method
from concent_warp.ground import GroundCfg, Grounded, ground
from concent_warp.model import Model
from concent_warp.recording.load import load_recording
from concent_warp.recording.recording import Recording
from concent_warp.run_folder import run_folder, write_settings
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg


@dataclass(frozen=True)
class Arguments:
    """Fit the contact geometry of the objects so that replaying the recording reproduces the observed motion.

    Writes model.toml, the contact events, a comparison with the starting geometry, and report.html to a run folder.
    """

    recording: tyro.conf.Positional[Path]
    """Recording: an HDF5 file, a folder of CSV files, or ContactNets tosses."""
    out: OptionalOutPath = None
    """Run folder; by default runs/<name of the recording>."""
    model: Path | None = None
    """Model to start from (.toml); by default spheres are laid on the objects of the recording's scene."""
    scene: Path | None = None
    """MJCF scene in place of the recording's own; its actuators and sensors must have the same names."""
    demonstrations: tuple[str, ...] = ()
    """Demonstrations to fit; all by default. The comparison is about all in any case."""
    method: Method = "es"
    """"es", the evolution strategy; "gradient", descent by gradients through Newton; "gradient+es", the latter as a
    start for the former. Where gradients do not help, "es" is taken and said so."""
    engine: EngineOption = "auto"
    resume: bool = False
    """Continue an interrupted run; the result is the same as without the interruption."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""
    geometry: Annotated[ContactGeometryCfg, tyro.conf.OmitArgPrefixes] = field(default_factory=ContactGeometryCfg)
    fit: FitCfg = field(default_factory=FitCfg)


def run(arguments: Arguments) -> Grounded:
    """Fit and write the run folder."""
    recording = load_recording(arguments.recording)
    recording.only(arguments.demonstrations)
    start = _starting_model(arguments, recording)
    folder = arguments.out or Path("runs") / arguments.recording.stem
    cfg = GroundCfg(
        geometry=arguments.geometry,
        fit=arguments.fit,
        method=arguments.method,
        demonstrations=arguments.demonstrations,
    )
    with run_folder(folder, overwrite=arguments.overwrite, resume=arguments.resume) as claimed:
        settings = write_settings(claimed.path, arguments)
        with fit_progress() as progress:
            found = ground(
                recording,
                claimed.path,
                cfg,
                start=start,
                settings=settings,
                engine=arguments.engine,
                resume=arguments.resume,
                progress=progress,
            )
    say_grounded(found, folder)
    return found


def _starting_model(arguments: Arguments, recording: Recording) -> Model:
    """Return the model to start from."""
    if arguments.model is not None:
        return given_model(arguments.model, recording.only(arguments.demonstrations))
    scene = Scene(recording.scene, str(arguments.recording))
    if arguments.scene is not None:
        scene = Scene.from_mjcf(arguments.scene)
    return Model(scene, arguments.geometry.build(scene))
