"""Fitted models and screened candidates with random residuals and sensitivities."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from concent_warp.diagnosis.candidates.candidate import FittedModel, ScreenedCandidate
from concent_warp.effects.effect import Parameter
from concent_warp.fit.effects.cross_validation import Blocks
from concent_warp.fit.effects.least_squares import Linear

ANY: Any = SimpleNamespace(rough=())
LIMIT = 2.0
ROWS, COUNT = 40, 8


def blocks() -> Blocks:
    """Return blocks of two windows, in four folds."""
    of_row = np.repeat(np.arange(4), ROWS // 4), 4 + np.repeat(np.arange(4), ROWS // 4)
    place = np.arange(COUNT, dtype=float)
    return Blocks(of_row, np.arange(COUNT) % 4, np.zeros(COUNT, int), place, place + 1)


def pieces(seed: int, parameters: int) -> tuple[Linear, ...]:
    """Return random residuals and sensitivities of two windows."""
    rng = np.random.default_rng(seed)
    return tuple(Linear(1.5 * rng.normal(size=ROWS), rng.normal(size=(ROWS, parameters))) for _ in range(2))


class MadeUpModel(FittedModel):
    """A fitted model whose candidates have the parameters of `OneEffect`."""

    def prediction(self, *_: Any, **__: Any) -> Any:
        """Return the parameters."""
        return OneEffect()


def base_of(owned: int = 1, **changes: Any) -> Any:
    """Return a fitted model with random residuals."""
    own = pieces(0, owned)
    bare = cast("Any", SimpleNamespace(effects=()))
    windows = (cast("Any", SimpleNamespace(noise_scale=1.0)),)
    made = MadeUpModel(bare, windows, blocks(), ANY, own, LIMIT, np.zeros(COUNT))
    return replace(made, **{"errors": made.held_out(own).own(), **changes})


def screened_of(seed: int, parameters: int, effect: Any = None, owned: int = 1) -> Any:
    """Return a screened candidate with the baseline's residuals and random sensitivities."""
    parts = tuple(
        replace(p, jacobian=np.hstack([p.jacobian, q.jacobian]))
        for p, q in zip(pieces(0, owned), pieces(seed, parameters), strict=True)
    )
    return ScreenedCandidate(effect, 0.1, 0.0, np.zeros(owned + parameters), parts)


class OneEffect:
    """Stands in for the prediction of a model with a candidate."""

    owned = 1
    parameters = (
        Parameter("own", "-", 0.0, 0.0, 1.0, 1.0),
        Parameter("a", "N", 1.0, -50.0, 50.0, 2.0),
        Parameter("b", "m", 0.0, -1.0, 1.0, 0.5),
        Parameter("c", "-", np.inf, 0.0, 90.0, 3.0),
    )

    def __init__(self, *_: Any, **__: Any) -> None:
        pass
