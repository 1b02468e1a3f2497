"""Residuals that are noise only because the scatter of simulated contacts counts as such."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.search.adequacy import qualified_by_noise, rests_on_scatter
from concent_warp.fit.effects.observation import NumericalScatter, Window
from tests.diagnosis.made_up import node
from tests.diagnosis.test_uncertain_noise import answer

WIDE = np.full((4, 1), 5.0)


def fitted(noise_ratio: float, residual: float, scatter: NumericalScatter | None, common: Any = None) -> Any:
    """Return a fitted model that leaves a residual over noise and scatter."""
    one = node(noise_ratio)
    one.noise_ratio = noise_ratio
    window = one.windows[0]
    window.scatter, window.common = scatter, common
    window.without_scatter = partial(Window.without_scatter, window)
    one.fit.linear = [SimpleNamespace(residual=np.full(4, residual))]
    return one


@pytest.mark.parametrize(
    ("noise_ratio", "residual", "scatter", "common", "rests"),
    [
        (0.8, 0.8, NumericalScatter(WIDE), None, True),
        (0.8, 0.8, NumericalScatter(WIDE), WIDE, False),  # what readings have in common is stated noise
        (0.8, 0.8, None, None, False),
        (0.8, 0.1, NumericalScatter(WIDE), None, False),  # little is left without it, too
        (3.0, 3.0, NumericalScatter(WIDE), None, False),  # far more than noise is left
    ],
)
def test_residuals_rest_on_scatter_where_they_are_more_than_noise_without_it(
    noise_ratio, residual, scatter, common, rests
):
    one = fitted(noise_ratio, residual, scatter, common)
    assert rests_on_scatter(one, DiagnoseCfg()) is rests
    assert qualified_by_noise(answer("none_needed", doubtful=None), one, {}, DiagnoseCfg()).rests_on_scatter is rests
