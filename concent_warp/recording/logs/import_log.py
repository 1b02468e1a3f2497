"""A log of others as a recording: read, mapped to a scene, checked, and written."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from concent_warp.checks import check_settings
from concent_warp.errors import RecordingError
from concent_warp.limits import limits, raising
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.logs.cfg import ImportCfg
from concent_warp.recording.logs.episode import ReadEpisode, read_episode
from concent_warp.recording.logs.log_map import LogMap, read_map
from concent_warp.recording.logs.readers.calibration import FILE, Calibration, read_calibration
from concent_warp.recording.logs.readers.log import Log
from concent_warp.recording.logs.readers.open_log import open_log
from concent_warp.recording.recording import Recording
from concent_warp.recording.validation.validate import validate
from concent_warp.scene.scene import Scene


def import_log(
    source: Path | str,
    model: Path | str | Scene,
    cfg: ImportCfg | None = None,
    *,
    mapping: Path | str | LogMap,
    out: Path | str | None = None,
    progress: Callable[[float], None] | None = None,
) -> Recording:
    """Read a log of another system as a recording.

    Args:
        source: LeRobot v3 data set, MCAP file, ROS bag, or folder of colour and depth images.
        model: Scene, or MJCF file of it, with named actuators and sensors.
        cfg: Settings.
        mapping: Map of names, units and signs, or a TOML file of it.
        out: Recording file (.h5) to write.
        progress: Called with the share done, 0..1.

    Returns:
        One demonstration per episode, named ``demo_<number>``.

    Raises:
        RecordingError: The log cannot be read, does not fit the map, or contradicts the scene or itself.
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
    log = open_log(source)
    scene = scene_of(model)
    read: list[ReadEpisode] = []
    for share, episode in _read(log, scene, mapping, cfg):
        if episode.problems:
            first, *others = episode.problems
            if others:
                more = f"{len(others) + 1} things are wrong, which concent import --dry-run lists"
                raise RecordingError(f"{str(first).rstrip('.')}; {more}")
            raise first
        read.append(episode)
        if progress is not None:
            progress(0.3 * share)
    _check_size(read, log.source)
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
    recording = Recording(scene.xml, tuple(demonstrations), str(log.source))
    validate(recording)
    if out is not None:
        write_hdf5(recording, out)
    if progress is not None:
        progress(1.0)
    return recording


def inspect_log(
    source: Path | str, model: Path | str | Scene, cfg: ImportCfg | None = None, *, mapping: Path | str | LogMap
) -> Iterator[ReadEpisode]:
    """Yield what each episode of a log would become, with all that is wrong with it; a few images are decoded.

    Arguments are those of `import_log`.

    Raises:
        RecordingError: The log or the map cannot be read at all.
        SceneError: The scene cannot be read.
    """
    for _, episode in _read(open_log(source), scene_of(model), mapping, cfg or ImportCfg()):
        yield episode


def _read(log: Log, scene: Scene, mapping: Path | str | LogMap, cfg: ImportCfg) -> Iterator[tuple[float, ReadEpisode]]:
    """Yield the share of episodes done and each of them, checked."""
    if not isinstance(mapping, LogMap):
        mapping = read_map(Path(mapping))
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
        if not read.problems:
            try:
                validate(Recording(scene.xml, (read.demonstration,), str(log.source)))
            except RecordingError as error:
                read.problems.append(error)
        yield (k + 1) / len(numbers), read


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


def _check_size(read: list[ReadEpisode], source: Path) -> None:
    """Refuse images that do not fit in memory before any is decoded."""
    size = sum(camera.bytes for episode in read for camera in episode.cameras)
    if size > limits().recording_bytes:
        raise RecordingError(
            "the images are too large", where=source,
            expected=f"at most {limits().recording_bytes:,} bytes once decoded", found=f"{size:,}",
            fix=f"import fewer episodes with --episodes; {raising('recording_bytes')}",
        )  # fmt: skip
