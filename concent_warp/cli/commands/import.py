"""``concent import``: the log of another system as a recording."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.markup import escape

from concent_warp.cli.options import OptionalOutPath
from concent_warp.cli.terminal import progress_bar, say, say_written, table_width
from concent_warp.errors import RecordingError
from concent_warp.files import write_text
from concent_warp.recording.logs.cfg import BopCfg, ImportCfg, PlausibilityCfg
from concent_warp.recording.logs.episode import ReadChannel
from concent_warp.recording.logs.import_log import import_log, inspect_log
from concent_warp.recording.logs.left_over import to_write
from concent_warp.recording.logs.suggest import GAP, NONE_FOUND, suggest_map
from concent_warp.recording.recording import Recording
from concent_warp.run_folder import claim_file, make_folder

if TYPE_CHECKING:
    from rich.table import Table


LISTED = 8
"""Most sensors that one sentence names."""


@dataclass(frozen=True)
class Arguments:
    """Read LeRobot data sets, MCAP files, ROS bags, tables or folders of images as a recording, with a map of names,
    units and signs: --suggest writes a first map, --dry-run shows and checks what it makes of the log. A scene of a BOP
    data set needs neither model nor map.
    """

    source: tyro.conf.Positional[tuple[Path, ...]]
    """LeRobot v3 data set, .mcap, .bag, folder of a ROS 2 bag, .csv, or folder with color, depth and
    intrinsics.json; several of them, or a folder of them; or a scene of a BOP data set."""
    model: Path | None = None
    """MJCF of the scene: robot and objects with named actuators and sensors."""
    mapping: Annotated[Path | None, tyro.conf.arg(name="map")] = None
    """Map (.toml) from channels of the log to actuators, sensors, bodies and cameras of the scene."""
    out: OptionalOutPath = None
    """Recording file (.h5) to write."""
    episodes: tuple[str, ...] = ()
    """Episodes, such as 0 3-5; all by default."""
    suggest: bool = False
    """Write a map proposed by names to the file of --map, instead of reading it."""
    dry_run: bool = False
    """Show what would be read and all that is wrong, and write nothing."""
    calibration: Path | None = None
    """Intrinsics and poses of the cameras; by default as the map says, else calibration.json beside the log."""
    overwrite: bool = False
    """Replace the recording, or with --suggest the map, if it is there."""
    depth_from: float = ImportCfg.depth_from
    """Distance below which a depth counts as missing [m]."""
    max_pair_delay: float = ImportCfg.max_pair_delay
    """Time between colour and depth of one frame above which they are no pair [s]."""
    plausibility: PlausibilityCfg = field(default_factory=PlausibilityCfg)
    bop: BopCfg = field(default_factory=BopCfg)


def run(arguments: Arguments) -> Recording | None:
    """Suggest a map, show what would be read, or import the log."""
    if arguments.suggest and arguments.dry_run:
        raise RecordingError("--suggest and --dry-run exclude one another", fix="suggest a map first, then check it")
    numbers = episode_numbers(arguments.episodes)
    if arguments.suggest:
        if arguments.model is None or arguments.mapping is None:
            raise RecordingError(
                "--suggest needs a scene and a file for the map", fix="add --model robot.xml --map robot.toml"
            )
        claim_file(arguments.mapping, overwrite=arguments.overwrite)
        text = suggest_map(arguments.source, arguments.model, numbers[0] if numbers else None)
        make_folder(arguments.mapping.parent)
        write_text(arguments.mapping, text)
        gaps = [line.removeprefix(GAP) for line in text.splitlines() if line.startswith(GAP)]
        for gap in gaps:
            say(escape(f"to mend in the MJCF: {gap}"))
        for entry, why in re.findall(rf"^# (\[.*\])  # {NONE_FOUND}: (.*)$", text, re.MULTILINE):
            say(escape(f"no channel for {entry}: {why}"))
        guesses = text.count("# guess") + text.count("# no channel found") + len(gaps)
        say(f"{guesses} guesses or gaps are marked; check them, and all units and signs, with --dry-run")
        say_written(arguments.mapping)
        return None
    cfg = ImportCfg(
        episodes=numbers,
        calibration=None if arguments.calibration is None else str(arguments.calibration),
        depth_from=arguments.depth_from,
        max_pair_delay=arguments.max_pair_delay,
        plausibility=arguments.plausibility,
        bop=arguments.bop,
    )
    if arguments.dry_run:
        _dry_run(arguments, cfg)
        return None
    if arguments.out is None:
        raise RecordingError("no file to write is named", fix="add -o demo.h5, or --dry-run to look first")
    claim_file(arguments.out, overwrite=arguments.overwrite)
    make_folder(arguments.out.parent)
    with progress_bar("importing") as progress:
        recording = import_log(
            arguments.source, arguments.model, cfg, mapping=arguments.mapping, out=arguments.out, progress=progress
        )
    for one in recording.demonstrations:
        kinds = (("commands", one.action), ("sensors", one.measured), ("cameras", one.image))
        counts = ", ".join(f"{len(channels)} {kind}" for kind, channels in kinds if channels)
        say(f"{one.name}: {one.duration:.1f} s, {counts}")
    say_written(arguments.out)
    return recording


def episode_numbers(texts: Sequence[str]) -> tuple[int, ...]:
    """Return the numbers in texts such as ``0`` and ``3-5``.

    Raises:
        RecordingError: A text is neither.
    """
    found: list[int] = []
    for text in texts:
        hit = re.fullmatch(r"(\d{1,7})(?:-(\d{1,7}))?", text)
        if hit is None or int(hit[2] or hit[1]) < int(hit[1]):
            raise RecordingError(
                "not a number of an episode", expected="numbers, or spans such as 3-5", found=repr(text)
            )
        found += range(int(hit[1]), int(hit[2] or hit[1]) + 1)
    return tuple(found)


def _dry_run(arguments: Arguments, cfg: ImportCfg) -> None:
    """Show what would be read of each episode.

    Raises:
        RecordingError: Something is wrong.
    """
    wrong: dict[str, list[str]] = {}
    without: list[str] = []
    episodes = inspect_log(arguments.source, arguments.model, cfg, mapping=arguments.mapping)
    for k, episode in enumerate(episodes):
        name = episode.demonstration.name
        task = f" {episode.demonstration.task!r}" if episode.demonstration.task else ""
        say(f"[bold]{escape(name)}[/bold]{escape(task)}")
        say(_table(episode.channels))
        if k == 0 and episode.unused:
            say(escape(f"not mapped: {', '.join(sorted(episode.unused))}"))
            if episode.left and (episode.channels or episode.cameras):
                say(escape(to_write(episode.left)))
        without = [one for one in episode.unmeasured if k == 0 or one in without]
        for error in episode.problems:
            wrong.setdefault(str(error), []).append(name)
    if len(wrong) == 1:
        raise RecordingError(next(iter(wrong)))
    for k, (sentence, names) in enumerate(wrong.items()):
        say(escape(f"{k + 1}. {names[0]}{', ...' * (len(names) > 1)}: {sentence}"))
    if wrong:
        raise RecordingError(f"{len(wrong)} things are wrong", where=arguments.source[0], fix="see the list above")
    say(f"nothing is wrong{escape(_unmeasured(without))}; leave out --dry-run and add -o demo.h5 to import it")


def _unmeasured(sensors: Sequence[str]) -> str:
    """Return what is to be known of sensors of the scene that have no channel in any episode; empty without any."""
    if not sensors:
        return ""
    more = f" and {len(sensors) - LISTED} more" if len(sensors) > LISTED else ""
    named = ", ".join(map(repr, sensors[:LISTED])) + more
    if len(sensors) == 1:
        return f", but no channel is mapped to sensor {named} of the scene: if the log has it, add it to the map"
    return f", but no channel is mapped to sensors {named} of the scene: add those that the log has to the map"


def _table(channels: Sequence[ReadChannel]) -> Table:
    """Return the table of what is read of an episode."""
    from rich.table import Table

    narrow = table_width() < 110
    table = Table(box=None, pad_edge=False)
    for heading in ("recording", "log", "samples", "Hz", "values", "scene"):
        number = heading in ("samples", "Hz")
        table.add_column(heading, justify="right" if number else "left", overflow="fold", no_wrap=number)
    for one in channels:
        span = "" if one.range is None else f"{one.range[0]:.3g} to {one.range[1]:.3g}"
        source = one.source.replace("observation.", "") if narrow else one.source
        rate = "" if math.isnan(one.rate) else f"{one.rate:.4g}"
        values = "" if math.isnan(one.low) else f"{one.low:.3g} to {one.high:.3g} {one.unit}"
        cells = (one.name, source, str(one.samples), rate, values, f"{span} {one.remark}".strip())
        table.add_row(*map(escape, cells))
    return table
