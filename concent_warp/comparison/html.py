"""A comparison as HTML for notebooks: a table of channels, and the spans of largest error in words."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape


def comparison_html(
    header: Sequence[str], rows: Sequence[Sequence[str]], notes: Sequence[str], spans: Sequence[str]
) -> str:
    """Return a table, a paragraph and an ordered list as HTML; all text is escaped.

    Args:
        header: Names of the columns, C of them.
        rows: Cells of each row, C in each.
        notes: Sentences on the table.
        spans: Sentences on spans of time.
    """
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in spans)
    said = f"<p>{escape(' '.join(notes))}</p>" if notes else ""
    return f"<div>{table}{said}{f'<p>Worst spans</p><ol>{items}</ol>' if items else ''}</div>"
