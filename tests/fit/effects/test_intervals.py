"""Intervals of fitted parameters against their formulas, on sums of a few blocks written by hand."""

import numpy as np
import pytest

from concent_warp.effects.effect import Parameter
from concent_warp.fit.effects.cross_validation import Blocks, Sums
from concent_warp.fit.effects.intervals import FittedParameter, covariance, discretisation_errors
from concent_warp.fit.effects.least_squares import LeastSquaresCfg

PRIOR = LeastSquaresCfg.prior


def blocks_of(count: int) -> Blocks:
    at = np.arange(count, dtype=float)
    return Blocks((), np.arange(count) % 2, np.zeros(count, int), at, at + 1)


def sums_of(normal: float, slope: list[float]) -> Sums:
    """Return the sums of one parameter whose curvature is shared evenly by the blocks."""
    count = len(slope)
    return Sums(np.full((count, 1, 1), normal / count), np.array(slope)[:, None], np.ones(count))


def test_covariance_is_the_sandwich_of_the_blocks_scores():
    slope = [30.0, -30.0, 10.0, -10.0]
    found = covariance(sums_of(100.0, slope), blocks_of(4))
    curvature = 100.0 + 1 / PRIOR**2
    assert found.shape == (1, 1)
    assert found[0, 0] == pytest.approx(np.square(slope).sum() / curvature**2 * 4 / 3)


def test_a_slope_that_all_blocks_share_does_not_widen_the_interval():
    slope = np.array([30.0, -30.0, 10.0, -10.0])
    shifted = covariance(sums_of(100.0, list(slope + 7.0)), blocks_of(4))
    np.testing.assert_allclose(shifted, covariance(sums_of(100.0, list(slope)), blocks_of(4)))


def test_variance_is_not_below_that_of_independent_noise():
    found = covariance(sums_of(100.0, [0.1, -0.1, 0.0, 0.0]), blocks_of(4))
    assert found[0, 0] == pytest.approx(1 / (100.0 + 1 / PRIOR**2))


def test_a_parameter_that_nothing_depends_on_keeps_the_width_of_its_prior():
    slope = np.array([[20.0, 0.0], [-20.0, 0.0], [5.0, 0.0], [-5.0, 0.0]])
    normal = np.zeros((4, 2, 2))
    normal[:, 0, 0] = 25.0
    found = covariance(Sums(normal, slope, np.ones(4)), blocks_of(4))
    assert found[1, 1] == pytest.approx(PRIOR**2)
    assert found[0, 1] == 0.0
    assert found[0, 0] == pytest.approx((2 * 20.0**2 + 2 * 5.0**2) / (100 + 1 / PRIOR**2) ** 2 * 4 / 2)


def test_correlation_stays_where_a_variance_is_raised_to_that_of_the_noise():
    rng = np.random.default_rng(0)
    jacobian = rng.normal(size=(40, 2)) @ np.array([[1.0, 0.6], [0.0, 0.5]])
    normal = np.einsum("bi,bj->bij", jacobian, jacobian)
    slope = jacobian * rng.normal(0, 0.1, (40, 1))
    found = covariance(Sums(normal, slope, np.ones(40)), blocks_of(40))
    inverse = np.linalg.inv(normal.sum(axis=0) + np.eye(2) / PRIOR**2)
    np.testing.assert_allclose(np.diag(found), np.diag(inverse))
    centred = slope - slope.mean(axis=0)
    robust = inverse @ centred.T @ centred @ inverse
    expected = robust[0, 1] / np.sqrt(robust[0, 0] * robust[1, 1])
    assert found[0, 1] / np.sqrt(found[0, 0] * found[1, 1]) == pytest.approx(expected)


def test_the_formulas_own_error_is_half_a_percent_of_the_largest_deviation():
    parameters = (Parameter("a", "N", 1.0, 0.0, 9.0, 0.5), Parameter("b", "s", np.inf, 0.0, np.inf, 2.0))
    found = discretisation_errors(parameters, np.array([2.0, np.inf]), 0.005)
    np.testing.assert_allclose(found, 0.005 * np.array([0.5, 2.0]) * (2.0 - 1.0) / 0.5)
    found = discretisation_errors(parameters, np.array([0.5, 6.0]), 0.005)
    np.testing.assert_allclose(found, 0.005 * np.array([0.5, 2.0]) * 6.0 / 2.0)


@pytest.mark.parametrize(
    ("low", "high", "null", "excluded"),
    [
        (0.1, 0.3, 0.0, True),
        (-0.1, 0.3, 0.0, False),
        (0.0, 0.3, 0.0, False),
        (-0.3, 0.0, 0.0, False),
        (0.5, 0.9, 1.0, True),
        (1.0, 4.0, np.inf, True),
        (1.0, np.inf, np.inf, False),
    ],
)
def test_an_interval_excludes_the_null_value_where_it_does_not_reach_it(low, high, null, excluded):
    assert FittedParameter("a", 0.5 * low, low, high, "N", null).excludes_null is excluded
