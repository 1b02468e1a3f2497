"""Fits of candidates that are made up."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from concent_warp.fit.effects.cfg import EffectSolverCfg


@dataclass(frozen=True)
class MadeUp:
    """A fit with a gain, a cost and a noise ratio."""

    name: str
    gain: float
    cost: float = 100.0
    ratio: float = 1.2
    polished: bool = False
    std: Any = None
    confusions: tuple[str, ...] = ()
    errors: np.ndarray = field(default_factory=lambda: np.array([1.0]), compare=False)
    value: float = 0.0
    source: Any = None
    """The effect, where it must be one object."""

    @property
    def effect(self) -> Any:
        """The effect, by its name."""
        return self.source or SimpleNamespace(name=self.name, confusions=self.confusions)

    @property
    def fit(self) -> Any:
        """The cost as that of a fit."""
        return SimpleNamespace(cost=self.cost, of=self.name, values=np.array([self.value]))

    def share(self, base: Any) -> float:
        """Return the gain."""
        del base
        return self.gain


def made(*values: Any, **more: Any) -> Any:
    """Return a fit that is made up."""
    return MadeUp(*values, **more)


def base_of(windows: int = 2, length: float = 1.0, ratio: float = 2.0) -> Any:
    """Return a baseline with windows of a length [s] and a noise ratio."""
    cut = [SimpleNamespace(start=0.5, end=0.5 + length, smooth=False)] * windows
    return SimpleNamespace(windows=cut, cfg=EffectSolverCfg(), ratio=ratio)
