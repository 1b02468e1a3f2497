"""The section of a report that shows a diagnosis: what is missing with its evidence, and what to measure next.

It reads the JSON object of a diagnosis (docs/diagnose.md); entries that are missing are left out of the section.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from concent_warp.comparison.units import channel_text, interval_texts, p_value_text
from concent_warp.diagnosis.detectable import DETECTABLE_MEANING, detectable_text
from concent_warp.diagnosis.values_text import SCATTER_CLAUSE
from concent_warp.report.tables import Row, table

MOST_EFFECTS = 10
"""Effects in the chart; further ones are folded away."""
ANSWER_CLASSES = {
    "effect": "named",
    "group": "open",
    "none_needed": "fine",
    "none_of_these": "lost",
    "unsettled": "open",
}
"""Style of the headline by verdict."""
FAMILIES = {
    "joints": "joints and drives",
    "objects": "objects",
    "contact": "contact",
    "world": "world",
    "measurement": "measurement",
}
QUIET_RATIO = 1.25
"""Residual over noise up to which the page says that the model explains the noise [-]: `DiagnoseCfg.adequate_ratio`.
More is left where noise is uncertain, or where it may be the error of the model's own friction."""
NOISE_REACHED = "the model explains the measurements down to their noise"


def diagnosis_section(diagnosis: Mapping[str, Any] | None) -> str:
    """Return the section as HTML, empty where there is no diagnosis."""
    if not diagnosis:
        return ""
    effects, verdict = diagnosis.get("effects", ()), diagnosis["verdict"]
    found = ['<section id="diagnosis">', "<h2>What is missing</h2>"]
    found.append(f'<p class="answer {ANSWER_CLASSES[verdict]}">{escape(_headline(diagnosis))}</p>')
    found += [f"<p>{escape(_group_sentence(group))}</p>" for group in diagnosis.get("groups", ()) if len(group) > 1]
    if besides := diagnosis.get("changes_besides"):
        found += ["<h3>Used besides, no missing effect</h3>", bullet_list(besides)]
    if unsettled := diagnosis.get("unsettled"):
        found += ["<h3>Not settled in the time given</h3>", bullet_list(unsettled)]
    if effects:
        found += ["<h3>Held-out error that each effect removes</h3>", _bars(effects)]
    if parameters := _parameter_rows(effects):
        header = ["effect", "parameter", "value", "95 % interval", "unit"]
        found += ["<h3>Parameters</h3>", table(header, parameters, 2)]
    if where := diagnosis.get("where"):
        found += ["<h3>Where it shows</h3>", bullet_list([entry["sentence"] for entry in where])]
    if limits := diagnosis.get("detectable"):
        rows = [_detectable_row(entry) for entry in limits]
        opened = " open" if verdict == "none_needed" else ""
        about = f"<summary>Smallest detectable effects ({DETECTABLE_MEANING})</summary>"
        found.append(f"<details{opened}>{about}{table(['effect', 'size', 'unit'], rows, 1)}</details>")
    if experiment := diagnosis.get("next_experiment"):
        found.append(f'<p class="next"><b>Next experiment</b> {escape(experiment["sentence"])}</p>')
    return "\n".join([*found, "</section>"])


def _headline(diagnosis: Mapping[str, Any]) -> str:
    """Return the verdict in one or two sentences."""
    accepted = [e for e in diagnosis.get("effects", ()) if e["accepted"]]
    groups = diagnosis.get("groups", ())
    left = f" {_share(diagnosis['unexplained'])} of the error stays unexplained." if "unexplained" in diagnosis else ""
    if (share := diagnosis.get("form_error")) is not None:
        left = f" What is left, {_share(share)} of the error, is no more than errors in the formulas of the effects."
    if diagnosis.get("remainder_searched") is False:
        left += " Whether something smaller is missing too was not settled in this time."
    if diagnosis["verdict"] == "none_needed":
        ratio = (diagnosis.get("ratio") or [1.0])[-1]
        scatter = diagnosis.get("rests_on_scatter")
        much = f"residuals are {ratio:.2f} x noise" if scatter or ratio > QUIET_RATIO else NOISE_REACHED
        much += ", with what is named below" if diagnosis.get("changes_besides") else ""
        return f"No discrepancy was detected: {much}{f'; {SCATTER_CLAUSE}' if scatter else ''}."
    if diagnosis["verdict"] == "unsettled":
        best = f" The best so far: {_gain_sentence(accepted)}" if accepted else ""
        step = diagnosis.get("time_step") or {}
        lead = "The time step of the model is too long" if step.get("too_long") else "The time did not suffice"
        return f"{lead} for a verdict.{best}"
    if diagnosis["verdict"] == "group":
        group = next(g for g in groups if len(g) > 1)
        names = _listed([channel_text(name) for name in group])
        return f"The model lacks something, and the data cannot distinguish between {names}.{left}"
    if diagnosis["verdict"] == "effect":
        names = _listed([f"{channel_text(e['name'])} ({FAMILIES.get(e['family'], e['family'])})" for e in accepted])
        return f"The model lacks {names}. {_gain_sentence(accepted)}{_size_open(accepted)}{left}"
    lacks = "The model lacks something that none of the effects in the library explains"
    if not accepted:
        return f"{lacks}.{left}"
    alike = [next((g for g in groups if e["name"] in g), [e["name"]]) for e in accepted]
    names = _listed([_listed([channel_text(name) for name in group], "or") for group in alike])
    return f"{lacks}, beside what {names} can account for. {_gain_sentence(accepted)}{left}"


