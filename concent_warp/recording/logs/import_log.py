"""Logs of others as a recording: read, mapped to a scene, checked, and written."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from concent_warp.checks import check_settings
from concent_warp.errors import RecordingError, printable
from concent_warp.limits import limits, raising
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.logs.bop.import_bop import BopImport, open_bop
from concent_warp.recording.logs.cfg import ImportCfg
from concent_warp.recording.logs.episode import ReadChannel, ReadEpisode, read_episode
from concent_warp.recording.logs.left_over import empty_map
from concent_warp.recording.logs.log_map import LogMap, read_map
from concent_warp.recording.logs.readers.calibration import FILE, Calibration, read_calibration
from concent_warp.recording.logs.readers.kinds import log_kind, log_sources
from concent_warp.recording.logs.readers.log import Log
from concent_warp.recording.logs.readers.open_log import open_log
from concent_warp.recording.logs.scene_gaps import nothing_measured, scene_gaps
from concent_warp.recording.naming import PREFIX
from concent_warp.recording.recording import Recording
from concent_warp.recording.unwind import unwound
from concent_warp.recording.validation.validate import validate
from concent_warp.scene.scene import Scene

Given = TypeVar("Given")
Source = Path | str | Sequence[Path | str]
"""A log, a folder of logs, or several of them."""


def import_log(
    source: Source,
    model: Path | str | Scene | None = None,
    cfg: ImportCfg | None = None,
    *,
    mapping: Path | str | LogMap | None = None,
    out: Path | str | None = None,
    progress: Callable[[float], None] | None = None,
) -> Recording:
    """Read logs of another system as a recording.

    Args:
        source: LeRobot v3 data set, MCAP file, ROS bag, table (.csv), or folder of colour and depth images; several of
            them, or a folder of them; or one scene of a BOP data set, which needs neither model nor mapping.
        model: Scene, or MJCF file of it, with named actuators and sensors.
        cfg: Settings.
        mapping: Map of names, units and signs, or a TOML file of it.
        out: Recording file (.h5) to write.
        progress: Called with the share done, 0..1.

    Returns:
        One demonstration per episode, named ``demo_<number>``; numbered from 0 through all logs where there are
        several.

    Raises:
        RecordingError: A log cannot be read, does not fit the map, or contradicts the scene or itself.
        SceneError: The scene cannot be read.

    Example:
        >>> import concent_warp as cw
        >>> try:
        ...     cw.import_log("nowhere.mcap", model="robot.xml", mapping="robot.toml")
        ... except cw.RecordingError as error:
        ...     str(error).startswith("nowhere.mcap: no such log")
        True
    """
    cfg = cfg or ImportCfg()
    check_settings(cfg, RecordingError)
    sources = log_sources(source, _parts(_map_of(mapping)))
    if (bop := _bop_of(sources, model, mapping, cfg)) is not None:
        recording = bop.recording(None if progress is None else lambda share: progress(0.9 * share))
    else:
        recording = _mapped(sources, model, mapping, cfg, progress)
    validate(recording)
    recording = unwound(recording)
    if out is not None:
        write_hdf5(recording, out)
    if progress is not None:
        progress(1.0)
    return recording


def inspect_log(
    source: Source,
    model: Path | str | Scene | None = None,
    cfg: ImportCfg | None = None,
    *,
    mapping: Path | str | LogMap | None = None,
) -> Iterator[ReadEpisode]:
    """Yield what each episode of the logs would become, with all that is wrong with it; a few images are decoded.

    Arguments are those of `import_log`.

    Raises:
        RecordingError: A log or the map cannot be read at all.
        SceneError: The scene cannot be read.
    """
    cfg = cfg or ImportCfg()
    check_settings(cfg, RecordingError)
    sources = log_sources(source, _parts(_map_of(mapping)))
    if (bop := _bop_of(sources, model, mapping, cfg)) is not None:
        yield _inspected(bop, cfg)
        return
    for _, episode in _read(sources, model, mapping, cfg)[1]:
        yield episode


def _map_of(mapping: Path | str | LogMap | None) -> LogMap | None:
    """Return a map, read if it is a file that is there; one that is not there is refused where it is needed."""
    if mapping is None or isinstance(mapping, LogMap):
        return mapping
    return read_map(Path(mapping), empty=True) if Path(mapping).exists() else None


def _parts(mapping: LogMap | None) -> frozenset[str]:
    """Return what the sources of a map begin with, which may be names of tables, one for each body."""
    if mapping is None:
        return frozenset()
    numbers = [one for entry in (*mapping.action.values(), *mapping.measured.values()) for one in entry.source]
    return frozenset(one.partition("/")[0] for one in (*numbers, *(entry.source for entry in mapping.body.values())))


def _mapped(
    sources: Sequence[Path],
    model: Path | str | Scene | None,
    mapping: Path | str | LogMap | None,
    cfg: ImportCfg,
    progress: Callable[[float], None] | None,
) -> Recording:
    """Return the recording of logs that a map ties to a scene."""
    scene, episodes = _read(sources, model, mapping, cfg)
    read: list[ReadEpisode] = []
    for share, episode in episodes:
        if episode.problems:
            first, *others = episode.problems
            if others:
                more = f"{len(others) + 1} things are wrong, which concent import --dry-run lists"
                raise RecordingError(f"{str(first).rstrip('.')}; {more}")
            raise first
        if episode.behind:
            listed = ", ".join(f"{count} of {label}" for label, count in episode.behind.items())
            name = episode.demonstration.name
            warnings.warn(
                printable(f"{name}: samples out of order were sorted by their stamps: {listed}"), stacklevel=3
            )
        read.append(episode)
        if progress is not None:
            progress(0.3 * share)
    named = str(sources[0]) + (f" and {len(sources) - 1} more" if len(sources) > 1 else "")
    _check_size(read, named)
    total = sum(len(camera.time) for episode in read for camera in episode.cameras)
    before = 0
    demonstrations = []
    for episode in read:
        done: dict[str, int] = {}

        def tick(camera: str, count: int, done: dict[str, int] = done, before: int = before) -> None:
            done[camera] = count
            if progress is not None:
                progress(0.3 + 0.6 * (before + sum(done.values())) / max(total, 1))

        demonstrations.append(episode.with_images(tick))
        before += sum(len(camera.time) for camera in episode.cameras)
    return Recording(scene.xml, tuple(demonstrations), named)


def _read(
    sources: Sequence[Path], model: Path | str | Scene | None, mapping: Path | str | LogMap | None, cfg: ImportCfg
) -> tuple[Scene, Iterator[tuple[float, ReadEpisode]]]:
    """Return the scene, and an iterator over the share of episodes done and each of them, checked."""
    parts = _parts(_map_of(mapping))
    logs = [open_log(source, parts) for source in sources]
    scene = scene_of(_needed(model, "scene", "--model robot.xml"))
    mapping = _needed(mapping, "map", "--map robot.toml, which --suggest writes")
    mapping = mapping if isinstance(mapping, LogMap) else read_map(Path(mapping), empty=True)
    if len(logs) > 1 and cfg.episodes:
        raise RecordingError("episodes are of one log", found=f"{len(logs)} logs", fix="import the logs one by one")
    return scene, _counted(logs, scene, mapping, cfg)


def _counted(logs: Sequence[Log], scene: Scene, mapping: LogMap, cfg: ImportCfg) -> Iterator[tuple[float, ReadEpisode]]:
    """Yield the share done and each episode; those of several logs are numbered from 0."""
    count = 0
    for k, log in enumerate(logs):
        for share, episode in _episodes(log, scene, mapping, cfg):
            if len(logs) > 1:
                episode = replace(episode, demonstration=replace(episode.demonstration, name=f"{PREFIX}{count}"))
            count += 1
            yield (k + share) / len(logs), episode


def _episodes(log: Log, scene: Scene, mapping: LogMap, cfg: ImportCfg) -> Iterator[tuple[float, ReadEpisode]]:
    """Yield the share of the episodes of a log done and each of them, checked."""
    file = _calibration(log, mapping, cfg)
    numbers = list(cfg.episodes) or list(log.numbers)
    if unknown := sorted(set(numbers) - set(log.numbers)):
        known = list(log.numbers)
        expected = f"some of {known}" if len(known) < 12 else f"some of {known[0]} to {known[-1]}"
        raise RecordingError("no such episode", where=log.source, expected=expected, found=unknown)
    if not numbers:
        raise RecordingError("the log has no episodes", where=log.source)
    for k, number in enumerate(dict.fromkeys(numbers)):
        read = read_episode(log.episode(number), mapping, scene.model, file, cfg)
        if not (mapping.action or mapping.measured or mapping.body or mapping.image):
            gaps = [RecordingError(one, where=mapping.source) for one in scene_gaps(scene)]
            read.problems[:] = [empty_map(mapping.source, read.left, read.unused), *gaps]
        elif not (mapping.measured or mapping.body or mapping.image):
            fix = nothing_measured(scene)
            read.problems.append(RecordingError("the map names no measurement", where=mapping.source, fix=fix))
        if not read.problems:
            try:
                validate(Recording(scene.xml, (read.demonstration,), str(log.source)))
            except RecordingError as error:
                read.problems.append(error)
        yield (k + 1) / len(numbers), read


def _needed(given: Given | None, what: str, fix: str) -> Given:
    """Return what is given, or refuse that it is missing."""
    if given is None:
        raise RecordingError(f"a log needs a {what}", fix=f"add {fix}")
    return given


def _bop_of(
    sources: Sequence[Path], model: Path | str | Scene | None, mapping: Path | str | LogMap | None, cfg: ImportCfg
) -> BopImport | None:
    """Return the scene of a BOP data set that is to be imported, None where there is another log."""
    scenes = [source for source in sources if source.exists() and log_kind(source) == "bop"]
    if not scenes:
        return None
    if len(sources) > 1:
        fix = "import the scenes one by one: each has objects of its own"
        raise RecordingError("a scene of a BOP data set among other logs", where=scenes[0], fix=fix)
    if model is not None or mapping is not None or cfg.episodes:
        raise RecordingError(
            "a scene of a BOP data set needs neither model, map nor episodes", where=scenes[0], fix="leave them out"
        )
    return open_bop(scenes[0], cfg)


def _inspected(bop: BopImport, cfg: ImportCfg) -> ReadEpisode:
    """Return what a scene of a BOP data set becomes; a few images are decoded."""
    count = len(bop.numbers)
    rows = np.unique(np.linspace(0, count - 1, min(cfg.checked_frames, count)).round().astype(int))
    stream = bop.stream(rows.tolist())
    depths = stream.depth[stream.depth > 0]
    problems = [] if depths.size else [RecordingError("every depth is missing", where=bop.bop.folder)]
    low, high = (float(depths.min()), float(depths.max())) if depths.size else (float("nan"), float("nan"))
    height, width = bop.size
    lines = [
        ReadChannel(
            f"measured/{name}", "scene_gt.json", len(one.time), cfg.bop.rate, float(one.value.min()),
            float(one.value.max()), "m" if one.value.shape[1] == 3 else "",
        )
        for name, one in bop.demonstration.measured.items()
    ]  # fmt: skip
    first = bop.bop.images[bop.numbers[0]]
    source = f"{first.color.parent.name}, {first.depth.parent.name}"
    lines += [ReadChannel("image/camera", source, count, cfg.bop.rate, low, high, "m", None, f"{width} x {height}")]
    return ReadEpisode(bop.demonstration, 0.0, lines, [], problems)


def scene_of(model: Path | str | Scene) -> Scene:
    """Return a scene, or that of an MJCF file."""
    if isinstance(model, Scene):
        return model
    if Path(model).suffix == ".toml":
        fix = "give the MJCF that it was made of"
        raise RecordingError("a log is mapped to a scene", where=model, expected="an MJCF .xml", fix=fix)
    return Scene.from_mjcf(Path(model))


def _calibration(log: Log, mapping: LogMap, cfg: ImportCfg) -> dict[str, Calibration]:
    """Return the cameras of the calibration file that settings or map name, or that lies beside the log."""
    stated = Path(cfg.calibration) if cfg.calibration is not None else mapping.calibration
    if stated is not None:
        return read_calibration(stated)
    folder = log.source if log.source.is_dir() else log.source.parent
    path = next((one for one in (folder / FILE, folder / "meta" / FILE) if one.is_file()), None)
    return {} if path is None else read_calibration(path)


def _check_size(read: list[ReadEpisode], source: str) -> None:
    """Refuse images that do not fit in memory before any is decoded."""
    size = sum(camera.bytes for episode in read for camera in episode.cameras)
    if size > limits().recording_bytes:
        raise RecordingError(
            "the images are too large", where=source,
            expected=f"at most {limits().recording_bytes:,} bytes once decoded", found=f"{size:,}",
            fix=f"import fewer episodes with --episodes; {raising('recording_bytes')}",
        )  # fmt: skip
