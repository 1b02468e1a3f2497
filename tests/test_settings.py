"""Settings: their defaults are those that are written down, and what holds data cannot be changed by accident.

A default that is changed on purpose is written down by ``python -m tests.test_settings``.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import concent_warp

WRITTEN = Path(__file__).with_name("default_settings.json")
CHANGED_IN_PLACE = {"Descent", "WorldLog", "ViewerControls", "PlyElement", "VariantResult"}
"""Dataclasses that hold a state, or that grow while they are filled."""


def dataclasses_of_the_library() -> Iterator[tuple[str, Any]]:
    """Yield "room.Class" and each dataclass of the library, in order of modules."""
    for module in pkgutil.walk_packages(concent_warp.__path__, "concent_warp."):
        if module.name.endswith("__main__"):
            continue
        found = importlib.import_module(module.name)
        for name, kind in vars(found).items():
            if isinstance(kind, type) and dataclasses.is_dataclass(kind) and kind.__module__ == module.name:
                yield f"{module.name.split('.')[1]}.{name}", kind


def plain(value: Any) -> Any:
    """Return a default as JSON can hold it: other settings by their class, numbers and texts as they are."""
    if dataclasses.is_dataclass(value):
        return type(value).__name__
    return json.loads(json.dumps(value)) if isinstance(value, int | float | str | tuple | list | None) else repr(value)


def defaults() -> dict[str, dict[str, Any]]:
    """Return the defaults of all settings by class and field."""
    found: dict[str, dict[str, Any]] = {}
    for name, kind in dataclasses_of_the_library():
        if name.endswith("Cfg"):
            values = found.setdefault(name, {})
            for field in dataclasses.fields(kind):
                if field.default is not dataclasses.MISSING:
                    values[field.name] = plain(field.default)
                elif field.default_factory is not dataclasses.MISSING:
                    values[field.name] = plain(field.default_factory())
    return found


def test_default_settings_are_those_that_are_written_down():
    written, found = json.loads(WRITTEN.read_text()), defaults()
    assert len(found) > 30
    different = {
        name: {key: value for key, value in values.items() if written.get(name, {}).get(key, "missing") != value}
        for name, values in found.items()
    }
    different = {name: values for name, values in different.items() if values}
    assert not different, "if this is on purpose: python -m tests.test_settings"


def test_what_holds_data_is_frozen():
    found = dict(dataclasses_of_the_library())
    assert len(found) > 150
    loose = {name.split(".")[1] for name, kind in found.items() if not kind.__dataclass_params__.frozen}
    assert loose <= CHANGED_IN_PLACE


if __name__ == "__main__":
    WRITTEN.write_text(json.dumps(defaults(), indent=1, sort_keys=True) + "\n")
