"""``concent track``: poses of the objects in the RGB-D video of a recording."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.markup import escape

from concent_warp.cli.options import OutPath
from concent_warp.cli.terminal import progress_bar, say, say_written
from concent_warp.errors import ConcentError
from concent_warp.model import Model
from concent_warp.perception.tracking.checkpoint import state_path
from concent_warp.perception.tracking.prompts import written_prompts
from concent_warp.perception.tracking.result import BodyTrack, Tracked
from concent_warp.perception.tracking.track import track
from concent_warp.recording.load import load_recording
from concent_warp.resumable_file import claim_resumable, say_how_to_resume
from concent_warp.run_folder import make_folder


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
    """First poses: initial (the recording's initial state; a search where it has none), none (a search), or a TOML or
    JSON file with position and quaternion of each body."""
    click: tuple[str, ...] = ()
    """Pixels on bodies in the first frame, at which they are searched: BODY=COLUMN,ROW, with @CAMERA where there are
    several."""
    box: tuple[str, ...] = ()
    """Boxes around bodies in the first frame, BODY=LEFT,TOP,RIGHT,BOTTOM, with @CAMERA where there are several."""
    prompts: Path | None = None
    """TOML or JSON file of clicks and boxes, by body, or by demonstration and body."""
    body: tuple[str, ...] = ()
    """Bodies to track; all with a free joint by default."""
    camera: tuple[str, ...] = ()
    """Cameras to use; all with depth by default."""
    demonstrations: tuple[str, ...] = ()
    """Demonstrations; all by default."""
    keep_measured: bool = False
    """Keep measured poses of the objects that are in the recording, rather than replace them."""
    images: bool = False
    """Keep the video in the written recording."""
    json: bool = False
    """Print one JSON object with the figures, in SI units, instead of sentences."""
    resume: bool = False
    """Continue an interrupted tracking; the result is the same as without the interruption."""
    overwrite: bool = False
    """Replace the file if it is there."""


def run(arguments: Arguments) -> Tracked:
    """Track, write, and say what was found."""
    claim_resumable(arguments.out, state_path(arguments.out), overwrite=arguments.overwrite, resume=arguments.resume)
    prompts = _prompts(arguments)
    recording = load_recording(arguments.recording).only(arguments.demonstrations)
    scene = None if arguments.model is None else Model.load(arguments.model).scene
    make_folder(arguments.out.parent)
    with progress_bar("tracking") as progress, say_how_to_resume(state_path(arguments.out)):
        found = track(
            recording,
            bodies=arguments.body or None,
            cameras=arguments.camera,
            pose=arguments.pose,
            scene=scene,
            prompts=prompts,
            keep_measured=arguments.keep_measured,
            images=arguments.images,
            out=arguments.out,
            resume=arguments.resume,
            progress=progress,
        )
    if arguments.json:
        print(json.dumps({"tracks": [_figures(t) for t in found.tracks], "remarks": list(found.remarks)}, indent=1))
        return found
    for line in (*found.remarks, *(t.sentence() for t in found.tracks)):
        say(escape(line))
    say_written(arguments.out)
    return found


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
