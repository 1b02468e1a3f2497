"""The commands that mend a cause can be given as they are printed."""

import shlex
from importlib import import_module
from types import SimpleNamespace
from typing import Any, cast

import pytest
import tyro

import concent_warp as cw
from concent_warp.deploy.explain.remedy import remedy
from concent_warp.deploy.explain.result import Cause

FOUND = cast(Any, SimpleNamespace(accepted=[SimpleNamespace(name="joint_friction(joint1, ...)")] * 2))


@pytest.mark.parametrize("better", [None, "out/with effects.toml"])
@pytest.mark.parametrize("free", [None, "out/free motion.h5"])
@pytest.mark.parametrize("cause", ["perception", "physics", "policy", "unexplained"])
def test_commands_are_understood(cause: Cause, free: str | None, better: str | None) -> None:
    lines = remedy(cw.load_policy("shape_sorter"), cause, FOUND, ["my trials.h5"], free, better)
    commands = [shlex.split(line) for line in lines if not line.startswith("#")]
    assert len(commands) >= 2
    for concent, name, *arguments in commands:
        assert concent == "concent"
        module = import_module(f"concent_warp.cli.commands.{name}")
        given = tyro.cli(module.Arguments, args=arguments, config=(tyro.conf.HelptextFromCommentsOff,))
        if name == "diagnose":
            assert given.effects == ("joint_friction",)
            assert [str(path) for path in given.recording] == [free or "my trials.h5"]
        if cause == "physics" and better is not None:
            assert name in ("compare", "train")
            assert str(given.model) == better
