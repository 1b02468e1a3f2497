"""Settings and constants are those that are written down, and what holds data cannot be changed by accident.

One that is changed on purpose is written down by ``python -m tests.test_settings``.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import concent_warp

WRITTEN = Path(__file__).with_name("default_settings.json")
WRITTEN_CONSTANTS = Path(__file__).with_name("default_constants.json")
ELSEWHERE = ("kernels", "train", "render")
"""Packages of the library whose folders lie beside that of the others."""
CHANGED_IN_PLACE = {
    "Descent",
    "WorldLog",
    "ViewerControls",
    "PlyElement",
    "VariantResult",
    "ResetCandidate",
    "SearchRecord",
    "RunFolder",
    "Iteration",
    "_Claims",
    "TrackCheckpoint",
    "Matches",
}
"""Dataclasses that hold a state, or that grow while they are filled."""


def modules() -> Iterator[Any]:
    """Yield the modules of the library, each once."""
    paths = {"concent_warp.": list(concent_warp.__path__)}
    for package in ELSEWHERE:
        paths[f"concent_warp.{package}."] = list(importlib.import_module(f"concent_warp.{package}").__path__)
    names = [found.name for prefix, path in paths.items() for found in pkgutil.walk_packages(path, prefix)]
    for name in dict.fromkeys(names):
        if not name.endswith("__main__"):
            yield importlib.import_module(name)


def dataclasses_of_the_library() -> Iterator[tuple[str, Any]]:
    """Yield "room.Class" and each dataclass of the library, in order of modules."""
    for module in modules():
        for name, kind in vars(module).items():
            if isinstance(kind, type) and dataclasses.is_dataclass(kind) and kind.__module__ == module.__name__:
                yield f"{module.__name__.split('.')[1]}.{name}", kind


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


def is_number(value: Any) -> bool:
    """Return whether a value is a number or a tuple of numbers."""
    if isinstance(value, tuple):
        return bool(value) and all(map(is_number, value))
    return isinstance(value, bool | int | float)


def functions_of(kind: Any) -> Iterator[tuple[str, Any]]:
    """Yield qualified name and function of what a module or a class defines, those of its classes as well."""
    module = kind.__name__ if inspect.ismodule(kind) else kind.__module__
    for value in list(vars(kind).values()):
        function = getattr(value, "__func__", value)
        if getattr(function, "__module__", None) != module:
            continue
        if inspect.isfunction(function):
            yield function.__qualname__, function
        elif inspect.isclass(function):
            yield from functions_of(function)


def class_attributes(module: Any) -> Iterator[tuple[str, Any]]:
    """Yield qualified name and value of the numbers that a module's classes declare, dataclasses left out."""
    for name, kind in vars(module).items():
        if inspect.isclass(kind) and kind.__module__ == module.__name__ and not dataclasses.is_dataclass(kind):
            yield from ((f"{name}.{key}", v) for key, v in vars(kind).items() if key[0] != "_" and is_number(v))


def constants() -> dict[str, Any]:
    """Return the numbers among constants, attributes of classes, default values of functions and of dataclasses.

    Those of settings are left out.
    """
    found: dict[str, Any] = {}
    for module in modules():
        room = module.__name__.removeprefix("concent_warp.")
        if room.startswith("cli."):
            continue
        for name, value in vars(module).items():
            if name.strip("_").isupper() and name != "TYPE_CHECKING" and is_number(value):
                found[f"{room}.{name}"] = plain(value)
        for name, value in class_attributes(module):
            found[f"{room}.{name}"] = plain(value)
        for name, function in functions_of(module):
            if name.endswith("Cfg.__init__"):
                continue
            for parameter in inspect.signature(function).parameters.values():
                if is_number(parameter.default):
                    found[f"{room}.{name}({parameter.name})"] = plain(parameter.default)
    return found


def test_constants_and_default_values_are_those_that_are_written_down():
    written, found = json.loads(WRITTEN_CONSTANTS.read_text()), constants()
    assert len(set(written) & set(found)) > 300
    different = {name: value for name, value in found.items() if written.get(name, value) != value}
    assert not different, "if this is on purpose: python -m tests.test_settings"


def test_default_settings_are_those_that_are_written_down():
    written, found = json.loads(WRITTEN.read_text()), defaults()
    assert len(found) > 30
    different = {
        name: {key: value for key, value in values.items() if written.get(name, {}).get(key, "missing") != value}
        for name, values in found.items()
    }
    different = {name: values for name, values in different.items() if values}
    assert not different, "if this is on purpose: python -m tests.test_settings"


def test_what_has_data_is_frozen():
    found = dict(dataclasses_of_the_library())
    assert len(found) > 150
    loose = {name.split(".")[1] for name, kind in found.items() if not kind.__dataclass_params__.frozen}
    assert loose <= CHANGED_IN_PLACE


def test_methods_take_an_object_a_class_or_neither():
    wrong = []
    for module in modules():
        for kind in vars(module).values():
            if not inspect.isclass(kind) or kind.__module__ != module.__name__:
                continue
            for name, value in vars(kind).items():
                function = getattr(value, "__func__", value)
                own = f"{kind.__qualname__}.{name}"
                if not inspect.isfunction(function) or function.__qualname__ != own or name.startswith("__"):
                    continue
                first = next(iter(inspect.signature(function).parameters), None)
                expected = "cls" if isinstance(value, classmethod) else "self"
                if (first == expected) == isinstance(value, staticmethod):
                    wrong.append(f"{module.__name__}.{kind.__name__}.{name}")
    assert not wrong


if __name__ == "__main__":
    WRITTEN.write_text(json.dumps(defaults(), indent=1, sort_keys=True) + "\n")
    WRITTEN_CONSTANTS.write_text(json.dumps(constants(), indent=1, sort_keys=True) + "\n")
