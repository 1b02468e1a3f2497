"""The main job: from a recording to a grounded simulation (paper, section 3.1), with all that shows how good it is.

Fit the contact geometry, replay, extract the contact event sequence, compare with what was measured, write the report.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from concent_warp.checks import PositiveDuration, check_settings
from concent_warp.comparison.compare import compare_replays
from concent_warp.comparison.no_contact import without_object_contact
from concent_warp.comparison.result import Comparison
from concent_warp.events.extract_events import extract_events, save_events
from concent_warp.events.overlap import Frames, debounce_frames, iou, resample, sequence_frames, sorted_pair, time_grid
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.files import write_json
from concent_warp.fit.fit_geometry import FitCfg, Method, fit_geometry
from concent_warp.fit.geometry.search import FitResult, Progress
from concent_warp.model import Model
from concent_warp.report.report import write_report
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.simulate.select import EngineName

if TYPE_CHECKING:
    from concent_warp.recording.recording import Recording

BEFORE, NULL, AFTER = "before", "no contact", "after"
"""Names of the models that are compared: the starting geometry, the null model, the fitted geometry."""


@dataclass(frozen=True)
class GroundCfg:
    """Settings of the main job.

    Example:
        >>> import concent_warp as cw
        >>> cw.GroundCfg(fit=cw.FitCfg(generations=30), method="gradient+es").method
        'gradient+es'
    """

    geometry: ContactGeometryCfg = field(default_factory=ContactGeometryCfg)
    """The starting geometry."""
    fit: FitCfg = field(default_factory=FitCfg)
    """Settings of the fit."""
    demonstrations: tuple[str, ...] = ()
    """Demonstrations to fit; all where empty. The comparison is about all in any case."""
    method: Method = "es"
    """How the fit searches: evolution strategy, gradients through Newton, or the latter as a start for the former."""
    overlap_frame: PositiveDuration = 0.01
    """Length of the frames in which contact is compared with the truth [s]: shorter than contacts that count, see
    `StagingCfg.min_contact_duration`."""


@dataclass(frozen=True)
class Grounded:
    """What the main job found.

    Example:
        >>> import concent_warp as cw
        >>> cw.Grounded.__name__  # see `ground`
        'Grounded'
    """

    fit: FitResult
    comparison: Comparison
    """Of the models named `BEFORE`, `NULL` (where there are two objects) and `AFTER`."""
    events: dict[str, ContactEventSequence]
    """By demonstration, of the fitted model."""
    overlap: dict[str, dict[str, float]]
    """Overlap (IoU) of the frames in which objects touch one another with the truth, by model and demonstration."""
    fitted: tuple[str, ...]
    """Demonstrations that the fit has seen."""


def ground(
    recording: Recording,
    out: str | Path,
    cfg: GroundCfg | None = None,
    *,
    start: Model | None = None,
    truth: Mapping[str, tuple[np.ndarray, Frames]] | None = None,
    settings: Mapping[str, Any] | None = None,
    engine: EngineName = "auto",
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> Grounded:
    """Run the main job on a recording: fit, contact events, comparison, report.

    Files: ``start.toml`` and ``model.toml`` with what belongs to them, ``checkpoint.npz``, ``history.json``,
    ``events_<demonstration>.json`` and ``schedule_<demonstration>.png``, ``comparison.json``, ``report.html``.

    Args:
        recording: What was commanded and measured.
        out: Folder for the results.
        cfg: Settings.
        start: Model to start from; by default spheres are laid on the objects of the recording's scene.
        truth: When pairs of bodies really touched, with the times [s] (T,) of these frames, by demonstration, where it
            is known.
        settings: What the report shows as settings.
        engine: Engine of the fit: "mujoco", "warp", or "auto" for MuJoCo-Warp where there is a CUDA device.
        resume: Continue from the folder's checkpoint.
        progress: Called after each generation of the fit.

    Raises:
        RecordingError: There is no such demonstration, or it cannot be replayed.
        ConcentError: The model cannot be built, simulated or fitted.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_policy("shape_sorter").run.recording
        >>> cfg = cw.GroundCfg(geometry=cw.ContactGeometryCfg(count=64), fit=cw.FitCfg(generations=1))
        >>> result = cw.ground(recording, "grounded", cfg, engine="mujoco")
        >>> result.comparison.after
        'after'
    """
    cfg, folder = cfg or GroundCfg(), Path(out)
    check_settings(cfg)
    fitted = tuple(d.name for d in recording.only(cfg.demonstrations).demonstrations)
    fit = fit_geometry(
        Model.from_recording(recording) if start is None else start,
        recording,
        cfg.fit,
        start=cfg.geometry,
        demonstrations=fitted,
        method=cfg.method,
        engine=engine,
        out=folder,
        resume=resume,
        progress=progress,
    )
    start = fit.start
    models = {BEFORE: start, NULL: without_object_contact(fit.model), AFTER: fit.model}
    models = {name: model for name, model in models.items() if model is not None}
    events = extract_events(fit.model, recording)
    save_events(events, folder, plain_name=False)
    stages = {name: sequence.stages for name, sequence in events.items()}
    comparison = compare_replays(models, recording, "mujoco", phases=stages)
    overlap = {}
    if truth is not None:
        overlap = {
            BEFORE: contact_overlap(extract_events(start, recording), truth, start.scene.objects(), cfg.overlap_frame),
            AFTER: contact_overlap(events, truth, start.scene.objects(), cfg.overlap_frame),
        }
    document = comparison.to_json()
    write_json(folder / "comparison.json", {**document, "fitted": list(fitted), "contact_overlap": overlap})
    write_report(
        folder / "report.html",
        recording,
        comparison,
        events=events,
        fit=fit,
        fitted=fitted,
        overlap=overlap,
        settings=settings,
    )
    return Grounded(fit, comparison, events, overlap, fitted)


def contact_overlap(
    events: Mapping[str, ContactEventSequence],
    truth: Mapping[str, tuple[np.ndarray, Frames]],
    objects: Sequence[str],
    frame: float = GroundCfg.overlap_frame,
) -> dict[str, float]:
    """Return the overlap (IoU) of the frames in which objects touch one another with the truth, by demonstration.

    Args:
        events: Contact event sequences by demonstration.
        truth: Times [s] and contacts in frames by demonstration.
        objects: Names of the objects.
        frame: Length of the frames that are compared [s].
    """
    pairs = [sorted_pair(a, b) for a, b in combinations(objects, 2)]
    found = {}
    for name, sequence in events.items():
        if name in truth and pairs:
            time, frames = truth[name]
            grid = time_grid(sequence.duration, frame)
            real = debounce_frames(resample(frames, time, grid), frame, sequence.settings)
            found[name] = iou(sequence_frames(sequence, grid), real, pairs).pooled
    return found
