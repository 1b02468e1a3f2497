"""Fits that are made up, for tests of the procedure of a diagnosis step by step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.procedure import Procedure
from concent_warp.diagnosis.result import Finding
from concent_warp.diagnosis.search import consistency
from concent_warp.diagnosis.tasks import TaskRunner
from concent_warp.fit.effects.cfg import EffectSolverCfg
from concent_warp.fit.effects.intervals import FittedParameter
from tests.scenes.swinging import drawing, swung

RECORDING = swung(seconds=0.5)


MODEL = drawing(RECORDING)


def finding(name: str, gain: float, *, accepted: bool = True, step: int = 0, reason: str = "") -> Finding:
    """Return the evidence of an effect."""
    return Finding(name, (), "", (), gain, gain, gain, 0.0, 0.0, accepted, step, (), reason)


GIVEN, FINER = 0.01, 0.002
"""Time step of the model as given and a shorter one [s]."""


def node(
    ratio: float, errors: float = 1.0, effects: int = 0, name: str = "", timestep: float = GIVEN, nominal: int = 0
) -> Any:
    """Return a fitted model: some nominal values come before its effects."""
    added = [
        SimpleNamespace(effect=SimpleNamespace(nominal=k < nominal, variables=())) for k in range(nominal + effects)
    ]
    model = SimpleNamespace(effects=added, name=name, scene=MODEL.scene)
    # Residuals of one size, beyond the limit of the robust loss nowhere.
    piece = SimpleNamespace(residual=np.full(4, float(ratio)))
    window = SimpleNamespace(readings=[SimpleNamespace(channel="angle", rows=slice(0, 4))], defect=None)
    return SimpleNamespace(
        ratio=ratio, noise_ratio=10 * ratio, errors=np.array([errors / 2] * 2), model=model, windows=[window],
        fit=SimpleNamespace(offsets="o", cost=errors, values=np.zeros(0)), pieces=[piece], cfg=EffectSolverCfg(),
        timestep=timestep,
        limit=1e9, noise_scale=1.0, effect=None,
        prediction=lambda _effect: SimpleNamespace(owned=0, parameters=()),
        delivered=SimpleNamespace(name=f"delivered {name}", timestep=timestep),
    )  # fmt: skip


def procedure(**changes: Any) -> Any:
    """Return a procedure, with settings; it replays nothing without `explain`: made-up models cannot be simulated.

    Nor have they friction of their own.
    """
    made = Procedure(MODEL, RECORDING, replace(DiagnoseCfg(jobs=1, explain=False), **changes))
    made.seen = []  # pyright: ignore[reportAttributeAccessIssue]
    made.context.runner = TaskRunner(1, lambda share, text: made.seen.append((share, text)))  # pyright: ignore
    made._error_of_own_friction = lambda _: None  # pyright: ignore
    if not made.context.cfg.explain:
        made._replayed = lambda *_: None  # pyright: ignore
    return made


def force_is(monkeypatch: pytest.MonkeyPatch, found: Callable[..., Any]) -> None:
    """Let a function say which force of no known form is found; no effect varies between windows."""
    monkeypatch.setattr(consistency, "unknown_force", found)
    monkeypatch.setattr(consistency, "inconsistent_effect", lambda *_: None)


def interval(low: float, null: float = 0.0) -> FittedParameter:
    """Return a parameter of value 1 with the lower end of its interval."""
    return FittedParameter("size", 1.0, low, 2.0, "", null)


OPEN, CLEAR = interval(-0.1), interval(0.1)
"""A parameter whose interval includes its null value, and one whose interval does not."""
