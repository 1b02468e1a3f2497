"""``concent track``: poses of the objects in the RGB-D video of a recording."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.markup import escape

from concent_warp.checks import check_device
from concent_warp.cli.options import DeviceOption, OutPath
from concent_warp.cli.terminal import progress_bar, say, say_written
from concent_warp.errors import ConcentError
from concent_warp.model import Model
from concent_warp.perception.backends.named import (
    MaskerName,
    PointTrackerName,
    named_masker,
    named_point_tracker,
)
from concent_warp.perception.tracking.cfg import AcceptCfg, TrackCfg
from concent_warp.perception.tracking.checkpoint import state_path
from concent_warp.perception.tracking.moment import TrackedMoment
from concent_warp.perception.tracking.prompts import written_prompts
from concent_warp.perception.tracking.result import BodyTrack, Tracked
from concent_warp.perception.tracking.track import track
from concent_warp.recording.load import load_recording
from concent_warp.report.tracking.cfg import LiveTrackCfg, TrackReportCfg
from concent_warp.resumable_file import claim_resumable, say_how_to_resume
from concent_warp.run_folder import claim_file, command_line, make_folder, plain, versions


@dataclass(frozen=True)
class Arguments:
    """Track the movable objects in the RGB-D video of a recording: poses with covariances, and point tracks, written
    as a recording that fit and diagnosis read. Measured poses of objects in the recording are not used.
    """

    recording: tyro.conf.Positional[Path]
    """Recording with images and depth."""
    out: OutPath = Path("tracked.h5")
    """Recording to write."""
    model: Path | None = None
    """Model (.toml) or MJCF (.xml) whose scene is used; the recording's own by default."""
    pose: str = "initial"
    """First poses: initial (of the recording, else a search), none (a search), or a TOML or JSON file of them."""
    click: tuple[str, ...] = ()
    """Pixels on bodies in the first frame: BODY=COLUMN,ROW, with @CAMERA where there are several."""
    box: tuple[str, ...] = ()
    """Boxes around bodies instead: BODY=LEFT,TOP,RIGHT,BOTTOM."""
    prompts: Path | None = None
    """TOML or JSON file of clicks and boxes, by body, or by demonstration and body."""
    body: tuple[str, ...] = ()
    """Bodies to track; all with a free joint by default."""
    camera: tuple[str, ...] = ()
    """Cameras to use; all with depth by default."""
    demonstrations: tuple[str, ...] = ()
    """Demonstrations; all by default."""
    masker: MaskerName = "none"
    """Masks of the bodies: depth (what stands out from robot and static scene) or sam2 (with --masker-weights)."""
    masker_weights: Path | None = None
    """Folder with a checkpoint of SAM 2 in the format of transformers."""
    points: PointTrackerName = "none"
    """Points that give the poses between keyframes: flow (optical flow), features (XFeat) or tapir (with
    --points-checkout and --points-weights)."""
    points_checkout: Path | None = None
    """Folder with a checkout of github.com/google-deepmind/tapnet, whose code is run."""
    points_weights: Path | None = None
    """Checkpoint of TAPIR for torch."""
    device: DeviceOption = None
    unknown_surroundings: bool = False
    """Accept poses whatever is beside the object: for objects on a table, or among others, that the scene lacks."""
    keep_measured: bool = False
    """Keep measured poses of the objects that are in the recording, rather than replace them."""
    images: bool = False
    """Keep the video in the written recording."""
    report: Path | None = None
    """Page (.html) to write: the video with outlines of the tracked bodies, and plots."""
    live: bool = False
    """While it is tracked, show the newest frame and the states so far in the browser."""
    json: bool = False
    """Print one JSON object with the figures, in SI units, instead of sentences."""
    resume: bool = False
    """Continue an interrupted tracking; the result is the same as without the interruption."""
    overwrite: bool = False
    """Replace files that are there."""
    page: TrackReportCfg = field(default_factory=TrackReportCfg)
    view: LiveTrackCfg = field(default_factory=LiveTrackCfg)


