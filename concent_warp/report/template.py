"""Pages as one file: templates with their parts, and data for scripts."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Any

from concent_warp.comparison.result import finite


def page_file(name: str) -> str:
    """Return a file of the pages that comes with this package."""
    return files("concent_warp.report").joinpath("page", name).read_text(encoding="utf-8")


def filled(template: str, parts: Mapping[str, str]) -> str:
    """Return a template with every ``[[name]]`` replaced, in one pass: inserted text is not searched."""
    return re.sub(r"\[\[(\w+)\]\]", lambda found: parts[found[1]], template)


def options(names: Sequence[str]) -> str:
    """Return the options of a list to choose from."""
    return "".join(f'<option value="{escape(name)}">{escape(name)}</option>' for name in names)


def script_json(data: Any) -> str:
    """Return data as JSON that cannot end the script element that it stands in; numbers not finite are null."""
    text = json.dumps(finite(data), allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
