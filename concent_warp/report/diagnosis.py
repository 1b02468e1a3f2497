"""The section of a report that shows a diagnosis: what is missing with its evidence, and what to measure next.

It reads the JSON object that a diagnosis prints: `verdict` ("effect", "group", "none_needed" or "none_of_these");
`effects`, the best first, each with `name`, `family`, `gain` (share of the held-out error that it removes) with
`interval`, `p`, `parameters` with `value`, `interval` and `unit`, and whether it was `accepted`; `groups` of names that
the data cannot distinguish; `where`; `unexplained` (share); `detectable`; `next_experiment`. What is not there is left
out of the section.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from concent_warp.comparison.units import p_value_text, words
from concent_warp.report.tables import Row, table

MOST_EFFECTS = 10
"""Effects in the chart; further ones are folded away."""
SIGNIFICANT = 0.05
"""Below this p an effect counts as accepted where the diagnosis does not say."""
FAMILIES = {
    "joints": "joints and drives",
    "objects": "objects",
    "contact": "contact",
    "world": "world",
    "measurement": "measurement",
}


def diagnosis_section(diagnosis: Mapping[str, Any] | None) -> str:
    """Return the section as HTML, empty where there is no diagnosis."""
    if not diagnosis:
        return ""
    effects = [e for e in diagnosis.get("effects") or [] if isinstance(e, Mapping)]
    found = ['<section id="diagnosis">', "<h2>What is missing</h2>"]
    found.append(f'<p class="answer {_answer_class(diagnosis)}">{escape(_headline(diagnosis))}</p>')
    if groups := [group for group in diagnosis.get("groups") or [] if len(group) > 1]:
        found += [f"<p>{escape(_group_sentence(group))}</p>" for group in groups]
    if effects:
        found += ["<h3>Held-out error that each effect removes</h3>", _bars(effects)]
    if parameters := _parameter_rows(effects):
        found += [
            "<h3>Parameters</h3>",
            table(["effect", "parameter", "value", "95 % interval", "unit"], parameters, 2),
        ]
    if where := _places(diagnosis.get("where")):
        found += ["<h3>Where it shows</h3>", bullet_list(where)]
    if limits := _detectable_rows(diagnosis.get("detectable")):
        about = "<summary>Smallest detectable effects</summary>"
        opened = " open" if diagnosis.get("verdict") == "none_needed" else ""
        found.append(f"<details{opened}>{about}{table(['effect', 'size', 'unit'], limits, 1)}</details>")
    if experiment := _sentences(diagnosis.get("next_experiment")):
        found.append(f'<p class="next"><b>Next experiment</b> {escape(" ".join(experiment))}</p>')
    return "\n".join([*found, "</section>"])


def _answer_class(diagnosis: Mapping[str, Any]) -> str:
    """Return the style of the headline."""
    kinds = {"effect": "named", "group": "open", "none_needed": "fine", "none_of_these": "lost"}
    return kinds.get(str(diagnosis.get("verdict")), "open")


def _headline(diagnosis: Mapping[str, Any]) -> str:
    """Return the answer in one or two sentences."""
    effects = [e for e in diagnosis.get("effects") or [] if isinstance(e, Mapping)]
    best = [e for e in effects if _accepted(e)] or effects[:1]
    unexplained = diagnosis.get("unexplained")
    left = "" if not isinstance(unexplained, int | float) else f" {_share(unexplained)} of the error stays unexplained."
    match diagnosis.get("verdict"):
        case "effect" if best:
            names = _listed([words(str(e["name"])) + _family_text(e) for e in best])
            return f"The model lacks {names}. {_gain_sentence(best)}{left}"
        case "group":
            group = next((g for g in diagnosis.get("groups") or [] if len(g) > 1), [e["name"] for e in effects])
            names = _listed([words(name) for name in group])
            return f"The model lacks something, and the data cannot distinguish between {names}.{left}"
        case "none_needed":
            return "No discrepancy was detected: the model explains the measurements down to their noise."
        case "none_of_these" if any(_accepted(e) for e in effects):
            groups = diagnosis.get("groups") or []
            alike = [next((g for g in groups if e["name"] in g), [str(e["name"])]) for e in best]
            names = _listed([_listed([words(name) for name in group], "or") for group in alike])
            lacks = "The model lacks something that none of the effects in the library explains"
            return f"{lacks}, beside what {names} can account for. {_gain_sentence(best)}{left}"
        case "none_of_these":
            return f"The model lacks something that none of the effects in the library explains.{left}"
    return f"The diagnosis ended with “{diagnosis.get('verdict')}”.{left}"


def _gain_sentence(effects: Sequence[Mapping[str, Any]]) -> str:
    """Return a sentence on the held-out gains of effects."""
    parts = []
    for e in effects:
        value, interval = _estimate(e.get("gain"), e)
        if value is not None:
            what = f"{words(str(e['name']))} " if len(effects) > 1 else "it "
            p = _p_text(e)
            parts.append(
                f"{what}removes {_share(value)}{_interval_text(interval)} of the error{f' ({p})' if p else ''}"
            )
    return f"On data that the fit has not seen, {', '.join(parts)}." if parts else ""


def _family_text(effect: Mapping[str, Any]) -> str:
    """Return the family of an effect in brackets, empty where it is not given."""
    family = str(effect.get("family") or "")
    return f" ({FAMILIES.get(family, family)})" if family else ""


def _group_sentence(group: Sequence[str]) -> str:
    """Return a sentence on effects that the data cannot distinguish."""
    return f"These data cannot distinguish between {_listed([words(name) for name in group])}."


def _accepted(effect: Mapping[str, Any]) -> bool:
    """Return whether the diagnosis accepted an effect."""
    if "accepted" in effect:
        return bool(effect["accepted"])
    value, interval = _estimate(effect.get("gain"), effect)
    low = value if interval is None else interval[0]
    return low is not None and low > 0 and isinstance(effect.get("p"), int | float) and effect["p"] < SIGNIFICANT


def _estimate(value: Any, owner: Mapping[str, Any]) -> tuple[float | None, tuple[float, float] | None]:
    """Return a number and its interval, given as an object with `value` and `interval`, or beside each other."""
    interval = owner.get("gain_interval", owner.get("interval"))
    if isinstance(value, Mapping):
        value, interval = value.get("value"), value.get("interval")
    number = float(value) if isinstance(value, int | float) and np.isfinite(value) else None
    ends = interval if isinstance(interval, Sequence) and not isinstance(interval, str) and len(interval) == 2 else None
    if ends is None or not all(isinstance(end, int | float) for end in ends):
        return number, None
    return number, (float(ends[0]), float(ends[1]))


def _bars(effects: Sequence[Mapping[str, Any]]) -> str:
    """Return a bar for each effect with its interval; what lies beyond `MOST_EFFECTS` is folded away."""
    gains = [_estimate(e.get("gain"), e) for e in effects]
    ends = [end for value, interval in gains if value is not None for end in (value, *(interval or ()))]
    low, high = min([0.0, *ends]), max([0.01, *ends])
    span = high - low

    def at(value: float) -> str:
        return f"{100 * (value - low) / span:.2f}%"

    rows = []
    for e, (value, interval) in zip(effects, gains, strict=True):
        marks = f'<i class="zero" style="left:{at(0)}"></i>'
        text = "-"
        if value is not None:
            start, end = sorted((0.0, value))
            marks += f'<i class="gain" style="left:{at(start)};width:{100 * (end - start) / span:.2f}%"></i>'
            text = _share(value) + _interval_text(interval)
        if interval is not None:
            width = f"{100 * (interval[1] - interval[0]) / span:.2f}%"
            marks += f'<i class="whisker" style="left:{at(interval[0])};width:{width}"></i>'
        style = "accepted" if _accepted(e) else "rejected"
        name = escape(words(str(e.get("name", "?"))))
        rows.append(
            f'<div class="effect {style}"><span class="name">{name}</span><span class="track">{marks}</span>'
            f'<span class="figure">{text} <span class="quiet">{escape(_p_text(e))}</span></span></div>'
        )
    shown = f'<div class="bars">{"".join(rows[:MOST_EFFECTS])}</div>'
    if rest := rows[MOST_EFFECTS:]:
        shown += f'<details><summary>{len(rest)} more</summary><div class="bars">{"".join(rest)}</div></details>'
    return shown


def _parameter_rows(effects: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Return the rows of the table of parameters of accepted effects, of the best where none was accepted."""
    rows: list[Row] = []
    for e in [e for e in effects if _accepted(e)] or effects[:1]:
        given = e.get("parameters") or []
        if isinstance(given, Mapping):
            given = [{"name": name, **(p if isinstance(p, Mapping) else {"value": p})} for name, p in given.items()]
        for k, p in enumerate(given):
            value, interval = _estimate(p.get("value"), p)
            ends = "-" if interval is None else f"{interval[0]:.4g} to {interval[1]:.4g}"
            name = escape(words(str(e.get("name", "?")))) if k == 0 else ""
            number = "-" if value is None else f"<b>{value:.4g}</b>"
            rows.append(("", [name, escape(str(p.get("name", ""))), number, ends, escape(str(p.get("unit", "")))]))
    return rows


