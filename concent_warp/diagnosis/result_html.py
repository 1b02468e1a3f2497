"""A diagnosis as HTML for notebooks."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

HEADER = ("effect", "parameter", "value", "95 % interval", "unit", "held-out error removed", "p")


def diagnosis_html(headline: str, rows: Sequence[Sequence[str]], sentences: Sequence[str]) -> str:
    """Return a headline, a table with the columns `HEADER` where there are rows, and sentences as escaped HTML."""
    parts = [f"<p><b>{escape(headline)}</b></p>"]
    if rows:
        head = "".join(f"<th>{escape(name)}</th>" for name in HEADER)
        body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
        parts.append(f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>")
    parts += [f"<p>{escape(sentence)}</p>" for sentence in sentences]
    return f"<div>{''.join(parts)}</div>"
