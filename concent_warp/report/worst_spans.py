"""The section of a report on where the model fails: a timeline of all channels, and the worst spans in words."""

from __future__ import annotations

from collections.abc import Collection
from html import escape

from concent_warp.comparison.result import Comparison
from concent_warp.comparison.units import channel_text
from concent_warp.comparison.worst_spans import WorstSpan, span_kind
from concent_warp.estimation.noise import WORDS

MOST_SPANS = 6
"""Spans in the list."""


def numbered_spans(comparison: Comparison) -> list[tuple[int, WorstSpan]]:
    """Return the spans that the page lists, numbered from 1: the worst of each kind."""
    found, seen = [], set()
    for place in comparison.worst_spans:
        if span_kind(place) not in seen and len(found) < MOST_SPANS:
            seen.add(span_kind(place))
            found.append((len(found) + 1, place))
    return found


def shown_demonstrations(comparison: Comparison, most: int) -> tuple[str, ...]:
    """Return the demonstrations to show, in their order: those with the worst spans, then the first ones."""
    worst = [place.demonstration for _, place in numbered_spans(comparison)]
    chosen = list(dict.fromkeys([*worst, *comparison.demonstrations]))[:most]
    return tuple(d for d in comparison.demonstrations if d in chosen)


def worst_span_list(comparison: Comparison, shown: Collection[str]) -> str:
    """Return the worst spans as a list; those in a demonstration that is `shown` can be clicked."""
    places = numbered_spans(comparison)
    if not places:
        return f"<p>The error is nowhere above {comparison.span_cfg.min_ratio:g} x noise.</p>"
    several = len(comparison.demonstrations) > 1
    items = []
    for number, place in places:
        text = escape(place.sentence(demonstration=several))
        if place.recurs > 1:
            text += f' <span class="quiet">(alike in {place.recurs} demonstrations)</span>'
        badge = f'<span class="badge">{number}</span>'
        if place.demonstration in shown:
            items.append(f'<li><button type="button" data-place="{number}">{badge}<span>{text}</span></button></li>')
        else:
            items.append(f"<li>{badge}<span>{text}</span></li>")
    return f'<ol class="places">{"".join(items)}</ol>'


def noise_words(comparison: Comparison) -> str:
    """Return the sources of the noise floors; that of most channels comes first, without their names."""
    found: dict[str, list[str]] = {}
    for channel in comparison.channels:
        source = comparison.summarise(comparison.after, channel).source
        found.setdefault(WORDS[source], []).append(channel_text(channel))
    (most, _), *others = sorted(found.items(), key=lambda item: -len(item[1]))
    return "; ".join([f"Noise: {most}", *(f"of {', '.join(channels)}: {how}" for how, channels in others)]) + "."
