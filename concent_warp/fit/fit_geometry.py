"""Fit contact geometry to recordings: the search of the paper's equation 1, optionally from a gradient start."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from concent_warp.checks import check_settings
from concent_warp.errors import RecordingError
from concent_warp.estimation.object_tracks import Segment, whole_demonstration
from concent_warp.estimation.windows import cut_windows, mark_held_out
from concent_warp.files import write_json
from concent_warp.fit.geometry.checkpoint import Checkpoint
from concent_warp.fit.geometry.search import FitResult, GeometrySearchCfg, Progress, Search
from concent_warp.fit.newton.descent import GradientCfg
from concent_warp.fit.newton.warm_start import GradientWarmStart
from concent_warp.model import Model, check_inputs
from concent_warp.recording.recording import Demonstration, Recording
from concent_warp.run_folder import CHECKPOINT, make_folder
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.simulate.select import EngineName

Method = Literal["es", "gradient", "gradient+es"]
"""Evolution strategy; gradients through Newton; gradients that seed the evolution strategy."""


@dataclass(frozen=True)
class FitCfg(GeometrySearchCfg):
    """Settings of a fit of contact geometry.

    Example:
        >>> import concent_warp as cw
        >>> cw.FitCfg(generations=30, held_out=0.2).generations
        30
    """

    gradient: GradientCfg = field(default_factory=GradientCfg)
    """Settings of the gradients, for the methods that use them."""


def fit_geometry(
    model: Model,
    recording: Recording,
    cfg: FitCfg | None = None,
    *,
    start: ContactGeometryCfg | None = None,
    demonstrations: Sequence[str] | None = None,
    segments: Sequence[Segment] | None = None,
    method: Method = "es",
    engine: EngineName = "auto",
    out: str | Path | None = None,
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> FitResult:
    """Move the spheres of a model so that replaying a recording reproduces the observed motion.

    Args:
        model: Model; where it has no contact geometry, spheres are laid on the objects of its scene.
        recording: What was commanded and observed.
        cfg: Settings.
        start: How spheres are laid on the objects of a model without contact geometry.
        demonstrations: Names of the demonstrations to fit; all by default.
        segments: Stretches to simulate instead of whole demonstrations.
        method: Evolution strategy, gradients through Newton, or the latter as a start for the former. Where gradients
            do not help, the evolution strategy is taken in any case; `FitResult.gradients` says so.
        engine: "mujoco", "warp", or "auto" for MuJoCo-Warp where there is a CUDA device.
        out: Folder for ``start.toml``, ``checkpoint.npz`` after each generation, and at the end ``model.toml`` and
            ``history.json``.
        resume: Continue from the folder's checkpoint, to the same result as without the interruption.
        progress: Called after each generation.

    Raises:
        ModelError: The scene has no objects to lay spheres on, or the checkpoint belongs to another fit.
        RecordingError: The recording does not observe any movable object, or a body carried a payload.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_policy("shape_sorter").run.recording
        >>> model, start = cw.Model.from_recording(recording), cw.ContactGeometryCfg(count=64)
        >>> fit = cw.fit_geometry(model, recording, cw.FitCfg(generations=1), start=start, engine="mujoco")
        >>> fit.stopped
        'all 1 generations done'
    """
    cfg = cfg or FitCfg()
    check_settings(cfg)
    check_inputs(model, recording)
    if model.geometry is None:
        model = model.with_geometry((start or ContactGeometryCfg()).build(model.scene))
    folder = None if out is None else Path(out)
    checkpoint = None
    if folder is not None:
        make_folder(folder)
        model.save(folder / "start.toml")
        checkpoint = folder / CHECKPOINT
    shown: list[Demonstration] = []
    if segments is None:
        names = [d.name for d in recording.demonstrations] if demonstrations is None else list(demonstrations)
        chosen = [recording[name] for name in names]
        replace(recording, demonstrations=tuple(chosen)).check_unloaded("a fit of contact geometry")
        shown = chosen if cfg.window is None else []
        segments = cut_segments(model, chosen, cfg)
    search = Search(model, list(segments), cfg, engine)
    if method != "es":
        warm_start(search, method, shown, cfg.gradient, checkpoint, resume, progress)
    if resume and checkpoint is not None and checkpoint.is_file():
        search.restore(Checkpoint.load(checkpoint))
    while search.stopped is None:
        search.step()
        if checkpoint is not None:
            search.checkpoint().save(checkpoint)
        if progress is not None:
            progress(search.progress())
    found = search.result()
    if folder is not None:
        _save_fit(found, folder)
    return found


def _save_fit(fit: FitResult, folder: Path) -> None:
    """Write ``model.toml`` and ``history.json``: why the fit ended, each generation, what gradients did."""
    fit.model.save(folder / "model.toml")
    document = {"stopped": fit.stopped, "generations": fit.history}
    if fit.gradients is not None:
        document |= {"gradients": {"helped": fit.gradients.helped, "remark": fit.gradients.remark}}
    write_json(folder / "history.json", document)


def cut_segments(model: Model, demonstrations: Sequence[Demonstration], cfg: FitCfg) -> list[Segment]:
    """Return whole demonstrations as segments, or windows of them where the settings ask for that.

    Raises:
        RecordingError: Nothing is observed, or no window shows contact.
    """
    assert model.geometry is not None
    bodies = model.geometry.bodies
    if cfg.window is None:
        return [whole_demonstration(model.scene, d, bodies) for d in demonstrations]
    groups = [cut_windows(model.scene, d, bodies, cfg.window, cfg.window_stride) for d in demonstrations]
    if not any(groups):
        raise RecordingError(
            "no window shows contact", expected=f"contact within {cfg.window:g} s", fix="fit longer windows, or without"
        )
    return mark_held_out(groups, cfg.held_out)


def warm_start(
    search: Search,
    method: Method,
    demonstrations: Sequence[Demonstration],
    cfg: GradientCfg,
    checkpoint: Path | None,
    resume: bool,
    progress: Callable[[Progress], None] | None,
) -> None:
    """Begin with gradients, see `fit_geometry`; without help from them nothing changes but the count."""

    def show(iteration: int, lowest: float, left: float) -> None:
        if progress is not None:
            count = cfg.iterations
            progress(Progress(iteration, count, lowest, lowest, left, search.simulations, "gradient step"))

    flat = search.evolution.mean.copy()
    warming = GradientWarmStart(search, demonstrations, cfg)
    file = None if checkpoint is None else checkpoint.with_suffix(".descent.npz")
    search.gradients = found = warming.run(file, resume, show)
    search.evolution.mean = found.mean if found.helped else flat
    if found.helped:
        survey = search.survey([*search.sample_segments(), *search.held_out])
        search.note(survey)
        if method == "gradient":
            search.stopped = "gradient descent done"
            search.history += [search.entry(warming.survey, 0.0), search.entry(survey, 0.0)]