def _detectable_rows(given: Any) -> list[Row]:
    """Return the rows of the table of the smallest detectable effects."""
    if isinstance(given, Mapping):
        given = [{"name": name, **(v if isinstance(v, Mapping) else {"value": v})} for name, v in given.items()]
    rows: list[Row] = []
    for item in given or []:
        value, _ = _estimate(item.get("value", item.get("size")), {})
        name = escape(words(str(item.get("name", item.get("effect", "?")))))
        rows.append(("", [name, "-" if value is None else f"{value:.3g}", escape(str(item.get("unit", "")))]))
    return rows


def _places(given: Any) -> list[str]:
    """Return where the model fails as sentences, from objects with a channel, a phase, a time span and so on."""
    items = [given] if isinstance(given, Mapping | str) else list(given or [])
    found = []
    for item in items:
        if not isinstance(item, Mapping) or "sentence" in item:
            found += _sentences(item)
            continue
        span = item.get("span") or item.get("time") or [item.get("start"), item.get("end")]
        ends = [end for end in span if isinstance(end, int | float)] if isinstance(span, Sequence) else []
        parts = [words(str(item[key])) for key in ("channel", "body") if item.get(key)]
        parts += [f"{item['phase']} phase"] if item.get("phase") else []
        parts += [f"{ends[0]:.2f}-{ends[1]:.2f} s"] if len(ends) == 2 else []
        parts += [_plain(item["direction"])] if item.get("direction") else []
        found += [", ".join(parts)] if parts else []
    return found


