"""The page of a tracked video: one HTML file with the frames, the outlines in them, and plots in step with them."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from concent_warp.checks import check_settings
from concent_warp.errors import RecordingError
from concent_warp.files import write_text
from concent_warp.perception.tracking.cfg import TrackCfg
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.result import BodyTrack, Tracked
from concent_warp.perception.tracking.video import Video
from concent_warp.recording.recording import Recording
from concent_warp.report.tables import provenance
from concent_warp.report.template import filled, options, page_file, script_json
from concent_warp.report.tracking.cfg import TrackReportCfg
from concent_warp.report.tracking.frames import camera_data, shown_frames
from concent_warp.report.tracking.headline import cards, headline, title, track_table
from concent_warp.report.tracking.series import track_data
from concent_warp.scene.scene import Scene
from concent_warp.version import __version__


def write_track_report(
    path: str | Path,
    recording: Recording,
    tracked: Tracked,
    cfg: TrackReportCfg | None = None,
    *,
    track_cfg: TrackCfg | None = None,
    settings: Mapping[str, Any] | None = None,
) -> None:
    """Write a page that shows a tracked video, in one piece or not at all.

    It has, for each demonstration and camera, the frames with the outlines of the bodies at their smoothed poses, and
    in step with them plots of pose, covariance, residuals and agreement, in which lost stretches are marked.

    Args:
        path: The ``.html`` file.
        recording: The recording that was tracked, with its images.
        tracked: What `track` found in it.
        cfg: Settings.
        track_cfg: Settings of the tracking, where they were not the default ones.
        settings: ``command``, ``versions`` and ``settings`` to show.

    Raises:
        RecordingError: The recording lacks the frames that were tracked.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> try:
        ...     cw.write_track_report("track.html", recording, cw.Tracked(recording, ()))
        ... except cw.RecordingError as error:
        ...     "no tracks" in str(error)
        True
    """
    cfg, track_cfg = cfg or TrackReportCfg(), track_cfg or TrackCfg()
    check_settings(cfg)
    if not tracked.tracks:
        raise RecordingError("there are no tracks to show", where=recording.source)
    scene = Scene(tracked.recording.scene, tracked.recording.source)
    groups = _grouped(tracked)
    names = _shown(groups, cfg.max_demonstrations)
    videos = [_video(recording, name, groups[name], scene, track_cfg) for name in names]
    shapes = {t.body: TrackedShape.of_body(scene, t.body, track_cfg.seed) for t in tracked.tracks}
    renderer = RayRenderer(scene.model)
    demonstrations = []
    for name, video, frames in zip(names, videos, shown_frames(videos, cfg), strict=True):
        own = [shapes[t.body] for t in groups[name]]
        demonstrations.append(
            {
                "name": name,
                "start": float(video.time[0]),
                "end": float(video.time[-1]),
                "cameras": [camera_data(camera, video, groups[name], own, renderer) for camera in frames],
                "bodies": [track_data(t) for t in groups[name]],
            }
        )
    tasks = [recording[name].task for name in groups]
    first = max(names, key=lambda name: _lost(groups[name]))
    data = {"demonstrations": demonstrations, "first": first, "min_agreement": 100 * track_cfg.accept.min_agreement}
    parts = {
        "title": escape(title(tasks)),
        "subtitle": escape(_subtitle(recording, groups)),
        "headline": escape(headline(tracked.tracks)),
        "cards": "\n".join(card.html() for card in cards(tracked.tracks)),
        "demonstration_options": options(names),
        "table": track_table(tracked.tracks),
        "remarks": "".join(f"<p>{escape(remark)}</p>" for remark in (*tracked.remarks, *_sentences(tracked))),
        "provenance": provenance(settings or {}),
        "footer": escape(f"Written by concent {__version__}. {_left_out(groups, names)}"),
        "data": script_json(data),
        "style": page_file("style.css") + page_file("track.css"),
        "script": page_file("charts.js") + page_file("track.js"),
    }
    write_text(Path(path), filled(page_file("track.html"), parts))


def _grouped(tracked: Tracked) -> dict[str, list[BodyTrack]]:
    """Return the tracks by demonstration."""
    found: dict[str, list[BodyTrack]] = {}
    for track in tracked.tracks:
        found.setdefault(track.demonstration, []).append(track)
    return found


def _shown(groups: Mapping[str, list[BodyTrack]], most: int) -> list[str]:
    """Return the demonstrations that are shown, in their order; where there are too many, those lost longest."""
    chosen = sorted(groups, key=lambda name: -_lost(groups[name]))[:most]
    return [name for name in groups if name in chosen]


def _lost(tracks: list[BodyTrack]) -> int:
    """Return in how many frames bodies are lost."""
    return sum(int(t.lost.sum()) for t in tracks)


def _video(recording: Recording, name: str, tracks: list[BodyTrack], scene: Scene, cfg: TrackCfg) -> Video:
    """Return the frames of a demonstration at the moments that were tracked.

    Raises:
        RecordingError: They are not there.
    """
    where = f"{recording.source}, {name}"
    if name not in [d.name for d in recording.demonstrations]:
        raise RecordingError("the recording has no such demonstration", where=where, expected="that which was tracked")
    cameras = tracks[0].cameras
    video = Video.of(scene.model, recording[name], cameras, cfg.simultaneous, where)
    times = tracks[0].time
    if len(video.time) != len(times) or abs(video.time - times).max() > cfg.simultaneous:
        raise RecordingError(
            "the video is not the one that was tracked",
            where=where,
            expected=f"{len(times)} moments from {times[0]:.3f} to {times[-1]:.3f} s",
            found=f"{len(video.time)} moments from {video.time[0]:.3f} to {video.time[-1]:.3f} s",
            fix="give the recording, and the settings, that were tracked",
        )
    return video


def _sentences(tracked: Tracked) -> list[str]:
    """Return the results in words."""
    return [track.sentence() for track in tracked.tracks]


def _subtitle(recording: Recording, groups: Mapping[str, list[BodyTrack]]) -> str:
    """Return what the page is about."""
    seconds = sum(float(tracks[0].time[-1] - tracks[0].time[0]) for tracks in groups.values())
    count = len(groups)
    return f"{count} demonstration{'s' if count != 1 else ''}, {seconds:.1f} s of video, from {recording.source}"


def _left_out(groups: Mapping[str, list[BodyTrack]], shown: list[str]) -> str:
    """Return which demonstrations are not shown."""
    more = len(groups) - len(shown)
    return f"Video and plots show {len(shown)} demonstrations; {more} more are in the table." if more > 0 else ""
