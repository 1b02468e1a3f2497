"""Results of diagnoses, compared."""

from __future__ import annotations

from typing import Any

import pytest


def assert_same(found: Any, expected: Any) -> None:
    """Compare results in JSON: all exactly, but numbers to 1e-9, for their last digits depend on where arrays lie."""
    assert type(found) is type(expected)
    if isinstance(found, dict):
        assert found.keys() == expected.keys()
        for key, value in found.items():
            assert_same(value, expected[key])
    elif isinstance(found, list):
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            assert_same(one, other)
    elif isinstance(found, float):
        assert found == pytest.approx(expected, rel=1e-9, nan_ok=True)
    else:
        assert found == expected
