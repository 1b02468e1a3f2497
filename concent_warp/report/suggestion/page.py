"""The page of a suggested motion: one HTML file with the animation, the commands, and what each hypothesis predicts."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.comparison.units import channel_text
from concent_warp.diagnosis.experiment.suggested import SuggestedMotion, TimeSeries
from concent_warp.diagnosis.suggestion.suggestion import Suggestion
from concent_warp.errors import ConcentError
from concent_warp.files import write_text
from concent_warp.report.motion_data import motion_data
from concent_warp.report.page_data import camera_views
from concent_warp.report.scene_data import packed, scene_bodies
from concent_warp.report.template import filled, options, page_file, script_json
from concent_warp.simulate.select import make_engine
from concent_warp.version import __version__

MOST_SAMPLES = 1500
"""Samples of a line in a chart; longer series are thinned."""
DENSITY = 7870.0
"""Density of the iron ball as which a weight is drawn [kg/m^3]."""
COLOUR = (0.85, 0.55, 0.1, 1.0)
"""Colour of weights."""


def write_motion_page(path: str | Path, suggestion: Suggestion) -> None:
    """Write a page that shows a suggested motion, in one piece or not at all.

    Args:
        path: The ``.html`` file.
        suggestion: What was suggested.

    Raises:
        ConcentError: Nothing was suggested.
    """
    if suggestion.recording is None or not suggestion.found:
        raise ConcentError("there is no motion to show", found=suggestion.sentence)
    model = next(iter(suggestion.models.values()))
    bodies, meshes = scene_bodies(model.scene.model)
    engines, names = {"motion": make_engine("mujoco", model)}, [body["name"] for body in bodies]
    chosen = suggestion.recording.demonstrations
    data = {
        "bodies": [{"name": body["name"], "geoms": body["geoms"]} for body in bodies],
        "meshes": meshes,
        "view": camera_views(model, chosen[0]),
        "motions": [
            {
                "name": f"{k + 1}. {d.task}",
                "duration": d.duration,
                "motion": motion_data({"motion": model}, engines, d, names),
                "commands": _lines(motion),
                "weights": _weights(motion),
            }
            for k, (d, motion) in enumerate(zip(chosen, suggestion.motions, strict=True))
        ],
        "predictions": _predicted(suggestion.predictions),
    }
    unit = next(iter(suggestion.predictions.values())).unit if suggestion.predictions else "-"
    parts = {
        "title": "Suggested motion",
        "subtitle": escape(suggestion.question),
        "verdict": escape(suggestion.sentence),
        "motion_options": options([one["name"] for one in data["motions"]]),
        "table": _table(suggestion),
        "predictions_about": escape(
            f"What each hypothesis, fitted to the data at hand, predicts for {channel_text(suggestion.channel)}"
            f"{'' if unit == '-' else f' [{unit}]'} during the first motion."
        ),
        "footer": escape(f"Written by concent {__version__}."),
        "data": script_json(data),
        "style": page_file("style.css"),
        "script": "\n".join(page_file(name) for name in ("scene3d.js", "charts.js", "motion.js")),
    }
    write_text(Path(path), filled(page_file("motion.html"), parts))


def _lines(motion: SuggestedMotion) -> list[dict[str, Any]]:
    """Return the commands of a motion over time, a line an actuator."""
    found = []
    for name, series in motion.commands.items():
        time = np.append(series.time, motion.duration)
        rows = _thinned(len(time))
        value = np.append(series.value.ravel(), series.value.ravel()[-1:])
        found.append({"name": name, "unit": series.unit, "time": packed(time[rows]), "value": packed(value[rows])})
    return found


def _weights(motion: SuggestedMotion) -> dict[str, list[dict[str, Any]]]:
    """Return the weights of a motion by the name of the body that carries them, each as a ball of iron."""
    found: dict[str, list[dict[str, Any]]] = {}
    for payload in motion.payloads:
        radius = (3 * payload.mass / (4 * np.pi * DENSITY)) ** (1 / 3)
        ball = {"shape": "sphere", "size": [round(float(radius), 5)] * 3, "position": list(payload.position)}
        found.setdefault(payload.body, []).append({**ball, "quaternion": [1, 0, 0, 0], "colour": list(COLOUR)})
    return found


def _predicted(predictions: Mapping[str, TimeSeries]) -> list[dict[str, Any]]:
    """Return the predictions of each hypothesis in the component in which these differ most."""
    if not predictions:
        return []
    stacked = np.stack([series.value.reshape(len(series.time), -1) for series in predictions.values()])
    component = int(np.argmax(np.ptp(stacked, axis=0).max(axis=0)))
    time = next(iter(predictions.values())).time
    rows = _thinned(len(time))
    return [
        {"name": name, "time": packed(time[rows]), "value": packed(stacked[k, rows, component])}
        for k, name in enumerate(predictions)
    ]


def _thinned(count: int) -> np.ndarray:
    """Return the rows of a series that are shown."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_SAMPLES)).astype(int))


def _table(suggestion: Suggestion) -> str:
    """Return the evidence between hypotheses as a table."""
    head = "".join(f"<th>{name}</th>" for name in ("if true", "against", "evidence [nat]", "x noise", "channel", ""))
    rows = "".join(
        f"<tr><td>{escape(p.true)}</td><td>{escape(p.other)}</td><td>{p.evidence:.3g}</td><td>{p.separation:.2g}</td>"
        f"<td>{escape(channel_text(p.channel))}</td><td>{'decided' if p.resolved else 'open'}</td></tr>"
        for p in suggestion.pairs
    )
    used = ", ".join(f"{100 * share:.0f} % of the {escape(name)}" for name, share in suggestion.used.items())
    limits = f'<p class="hint">Needed: {suggestion.needed:.3g} nat. Of its limits the motion uses {used}.</p>'
    return f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>{limits}"