def _gain_sentence(effects: Sequence[Mapping[str, Any]]) -> str:
    """Return a sentence on the held-out gains of effects."""
    parts = [
        f"{channel_text(e['name']) if len(effects) > 1 else 'it'} removes {_gain_text(e)} of the error ({_p_text(e)})"
        for e in effects
    ]
    return f"On data that the fit has not seen, {', '.join(parts)}."


def _size_open(effects: Sequence[Mapping[str, Any]]) -> str:
    """Return a sentence on the effects whose intervals all include no change, empty where there are none."""
    names = [channel_text(e["name"]) for e in effects if _may_be_null(e["parameters"])]
    if not names:
        return ""
    whose = "Its size" if len(effects) == 1 else f"The size of {_listed(names)}"
    return f" {whose} is not known: each interval includes no change."


def _may_be_null(parameters: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether each parameter, by itself, may be at the value at which the effect does nothing."""
    return bool(parameters) and not any(_excludes_null(p) for p in parameters)


def _excludes_null(parameter: Mapping[str, Any]) -> bool:
    """Return whether the interval of a parameter excludes its null value; true where that is not given."""
    low, high = parameter["interval"]
    if "null" not in parameter:
        return True
    if parameter["null"] is None:  # a limit that is infinite by default
        return high is not None
    return (low is not None and parameter["null"] < low) or (high is not None and parameter["null"] > high)


def _group_sentence(group: Sequence[str]) -> str:
    """Return a sentence on effects that the data cannot distinguish."""
    return f"These data cannot distinguish between {_listed([channel_text(name) for name in group])}."


def _bars(effects: Sequence[Mapping[str, Any]]) -> str:
    """Return a bar for each effect with its interval; what lies beyond `MOST_EFFECTS` is folded away."""
    ends = [end for e in effects for end in (e["gain"]["value"], *e["gain"]["interval"])]
    low, high = min([0.0, *ends]), max([0.01, *ends])
    span = high - low

    def mark(kind: str, start: float, end: float) -> str:
        return (
            f'<i class="{kind}" style="left:{100 * (start - low) / span:.2f}%;'
            f'width:{100 * (end - start) / span:.2f}%"></i>'
        )

    rows = []
    for e in effects:
        value, interval = e["gain"]["value"], e["gain"]["interval"]
        marks = f'<i class="zero" style="left:{100 * -low / span:.2f}%"></i>'
        marks += mark("gain", *sorted((0.0, value))) + mark("whisker", *interval)
        rows.append(
            f'<div class="effect {"accepted" if e["accepted"] else "rejected"}"><span class="name">'
            f'{escape(channel_text(e["name"]))}</span><span class="track">{marks}</span>'
            f'<span class="figure">{_gain_text(e)} <span class="quiet">{escape(_p_text(e))}</span></span></div>'
        )
    shown = f'<div class="bars">{"".join(rows[:MOST_EFFECTS])}</div>'
    if rest := rows[MOST_EFFECTS:]:
        shown += f'<details><summary>{len(rest)} more</summary><div class="bars">{"".join(rest)}</div></details>'
    return shown


def _parameter_rows(effects: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Return the rows of the table of parameters of accepted effects, of the best where none was accepted."""
    rows: list[Row] = []
    for e in [e for e in effects if e["accepted"]] or effects[:1]:
        for k, p in enumerate(e["parameters"]):
            name = escape(channel_text(e["name"])) if k == 0 else ""
            value, low, high = _value_and_ends(p)
            rows.append(("", [name, escape(p["name"]), f"<b>{value}</b>", f"{low} to {high}", escape(p["unit"])]))
    return rows


def _value_and_ends(parameter: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the value of a parameter and the ends of its interval, "∞" for one that JSON cannot hold."""
    known = [np.inf if x is None else x for x in (parameter["value"], *parameter["interval"])]
    texts = interval_texts(known[0], known[1], known[2], 4)
    return tuple(text if np.isfinite(x) else "∞" for x, text in zip(known, texts, strict=True))


def _detectable_row(entry: Mapping[str, Any]) -> Row:
    """Return the row of the smallest detectable size of an effect."""
    size = np.inf if entry["size"] is None else entry["size"]
    texts = detectable_text(entry["name"], entry["parameter"], size, entry["unit"], entry.get("null") or 0.0)
    return "", [escape(channel_text(texts[0])), *(escape(text) for text in texts[1:])]


def bullet_list(lines: Sequence[str]) -> str:
    """Return lines as a list."""
    return f'<ul class="plain">{"".join(f"<li>{escape(line)}</li>" for line in lines)}</ul>'


def _listed(names: Sequence[str], last: str = "and") -> str:
    """Return names as "a, b and c"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {last} {names[-1]}"


def _share(value: float) -> str:
    """Return a share in whole percent."""
    return f"{100 * value:.0f} %"


def _gain_text(effect: Mapping[str, Any]) -> str:
    """Return the gain of an effect with its interval in percent."""
    low, high = effect["gain"]["interval"]
    return f"{_share(effect['gain']['value'])} [{100 * low:.0f}, {100 * high:.0f}]"


def _p_text(effect: Mapping[str, Any]) -> str:
    """Return the p-value of an effect as text."""
    return p_value_text(effect["p"], effect["p_smallest"])
