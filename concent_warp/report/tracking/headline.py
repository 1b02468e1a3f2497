"""What the page of a tracked video says first, and its table."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from concent_warp.perception.tracking.result import BRIDGED, FILLED, BodyTrack
from concent_warp.report.headline import Card
from concent_warp.report.tables import Row, table
from concent_warp.report.tracking.spans import StateSpan, lost_spans, quality_of

Loss = tuple[BodyTrack, StateSpan]
"""A stretch in which a body is lost."""


def losses(tracks: Sequence[BodyTrack]) -> list[Loss]:
    """Return all stretches in which bodies are lost, the longest first."""
    found = [(track, span) for track in tracks for span in lost_spans(track)]
    return sorted(found, key=lambda loss: -loss[1].moments)


def title(tasks: Sequence[str]) -> str:
    """Return the title of the page."""
    task = next((task for task in tasks if task), "")
    return "Tracked video" + (f": {task}" if task else "")


def headline(tracks: Sequence[BodyTrack]) -> str:
    """Return the sentences that say what was tracked and where it was lost."""
    bodies = list(dict.fromkeys(t.body for t in tracks))
    demonstrations = list(dict.fromkeys(t.demonstration for t in tracks))
    frames, kept = sum(len(t.time) for t in tracks), sum(int((~t.lost).sum()) for t in tracks)
    states = [state for t in tracks for state in quality_of(t).state]
    what = " and ".join(f"“{b}”" for b in bodies) if len(bodies) < 4 else f"{len(bodies)} bodies"
    where = demonstrations[0] if len(demonstrations) == 1 else f"{len(demonstrations)} demonstrations"
    verb = "was" if len(bodies) == 1 else "were"
    share = f"all {frames}" if kept == frames else f"{kept} of {frames}"
    moments = "frames" if len(bodies) == 1 else "frames, counted for each body"
    text = f"{what} {verb} tracked through {where}: poses in {share} {moments}"
    parts = [(states.count(FILLED), "filled backward"), (states.count(BRIDGED), "bridged over a short gap")]
    text += "".join(f", {count} of them {words}" for count, words in parts if count)
    lost = losses(tracks)
    if not lost:
        return f"{text}. Never lost."
    text += f". Lost in {frames - kept} frames"
    text += f", in {len(lost)} stretches, the longest " if len(lost) > 1 else ", "
    track, span = lost[0]
    text += f"from {span.start:.2f} to {span.end:.2f} s"
    text += f" of {track.demonstration}" if len(demonstrations) > 1 else ""
    text += f" (“{track.body}”)" if len(bodies) > 1 else ""
    return text + (f": {span.reason}." if span.reason else ".")


def cards(tracks: Sequence[BodyTrack]) -> list[Card]:
    """Return the cards of the page."""
    frames, kept = sum(len(t.time) for t in tracks), sum(int((~t.lost).sum()) for t in tracks)
    lost = losses(tracks)
    seconds = sum(span.end - span.start for _, span in lost)
    found = [
        Card("Frames with a pose", f'<span class="{"good" if kept == frames else "bad"}">{kept}</span> of {frames}'),
        Card("Time lost", f"{seconds:.2f} <small>s</small>", _stretches(len(lost))),
    ]
    position, rotation = _stds(tracks)
    if len(position):
        note = f"95 % of frames below {1e3 * np.quantile(position, 0.95):.2f} mm"
        found.append(
            Card("Position: standard deviation, worst axis", f"{1e3 * np.median(position):.2f} <small>mm</small>", note)
        )
        note = f"95 % of frames below {np.degrees(np.quantile(rotation, 0.95)):.2f}°"
        found.append(Card("Rotation: standard deviation, worst axis", f"{np.degrees(np.median(rotation)):.2f} °", note))
    return found


def _stretches(count: int) -> str:
    """Return how many stretches there are."""
    return "never" if count == 0 else "in one stretch" if count == 1 else f"in {count} stretches"


def _stds(tracks: Sequence[BodyTrack]) -> tuple[np.ndarray, np.ndarray]:
    """Return the standard deviations along the worst axis of position [m] and rotation [rad] of all known poses."""
    variance = np.concatenate([np.einsum("tii->ti", t.covariance[~t.lost]) for t in tracks])
    return np.sqrt(variance[:, :3].max(axis=1)), np.sqrt(variance[:, 3:].max(axis=1))


def track_table(tracks: Sequence[BodyTrack]) -> str:
    """Return the table of all tracks as HTML."""
    header = ["demonstration", "body", "frames", "with pose", "filled backward", "bridged", "lost"]
    header += ["std of position [mm]", "std of rotation [°]", "depth residual [mm]", "edge residual [px]"]
    header += ["texture residual [px]", "agreement [%]"]
    rows: list[Row] = []
    for t in tracks:
        quality = quality_of(t)
        position, rotation = _stds([t])
        values = (
            1e3 * _median(position), np.degrees(_median(rotation)), 1e3 * _median(quality.depth_residual),
            _median(quality.edge_residual), _median(quality.texture_residual),
        )  # fmt: skip
        counts = (len(t.time), (~t.lost).sum(), quality.state.count(FILLED), quality.state.count(BRIDGED), t.lost.sum())
        cells = [f"<b>{escape(t.demonstration)}</b>", escape(t.body), *map(str, counts)]
        cells += [f"{value:.2f}" if np.isfinite(value) else "-" for value in values]
        share = 100 * _median(quality.agreement)
        rows.append(("", [*cells, f"{share:.0f}" if np.isfinite(share) else "-"]))
    return table(header, rows, 2)


def _median(values: np.ndarray) -> float:
    """Return the median of the values that are there, NaN where none is."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")
