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
    window = SimpleNamespace(readings=[SimpleNamespace(channel="angle", rows=slice(0, 4))], defect=None, scatter=None)
    return SimpleNamespace(
        ratio=ratio, noise_ratio=10 * ratio, errors=np.array([errors / 2] * 2), model=model, windows=[window],
        fit=SimpleNamespace(offsets="o", cost=errors, values=np.zeros(0)), pieces=[piece], cfg=EffectSolverCfg(),
        timestep=timestep,
        limit=1e9, noise_scale=1.0, effect=None,
        prediction=lambda _effect: SimpleNamespace(owned=0, parameters=()),
        delivered=SimpleNamespace(name=f"delivered {name}", timestep=timestep),
    )  # fmt: skip


class Comparison:
    """Compares made-up fits beside nominal values by errors that it is given."""

    sensitivities: Any = "shared"

    def __init__(self, base: Any, left: dict[str, np.ndarray] | None = None, *, decides: bool = False) -> None:
        """Compare fits for a model, by default as where all is so far off that nominal values say nothing.

        Args:
            base: The model.
            left: What is left beside nominal values, a residual of size 1 in all; by default the errors themselves.
            decides: Whether candidates are to be compared so.
        """
        self.base, self.left, self.decides = base, left or {}, decides

    def errors(self, one: Any) -> np.ndarray:
        """Return what a fit leaves, by its name."""
        left = self.left.get(one.name if hasattr(one, "name") else one.model.name)
        return one.errors if left is None else left

    def ratio(self, one: Any) -> float:
        """Return the same as a root mean square."""
        return float(np.sqrt(self.errors(one).sum())) if self.left else np.inf

    def tells(self, _candidates: Any, _cfg: Any) -> bool:
        """Return whether candidates are to be compared so."""
        return self.decides

    def promoted(self, screened: Any, _cfg: Any) -> Any:
        """Return candidates as they are."""
        return screened


def procedure(**changes: Any) -> Any:
    """Return a procedure, with settings; it replays nothing without `explain`: made-up models cannot be simulated.

    Nor have they friction of their own.
    """
    made = Procedure(MODEL, RECORDING, replace(DiagnoseCfg(jobs=1, explain=False), **changes))
    made.seen = []  # pyright: ignore[reportAttributeAccessIssue]
    made.context.runner = TaskRunner(1, lambda share, text: made.seen.append((share, text)))  # pyright: ignore
    made._error_of_own_friction = lambda _: None  # pyright: ignore
    made.context.beside_nominal = Comparison  # pyright: ignore
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