def run(arguments: Arguments) -> Tracked:
    """Track, write, and say what was found."""
    if arguments.report is not None and arguments.report.resolve() == arguments.out.resolve():
        raise ConcentError("recording and page have the same name", where=arguments.out, fix="name them differently")
    claim_resumable(arguments.out, state_path(arguments.out), overwrite=arguments.overwrite, resume=arguments.resume)
    if arguments.report is not None:
        claim_file(arguments.report, overwrite=arguments.overwrite)
    prompts = _prompts(arguments)
    check_device(arguments.device)
    masker = named_masker(arguments.masker, arguments.masker_weights, arguments.device)
    points = named_point_tracker(
        arguments.points, arguments.points_checkout, arguments.points_weights, arguments.device
    )
    recording = load_recording(arguments.recording).only(arguments.demonstrations)
    scene = None if arguments.model is None else Model.load(arguments.model).scene
    accept = AcceptCfg(max_unexplained=1.0) if arguments.unknown_surroundings else AcceptCfg()
    make_folder(arguments.out.parent)
    with (
        _live_view(arguments) as watch,
        progress_bar("tracking") as progress,
        say_how_to_resume(state_path(arguments.out)),
    ):
        found = track(
            recording,
            TrackCfg(accept=accept),
            bodies=arguments.body or None,
            cameras=arguments.camera,
            pose=arguments.pose,
            scene=scene,
            masker=masker,
            points=points,
            prompts=prompts,
            keep_measured=arguments.keep_measured,
            images=arguments.images,
            out=arguments.out,
            resume=arguments.resume,
            progress=progress,
            watch=watch,
        )
        if arguments.report is not None:
            from concent_warp.report.tracking.report import write_track_report

            settings = {"command": command_line(), "versions": versions(), "settings": plain(arguments)}
            make_folder(arguments.report.parent)
            write_track_report(arguments.report, recording, found, arguments.page, settings=settings)
    if arguments.json:
        print(json.dumps({"tracks": [_figures(t) for t in found.tracks], "remarks": list(found.remarks)}, indent=1))
        return found
    for line in (*found.remarks, *(t.sentence() for t in found.tracks)):
        say(escape(line))
    say_written(arguments.out, *([] if arguments.report is None else [arguments.report]))
    return found


@contextmanager
def _live_view(arguments: Arguments) -> Iterator[Callable[[TrackedMoment], None] | None]:
    """Give what shows each moment in the browser, None where that is not asked for."""
    if not arguments.live:
        yield None
        return
    from concent_warp.report.tracking.live import LiveTrackView

    view = LiveTrackView(arguments.view)
    sentence = f"{view.address} shows the tracking until it ends"
    if arguments.json:
        print(sentence, file=sys.stderr)
    else:
        say(sentence)
    try:
        yield view.show
    finally:
        view.stop()


def _prompts(arguments: Arguments) -> Mapping[str, Any] | Path | None:
    """Return the clicks and boxes, or the file of them."""
    written = written_prompts(arguments.click, arguments.box)
    if written and arguments.prompts is not None:
        raise ConcentError("--prompts cannot be given with --click or --box", fix="write all of them into the file")
    return written or arguments.prompts


def _figures(track: BodyTrack) -> dict[str, object]:
    """Return the figures of one track."""
    kept = ~track.lost
    std = np.sqrt(np.einsum("tii->ti", track.covariance[kept]))
    return {
        "demonstration": track.demonstration,
        "body": track.body,
        "frames": len(kept),
        "frames_lost": int((~kept).sum()),
        "position_std": float(np.median(std[:, :3].max(axis=1))) if kept.any() else None,
        "rotation_std": float(np.median(std[:, 3:].max(axis=1))) if kept.any() else None,
        "symmetry": track.symmetry,
        "textured": bool(track.textured),
        "reason": track.reason,
    }
