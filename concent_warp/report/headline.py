"""The headline of a report: the figures on the cards, and the sentence that says what they mean."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from concent_warp.comparison.result import Comparison, Summary
from concent_warp.comparison.units import channel_text, percent_text, ratio_text, unit_text, value_text
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.report.cfg import ReportCfg

NULL = "no contact"
"""Name of the model whose objects do not touch one another, where a comparison has one."""


def headline_channel(comparison: Comparison) -> str:
    """Return the channel that the headline is about.

    With contact stages the main channel, the motion of an object; otherwise the one farthest above its noise in the
    first model.
    """
    if comparison.staged:
        return comparison.main_channel()
    ratios = {channel: comparison.summarise(comparison.before, channel).ratio for channel in comparison.channels}
    known = {channel: ratio for channel, ratio in ratios.items() if ratio is not None and not np.isnan(ratio)}
    return max(known, key=lambda channel: known[channel]) if known else comparison.main_channel()


@dataclass(frozen=True)
class Card:
    """One figure; `figure` and `note` are HTML."""

    what: str
    figure: str
    note: str = ""

    def html(self) -> str:
        """Return the card."""
        note = f'<div class="note">{self.note}</div>' if self.note else ""
        return (
            f'<div class="card"><div class="what">{escape(self.what)}</div>'
            f'<div class="figure">{self.figure}</div>{note}</div>'
        )


def cards(
    comparison: Comparison,
    events: Mapping[str, ContactEventSequence],
    fitted: Sequence[str],
    overlap: Mapping[str, Mapping[str, float]],
    cfg: ReportCfg | None = None,
) -> list[Card]:
    """Return the cards of a report."""
    cfg = cfg or ReportCfg()
    channel, phases = headline_channel(comparison), comparison.contact_phases()
    where = f"Mean error of {channel_text(channel)}" + (f", {' + '.join(phases)}" if phases else "")
    unseen = tuple(d for d in comparison.demonstrations if fitted and d not in fitted)
    seen = tuple(d for d in comparison.demonstrations if d not in unseen)
    found = []
    if seen:
        suffix = " (demonstrations that were fitted)" if unseen else ""
        found.append(_error_card(comparison, where + suffix, channel, phases, seen))
    if unseen:
        found.append(_error_card(comparison, where + " (demonstrations not seen by the fit)", channel, phases, unseen))
    if overlap:
        ends = [float(np.mean(list(values.values()))) for values in overlap.values() if values]
        if ends:
            figure = _arrow([f"{value:.2f}" for value in (ends[0], ends[-1])], "")
            what = "Overlap (IoU) of the contact times with the truth; 1 is perfect"
            found.append(Card(what, figure, _overlap_note(ends[0], ends[-1], cfg.overlap_change)))
    if comparison.staged and any(sequence.stages for sequence in events.values()):
        counts = sorted({len(sequence.stages) for sequence in events.values()})
        names = " · ".join(dict.fromkeys(stage.name for s in events.values() for stage in s.stages))
        figure = " or ".join(map(str, counts)) + " <small>stages</small>"
        found.append(Card("Contact stages found in the replay", figure, escape(names)))
    last = comparison.summarise(comparison.after, channel, phases)
    noise = "" if last.noise is None else f"{value_text(last.noise, last.unit)} {unit_text(last.unit)}"
    if NULL in comparison.models:
        null = comparison.summarise(NULL, channel, phases)
        figure = f"{value_text(null.mean, null.unit)} <small>{unit_text(null.unit)}</small>"
        note = f"Measurement noise alone would leave {noise} (RMS)." if noise else ""
        found.insert(
            bool(seen) + bool(unseen), Card("The same error if objects did not touch one another", figure, note)
        )
    elif noise:
        found.append(Card("RMS error that the measurement noise alone would leave", noise))
    return found


def _above_noise(summary: Summary, noise_ratio: float) -> str:
    """Return the RMS error over the noise, as the end of a sentence; empty where the noise is unknown."""
    if summary.ratio is None or not np.isfinite(summary.ratio):
        return ""
    if summary.ratio < noise_ratio:
        return f", at the level of the measurement noise ({ratio_text(summary.ratio)} noise)"
    return f" ({ratio_text(summary.ratio)} noise)"


def _overlap_note(before: float, after: float, change: float) -> str:
    """Return what a change of the overlap of contact means, as HTML; empty where it stays."""
    if after < before - change:
        return (
            '<b class="bad">It falls:</b> the objects of the fitted model touch at other times than in truth, so that '
            "the motion is reproduced with less realistic contact."
        )
    if after > before + change:
        return '<b class="good">It rises:</b> the objects touch more nearly at the true times.'
    return ""


def _error_card(
    comparison: Comparison, what: str, channel: str, phases: tuple[str, ...], demonstrations: tuple[str, ...]
) -> Card:
    """Return the card of an error before and after."""
    before, after = (
        comparison.summarise(model, channel, phases, demonstrations) for model in (comparison.before, comparison.after)
    )
    unit = unit_text(after.unit)
    if len(comparison.models) < 2:
        return Card(what, f"{value_text(after.mean, after.unit)} <small>{unit}</small>")
    found = comparison.difference(channel, phases, demonstrations)
    note = ""
    if np.isfinite(found.share):
        kind = {"fallen": "good", "risen": "bad"}.get(found.verdict, "")
        note = f'<b class="{kind}">{percent_text(found.share)}</b>'
        if np.isfinite(found.low):
            low, high = (value_text(end, found.unit, sign=True) for end in (found.low, found.high))
            note += f", difference {low} to {high} {unit} (95 %)"
    return Card(what, _arrow([value_text(before.mean, before.unit), value_text(after.mean, after.unit)], unit), note)


def _arrow(ends: Sequence[str], unit: str) -> str:
    """Return two figures with an arrow between them as HTML."""
    tail = f" <small>{unit}</small>" if unit else ""
    return f'<span class="from">{ends[0]}</span><span class="arrow">→</span><span class="to">{ends[1]}</span>{tail}'


def verdict(
    comparison: Comparison,
    fitted: Sequence[str],
    overlap: Mapping[str, Mapping[str, float]],
    cfg: ReportCfg | None = None,
) -> str:
    """Return what the figures mean, in one or two sentences."""
    cfg = cfg or ReportCfg()
    channel, phases = headline_channel(comparison), comparison.contact_phases()
    after = comparison.summarise(comparison.after, channel, phases)
    unit = unit_text(after.unit)
    during = f" during {' and '.join(phases)}" if phases else ""
    if not np.isfinite(after.mean):
        return f"The simulation of “{comparison.after}” does not stay finite: see the table for when it diverges."
    if len(comparison.models) < 2:
        off = f"{value_text(after.mean, after.unit)} {unit} on average in {channel_text(channel)}"
        return f"The model is off by {off}{during}{_above_noise(after, cfg.noise_ratio)}."
    before = comparison.summarise(comparison.before, channel, phases)
    found = comparison.difference(channel, phases)
    change = {
        "fallen": "has fallen",
        "risen": "has risen",
        "unclear": "has not changed by more than chance explains",
    }[found.verdict]
    above = _above_noise(after, cfg.noise_ratio)
    text = (
        f"The error of {channel_text(channel)}{during} {change}: {value_text(before.mean, before.unit)} {unit} "
        f"{comparison.before}, {value_text(after.mean, after.unit)} {unit} {comparison.after}{above}."
    )
    if NULL in comparison.models:
        null = comparison.summarise(NULL, channel, phases)
        text += f" Ignoring the contact would leave {value_text(null.mean, null.unit)} {unit}"
        if after.mean < 0.5 * null.mean:
            text += ", so it is the contact that explains the motion."
        else:
            text += ": this error alone does not show that the contact is right."
    ends = [float(np.mean(list(values.values()))) for values in overlap.values() if values]
    if ends and ends[-1] < cfg.min_overlap:
        text += f" The contact times overlap with the truth by only {ends[-1]:.2f}."
    if unseen := tuple(d for d in comparison.demonstrations if fitted and d not in fitted):
        held = comparison.difference(channel, phases, unseen)
        if held.verdict != "fallen":
            text += " On demonstrations that the fit has not seen, no gain can be shown."
    return text