def _sentences(given: Any) -> list[str]:
    """Return text, an object or a list of either as sentences."""
    if not given:
        return []
    if isinstance(given, str):
        return [given]
    if isinstance(given, Mapping):
        if text := given.get("sentence") or given.get("words"):
            return [str(text)]
        return [", ".join(f"{words(str(k))}: {_plain(v)}" for k, v in given.items() if v not in (None, "", []))]
    return [text for item in given for text in _sentences(item)]


def _plain(value: Any) -> str:
    """Return a value of a JSON object as text."""
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(map(_plain, value))
    return words(str(value))


def bullet_list(lines: Sequence[str]) -> str:
    """Return lines as a list."""
    return f'<ul class="plain">{"".join(f"<li>{escape(line)}</li>" for line in lines)}</ul>'


def _listed(names: Sequence[str], last: str = "and") -> str:
    """Return names as "a, b and c"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {last} {names[-1]}" if names else "something"


def _share(value: float) -> str:
    """Return a share in whole percent."""
    return f"{100 * value:.0f} %"


def _interval_text(interval: tuple[float, float] | None) -> str:
    """Return an interval of shares in percent, in brackets and with a space before it."""
    return "" if interval is None else f" [{100 * interval[0]:.0f}, {100 * interval[1]:.0f}]"


def _p_text(effect: Mapping[str, Any]) -> str:
    """Return the p-value of an effect as text, empty where it has none."""
    p, smallest = effect.get("p"), effect.get("p_smallest")
    if not isinstance(p, int | float):
        return ""
    return p_value_text(p, smallest if isinstance(smallest, int | float) else 0.0)
