"""Contact event sequences of all demonstrations of a recording, and the files that they are saved to."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from concent_warp.events.cfg import StagingCfg
from concent_warp.events.extract import extract
from concent_warp.events.schedule import plot_schedule
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.files import all_or_none
from concent_warp.model import Model, check_inputs
from concent_warp.recording.recording import Recording
from concent_warp.simulate.select import EngineName, make_engine


def extract_events(
    model: Model,
    recording: Recording,
    cfg: StagingCfg | None = None,
    *,
    engine: EngineName = "mujoco",
    out: str | Path | None = None,
    progress: Callable[[float], None] | None = None,
) -> dict[str, ContactEventSequence]:
    """Return the contact event sequence of each demonstration, read off its replay (paper, section 3.1.2).

    Args:
        model: The grounded model.
        recording: What was commanded and measured.
        cfg: Settings of the staging.
        engine: "mujoco", "warp", or "auto" for MuJoCo-Warp where there is a CUDA device; one replay is fastest in C
            MuJoCo.
        out: Folder for ``events_<demonstration>.json`` and ``schedule_<demonstration>.png``; those of a single
            demonstration are ``events.json`` and ``schedule.png``.
        progress: Called with the share done, 0..1.

    Raises:
        ModelError: The model is of another robot than the recording.
        RecordingError: The recording contradicts itself or its scene.
        EventsError: The replay does not stay finite, or the model has no objects.
        EngineError: The model cannot be simulated.

    Example:
        >>> import concent_warp as cw
        >>> run = cw.load_policy("shape_sorter").run
        >>> events = cw.extract_events(run.model, run.recording)["demo_0"]
        >>> [stage.name for stage in events.stages]
        ['pick', 'align', 'insert']
    """
    check_inputs(model, recording)
    found = events_of(model, recording, cfg, engine=engine, progress=progress)
    if out is not None:
        folder = Path(out)
        folder.mkdir(parents=True, exist_ok=True)
        save_events(found, folder)
    return found


def events_of(
    model: Model,
    recording: Recording,
    cfg: StagingCfg | None = None,
    *,
    engine: EngineName = "mujoco",
    progress: Callable[[float], None] | None = None,
) -> dict[str, ContactEventSequence]:
    """Return the same as `extract_events` of a recording that was checked, whatever its initial states became since."""
    simulator = make_engine(engine, model)
    found = {}
    for k, d in enumerate(recording.demonstrations):
        found[d.name] = extract(model, d, simulator, cfg)
        if progress is not None:
            progress((k + 1) / len(recording.demonstrations))
    return found


def event_paths(names: Sequence[str], folder: Path, *, plain_name: bool = True) -> list[tuple[Path, Path]]:
    """Return the paths of the event file and the schedule plot of each demonstration.

    They are ``events_<demonstration>.json`` and ``schedule_<demonstration>.png``; with `plain_name`, those of a single
    demonstration are ``events.json`` and ``schedule.png``.
    """
    short = plain_name and len(names) == 1
    suffixes = ["" if short else f"_{name.replace('/', '_')}" for name in names]
    return [(folder / f"events{suffix}.json", folder / f"schedule{suffix}.png") for suffix in suffixes]


def save_events(events: Mapping[str, ContactEventSequence], folder: Path, *, plain_name: bool = True) -> list[Path]:
    """Write the event file and the schedule plot of each demonstration, all or none, and return all paths."""
    paths = event_paths(list(events), folder, plain_name=plain_name)
    with all_or_none():
        for sequence, (file, plot) in zip(events.values(), paths, strict=True):
            sequence.save(file)
            plot_schedule(sequence, plot)
    return [path for pair_of in paths for path in pair_of]
