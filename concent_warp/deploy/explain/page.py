"""The page of an explanation: the report of its trials, led by their causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.comparison.compare import compare_replays
from concent_warp.deploy.explain.result import Explanation, TrialExplanation
from concent_warp.recording.recording import Recording
from concent_warp.report.cfg import ReportCfg
from concent_warp.report.report import write_report
from concent_warp.train.policy.load import Policy

WIDTH, HEIGHT = 260, 60
"""Size of a chart of errors [px]."""


def write_explanation(
    path: str | Path,
    policy: Policy,
    recordings: Recording | Sequence[Recording],
    explanation: Explanation,
    cfg: ReportCfg | None = None,
    *,
    settings: Mapping[str, Any] | None = None,
) -> None:
    """Write a page that shows why trials failed, in one piece or not at all.

    It has the causes with their evidence, the moment when model and measurement part, and the replay of each trial in
    the policy's model beside the measured motion; with a missing effect also in the model that has it.

    Args:
        path: The ``.html`` file.
        policy: The policy that acted.
        recordings: Its trials, as given to `explain`.
        explanation: Why they failed.
        cfg: Settings of the report.
        settings: ``command``, ``versions`` and ``settings`` to show.

    Example:
        >>> import concent_warp as cw
        >>> policy = cw.load_policy("shape_sorter")
        >>> result = cw.evaluate(policy, cw.EvaluateCfg(action_scale=0.05), episodes=1, record="slow")
        >>> trials, slow = cw.load_recording(result.recorded), policy.scaled(0.05)
        >>> explanation = cw.explain(slow, trials, cw.ExplainCfg(simulated=4, diagnose=False))
        >>> cw.write_explanation("explanation.html", slow, trials, explanation)
    """
    given = [recordings] if isinstance(recordings, Recording) else list(recordings)
    chosen, names = _trials(given, explanation)
    diagnosis, model = explanation.diagnosis, policy.run.model
    models = {"model": model}
    if diagnosis is not None and explanation.cause == "physics" and diagnosis.accepted:
        models = {"model": model, "with the effect": replace(model, effects=diagnosis.model.effects)}
    comparison = compare_replays(models, chosen)
    write_report(
        path,
        chosen,
        comparison,
        cfg or ReportCfg(),
        settings=settings,
        diagnosis=diagnosis,
        first_section=_section(explanation, names),
    )


def _trials(recordings: Sequence[Recording], explanation: Explanation) -> tuple[Recording, list[str]]:
    """Return the trials as one recording, each from the start that it was replayed from, and their names in it."""
    found = []
    for trial in explanation.trials:
        recording = next(r for r in recordings if r.source == trial.source)
        demonstration = recording[trial.name]
        name = trial.name if len(recordings) == 1 else f"demo_{len(found)}"
        found.append(
            replace(demonstration, name=name, qpos=trial.start, qvel=np.zeros(_velocities(recording)), policy=None)
        )
    first = recordings[0]
    source = ", ".join(dict.fromkeys(r.source for r in recordings))
    return Recording(first.scene, tuple(found), source), [d.name for d in found]


def _velocities(recording: Recording) -> int:
    """Return the number of velocities of a recording's scene."""
    from concent_warp.scene.scene import Scene

    return int(Scene(recording.scene, recording.source).model.nv)


def _section(explanation: Explanation, names: Sequence[str]) -> str:
    """Return the section with the causes."""
    said = "".join(f"<li>{escape(sentence)}</li>" for sentence in explanation.sentences())
    rows = "".join(_row(trial, name) for trial, name in zip(explanation.trials, names, strict=True))
    numbers = "".join(
        f"<tr><th>{escape(name)}</th><td class='number'>{_number(value)}</td></tr>"
        for name, value in explanation.evidence.items()
    )
    commands = escape("\n".join(explanation.remedy))
    return (
        "<section id='explanation'><h2>Why the trials failed</h2>"
        f"<p><b>{escape(_capital(explanation.headline))}.</b></p><ul>{said}</ul>"
        "<h3>Trial by trial</h3>"
        "<p class='about'>The chart has the error of the replay over noise in windows of time, on a logarithmic scale "
        "from 0.5 to 50. The dashed line is what simulated trials stay below, the red one the moment in the "
        "table.</p>"
        "<div class='scroll'><table><tr><th>trial</th><th>cause</th><th>moment [s]</th><th>leaves prediction [s]</th>"
        f"<th>replay against measurement</th><th>evidence</th></tr>{rows}</table></div>"
        f"<h3 style='margin-top:18px'>All trials together</h3><div class='scroll'><table>{numbers}</table></div>"
        f"<h3 style='margin-top:18px'>What mends it</h3><pre>{commands}</pre></section>"
    )


def _row(trial: TrialExplanation, name: str) -> str:
    """Return the row of one trial."""
    cells = [name, trial.cause, _number(trial.moment), _number(trial.left_prediction)]
    text = "".join(f"<td>{escape(cell)}</td>" for cell in cells)
    sentence = f"<td style='white-space:normal;min-width:24em'>{escape(trial.sentence)}</td>"
    return f"<tr>{text}<td>{_chart(trial)}</td>{sentence}</tr>"


def _chart(trial: TrialExplanation) -> str:
    """Return a chart of the error over noise by window as SVG."""
    count = len(trial.divergence)
    if not count:
        return ""
    wide = WIDTH / count
    bars = "".join(
        f"<rect x='{k * wide:.1f}' y='{_height(v):.1f}' width='{wide - 1:.1f}' height='{HEIGHT - _height(v):.1f}' "
        "fill='currentColor' opacity='0.5'/>"
        for k, v in enumerate(trial.divergence)
    )
    level = _height(trial.threshold)
    lines = f"<line x1='0' x2='{WIDTH}' y1='{level:.1f}' y2='{level:.1f}' stroke='currentColor' stroke-dasharray='4'/>"
    if trial.moment is not None:
        at = min(trial.moment / trial.window, count) * wide
        lines += f"<line x1='{at:.1f}' x2='{at:.1f}' y1='0' y2='{HEIGHT}' stroke='#d22' stroke-width='2'/>"
    return f"<svg width='{WIDTH}' height='{HEIGHT}' role='img' aria-label='error by window'>{bars}{lines}</svg>"


def _height(value: float) -> float:
    """Return where a value of 0.5 to 50 lies in a chart, from its top [px]."""
    share = np.log(np.clip(value, 0.5, 50) / 0.5) / np.log(100)
    return float(HEIGHT * (1 - share))


def _number(value: float | None) -> str:
    """Return a number as text; a dash where there is none."""
    return "-" if value is None or not np.isfinite(value) else f"{value:.2f}"


def _capital(text: str) -> str:
    """Return a text with a capital first letter."""
    return f"{text[0].upper()}{text[1:]}"
