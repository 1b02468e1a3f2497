"""The public interface: every name is there, is documented, and its example runs."""

from __future__ import annotations

import doctest
import inspect
import subprocess
import sys

import pytest

import concent_warp as cw
from concent_warp.cli.terminal import quiet_warp

NAMES = [name for name in cw.__all__ if not name.startswith("_")]


def public(name: str) -> object:
    """Return what a public name stands for; of a module that is called, the function."""
    found = getattr(cw, name)
    return found._function if inspect.ismodule(found) else found


@pytest.mark.parametrize("name", NAMES)
def test_public_name_is_documented_with_an_example_that_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    quiet_warp()
    found = public(name)
    text = inspect.getdoc(found)
    assert text
    assert ">>> " in text, "no example"
    example = doctest.DocTestParser().get_doctest(text, {}, name, None, None)
    said: list[str] = []
    result = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example, out=said.append)
    assert result.failed == 0, "".join(said)


def test_functions_take_settings_second_and_the_rest_by_keyword():
    for name in NAMES:
        found = public(name)
        if not inspect.isfunction(found) or name.startswith(("load_", "write_", "effect_", "example")):
            continue
        parameters = list(inspect.signature(found).parameters.values())
        positional = [p.name for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
        data = [p for p in positional if p != "cfg"]
        assert positional in (data, [*data, "cfg"]), name
        assert len(data) <= 2, name
        assert {"progress", "serving"} & {p.name for p in parameters if p.kind is p.KEYWORD_ONLY}, name


def test_functions_that_share_their_name_with_a_sub_package_can_be_called_whatever_was_imported_before():
    code = """
import inspect
import concent_warp.train.cfg, concent_warp.render.cameras
import concent_warp as cw
from concent_warp import render
assert "events" in inspect.signature(cw.train).parameters
assert "format" in inspect.signature(render).parameters
assert cw.train.cfg.TrainCfg is cw.TrainCfg
assert "truth" in inspect.signature(cw.ground).parameters
"""
    found = subprocess.run([sys.executable, "-c", code], timeout=60, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr


def test_listed_names_are_those_that_type_checkers_see():
    source = inspect.getsource(cw).split("if TYPE_CHECKING:")[1].split("def __getattr__")[0]
    assert sorted(NAMES) == sorted(name for name in NAMES if name in source)


def test_unknown_names_are_refused():
    with pytest.raises(AttributeError, match="no attribute 'simulate_everything'"):
        _ = cw.simulate_everything
