"""Whether a fitted model leaves no more than noise, with fits that are made up."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.search.adequacy import discrepancies, hidden_by_noise, is_adequate, is_lacking
from concent_warp.estimation.noise import Noise
from tests.diagnosis.made_up import node


def test_large_residuals_that_a_model_explains_are_no_outliers():
    one, first = node(1.0), node(3.0)
    one.limit = 4.0
    one.pieces[0].residual = np.array([1.0, -1.0, 2.0, 100.0])
    first.pieces[0].residual = np.array([20.0, -1.0, 2.0, 100.0])
    left, lacked = discrepancies(one, first)
    outlier = 2 * 4.0 * (100.0 - 2.0)
    assert left == pytest.approx((1 + 1 + 4 + outlier) / 4 - 1)
    assert lacked == pytest.approx((400 + 1 + 4 + outlier) / 4 - 1)
    first.pieces[0].residual, first.limit = np.array([3.0, 8.0]), 5.0
    assert discrepancies(one, first)[1] == pytest.approx((9 + 2 * 5.0 * (8.0 - 2.5)) / 2 - 1)


def test_one_channel_that_the_model_misses_is_not_outweighed_by_others():
    one = node(0.5)
    (window,), (piece,) = one.windows, one.pieces
    window.readings = [SimpleNamespace(channel=c, rows=slice(k, k + 1)) for k, c in enumerate("abcd")]
    for worst, adequate in ((1.49, True), (1.51, False)):
        piece.residual = np.array([0.5, 0.5, 0.5, worst])
        assert is_adequate(one, {}, DiagnoseCfg()) == adequate
    assert is_adequate(one, {"d": 1.02}, DiagnoseCfg())
    piece.residual = np.full(4, 1.26)
    assert not is_adequate(one, {}, DiagnoseCfg())


def test_the_unit_of_residuals_decides_neither_what_is_left_nor_what_is_lacking():
    factors, cfg = {"angle": 1.2}, DiagnoseCfg()
    for ratio in (1.22, 1.24, 1.45, 1.51):
        plain, first = node(ratio), node(9.0)
        scaled, first_scaled = node(ratio), node(9.0)
        for one, scale in ((scaled, 4.0), (first_scaled, 2.0)):
            one.pieces[0].residual, one.noise_scale = one.pieces[0].residual / scale, scale
        assert discrepancies(scaled, first_scaled) == pytest.approx(discrepancies(plain, first))
        assert is_adequate(scaled, factors, cfg) == is_adequate(plain, factors, cfg) == (ratio < 1.5)
        assert is_lacking(scaled, factors, cfg) == is_lacking(plain, factors, cfg) == (ratio > 1.23)


@pytest.mark.parametrize(("low", "said"), [(0.6, False), (0.2, True), (0.0, True), (1.0, False)])
def test_residuals_above_the_least_noise_that_the_readings_allow_are_said(low, said):
    one = node(0.8)
    one.windows[0].readings = [SimpleNamespace(channel="angle", rows=slice(0, 1))]
    one.pieces[0].residual = np.array([0.8])
    sentence = hidden_by_noise(one, {"angle": Noise(1e-3, "differences", low * 1e-3, 1.1e-3)}, DiagnoseCfg())
    assert (sentence is not None) == said
    assert hidden_by_noise(node(1.3), {"angle": Noise(1e-3, "differences", 0.0, 1.1e-3)}, DiagnoseCfg()) is None
    if low == 0.2:
        assert sentence is not None
        assert "residuals are 4 x noise" in sentence
