"""Limits and the page that documents them."""

import re
from dataclasses import fields
from pathlib import Path

import pytest

from concent_warp.limits import Limits, limits, variable


def test_the_page_has_the_limits_as_they_are(root: Path):
    page = (root / "docs" / "recording.md").read_text()
    rows = dict(re.findall(r"\| `CONCENT_MAX_(\w+)` \| ([^|]+) \|", page))
    assert len(rows) >= 15
    units = {"GiB": 1 << 30, "MiB": 1 << 20, "s": 1}
    for name, text in rows.items():
        number, _, unit = text.strip().partition(" ")
        assert getattr(Limits(), name.lower()) == float(number.replace(",", "")) * units.get(unit, 1), name


@pytest.mark.parametrize("name", [field.name for field in fields(Limits)])
def test_each_limit_is_raised_by_its_variable(monkeypatch, name):
    default = getattr(Limits(), name)
    monkeypatch.setenv(variable(name), str(2 * default))
    assert getattr(limits(), name) == 2 * default
    assert type(getattr(limits(), name)) is type(default)
