"""The page of rounds of improvement: success by round, what was found and added, and the commands of each step."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from concent_warp.deploy.improve.rounds import Improved, ImprovementRound
from concent_warp.files import write_text
from concent_warp.report.template import filled, page_file
from concent_warp.version import __version__

WIDTH, HEIGHT, LEFT, BOTTOM, TOP = 640, 260, 52, 34, 12
"""Size of the chart and of its margins [px]."""
EXPLAINED = "explanation.html"
"""Page of the explanation in the folder of a round."""
TEMPLATE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'; img-src data:">
<title>Rounds of improvement</title>
<style>
[[style]]
td.wide { white-space: normal; min-width: 13em; overflow-wrap: anywhere }
pre { white-space: pre-wrap; overflow-wrap: anywhere }
</style>
</head>
<body>
<main>
<h1>Rounds of improvement</h1>
<p class="sub">[[subtitle]]</p>
<p class="verdict">[[verdict]]</p>
[[advice]]
<section><h2>Success by round</h2>
<p class="about">Share of the trials of each round's policy that succeed, with Wilson's 95 % interval.</p>
[[chart]]
<div class="scroll"><table><tr><th>round</th><th>trials</th><th>succeed</th><th>95 %</th><th>cause of the failures</th>
<th>effects [fitted values]</th><th>what was done</th><th>time [min]</th></tr>[[rows]]</table></div></section>
[[rounds]]
<p class="sub">[[footer]]</p>
</main>
</body>
</html>
"""


def write_rounds(path: Path, found: Improved) -> None:
    """Write the page of rounds, in one piece or not at all.

    Args:
        path: The ``.html`` file, in the folder of the rounds.
        found: The rounds.
    """
    running = not found.reason
    parts = {
        "style": page_file("style.css"),
        "subtitle": escape(f"Last policy: {found.policy}"),
        "verdict": escape("Under way: the page is written after each round." if running else found.reason),
        "advice": _commands("What to do next", found.advice),
        "chart": chart(found.rounds),
        "rows": "".join(_row(one) for one in found.rounds),
        "rounds": "".join(_section(one, path.parent) for one in found.rounds),
        "footer": escape(f"Written by concent {__version__}."),
    }
    write_text(path, filled(TEMPLATE, parts))


def chart(rounds: Sequence[ImprovementRound]) -> str:
    """Return the success rates by round with their intervals as SVG."""
    tried = [one for one in rounds if one.trials]
    if not tried:
        return ""
    last = max(one.number for one in rounds)
    step = (WIDTH - LEFT - 20) / max(last, 2)

    def across(number: int) -> float:
        return LEFT + step * (number - 0.5)

    def down(share: float) -> float:
        return TOP + (HEIGHT - TOP - BOTTOM) * (1 - share)

    lines = [
        f"<line class='grid' x1='{LEFT}' x2='{WIDTH}' y1='{down(s):.1f}' y2='{down(s):.1f}'/>"
        f"<text class='tick' x='{LEFT - 8}' y='{down(s) + 4:.1f}' text-anchor='end'>{s:.0%}</text>"
        for s in (0, 0.25, 0.5, 0.75, 1)
    ]
    path = " ".join(f"{across(one.number):.1f},{down(one.rate):.1f}" for one in tried)
    lines.append(f"<polyline points='{path}' fill='none' stroke='var(--after)' stroke-width='1.8'/>")
    for one in tried:
        x, (low, high) = across(one.number), one.interval
        lines.append(
            f"<line x1='{x:.1f}' x2='{x:.1f}' y1='{down(low):.1f}' y2='{down(high):.1f}' stroke='var(--after)' "
            "stroke-width='2' opacity='0.5'/>"
            f"<circle cx='{x:.1f}' cy='{down(one.rate):.1f}' r='4.5' fill='var(--after)'/>"
            f"<text x='{x + 9:.1f}' y='{down(one.rate) - 6:.1f}'>{one.rate:.0%}</text>"
            f"<text x='{x:.1f}' y='{HEIGHT - 10}' text-anchor='middle'>round {one.number}</text>"
        )
    size = f"viewBox='0 0 {WIDTH} {HEIGHT}' style='width:100%;max-width:{WIDTH}px'"
    return f"<svg {size} role='img' aria-label='success by round'>{''.join(lines)}</svg>"


def _row(one: ImprovementRound) -> str:
    """Return the row of one round."""
    low, high = one.interval
    effects = "; ".join(effect.text for effect in one.fitted or one.effects)
    if one.indistinct:
        effects += f" (not distinguished from {', '.join(one.indistinct)})"
    cells = [
        str(one.number),
        str(one.trials),
        f"{one.successes} ({one.rate:.0%})" if one.trials else "-",
        f"{low:.0%} to {high:.0%}" if one.trials else "-",
        one.cause or "-",
        effects or "-",
        one.mend or "-",
        f"{sum(one.seconds) / 60:.1f}",
    ]
    wide = (5, 6)
    return "<tr>" + "".join(
        f"<td{' class=wide' * (k in wide)}>{escape(cell)}</td>" for k, cell in enumerate(cells)
    ) + "</tr>"  # fmt: skip


def _section(one: ImprovementRound, folder: Path) -> str:
    """Return the section of one round: its explanation and its commands."""
    if not one.sentences and not one.commands:
        return ""
    said = "".join(f"<li>{escape(sentence)}</li>" for sentence in one.sentences)
    place = f"round_{one.number}/{EXPLAINED}"
    link = f"<p><a href='{place}'>The explanation with each trial</a></p>" if (folder / place).is_file() else ""
    commands = f"<h3>The same by hand</h3><pre>{escape(chr(10).join(one.commands))}</pre>" if one.commands else ""
    return f"<section><h2>Round {one.number}</h2><ul>{said}</ul>{link}{commands}</section>"


def _commands(title: str, commands: Sequence[str]) -> str:
    """Return a section with commands; nothing where there are none."""
    if not commands:
        return ""
    return f"<section><h2>{title}</h2><pre>{escape(chr(10).join(commands))}</pre></section>"
