"""Intervals of fitted parameters against their formulas, on sums of a few blocks written by hand."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.effects.effect import Parameter
from concent_warp.effects.library.contact import ContactCompliance
from concent_warp.effects.library.drives import ActuatorDelay, ActuatorLag
from concent_warp.effects.library.joints import JointFriction
from concent_warp.effects.library.measurement import Latency, LengthScale
from concent_warp.fit.effects.cross_validation import Blocks, Sums
from concent_warp.fit.effects.intervals import (
    FittedParameter,
    clustered_std,
    covariance,
    discretisation_errors,
    excludes_null,
    formula_errors,
)
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


def test_the_scatter_of_friction_adds_to_the_error_of_its_formula():
    (p,) = parameters = (Parameter("torque", "N m", 0.0, 0.0, 9.0, 0.5),)
    (friction,) = formula_errors(JointFriction("a"), parameters, np.array([2.0]), 0.005)
    assert friction == pytest.approx(2.0 * np.hypot(0.005, 0.03))
    two = (p, Parameter("torque", "N m", 0.0, 0.0, 99.0, 20.0))
    each = formula_errors(JointFriction("a", "b"), two, np.array([2.0, 8.0]), 0.0)
    assert each == pytest.approx([0.03 * 2.0, 0.03 * 8.0])
    (exact,) = formula_errors(LengthScale("a"), (p,), np.array([2.0]), 0.005)
    assert exact == pytest.approx(2.0 * 0.005)


@pytest.mark.parametrize("kind", [ActuatorDelay, ActuatorLag, Latency])
def test_a_delay_is_no_better_known_than_half_a_time_step(kind):
    (p,) = parameters = (Parameter("delay", "s", 0.0, 0.0, 0.3, 0.02),)
    (error,) = formula_errors(kind("a"), parameters, np.array([0.09]), 0.0, 0.004)
    assert 1.96 * error == pytest.approx(0.002, rel=0.03)
    assert formula_errors(kind("a"), parameters, np.array([0.09]), 0.0) == [0.0]
    assert formula_errors(LengthScale("a"), (p,), np.array([0.09]), 0.0, 0.004) == [0.0]


SETTLING = """<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 .1" solref="0.02 0.4"/>
    <body name="ball" pos="0 0 1"><freejoint/><geom size=".05" solref="0.02 0.4"/></body>
  </worldbody>
</mujoco>"""


def test_values_that_a_model_states_roughly_are_uncertain_even_where_they_are_not_changed():
    compliance = ContactCompliance("ball")
    parameters = compliance.parameters(mujoco.MjModel.from_xml_string(SETTLING))
    null = np.array([p.null for p in parameters])
    np.testing.assert_allclose(null, [0.02, 0.4])
    np.testing.assert_allclose(formula_errors(compliance, parameters, null, 0.0), 0.025 * null)
    # Of the changed value, the error of discretisation counts as well: half a percent of the larger deviation.
    changed = formula_errors(compliance, parameters, np.array([0.02, 0.2]), 0.005)
    scale = np.array([p.scale for p in parameters])
    assert changed == pytest.approx(np.hypot(0.005 * 0.2 * scale / scale[1], 0.025 * null))
    own = formula_errors(JointFriction("a"), parameters[:1], null[:1], 0.0)
    assert own == pytest.approx([0.0])


def test_a_limit_that_is_infinite_by_default_adds_no_error_of_its_null_value():
    limit = (Parameter("limit", "N", np.inf, 0.0, np.inf, 2.0),)
    found = formula_errors(ContactCompliance("ball"), limit, np.array([4.0]), 0.005)
    assert found == pytest.approx([0.005 * 4.0])


def test_scores_that_are_alike_in_neighbouring_blocks_widen_the_interval():
    count = 48
    alike = [*([10.0] * 12), *([-10.0] * 12)] * 2
    turning = [10.0, -10.0] * (count // 2)
    blocks = blocks_of(count)
    few = clustered_std(sums_of(100.0, turning), blocks)[0] ** 2 / covariance(sums_of(100.0, turning), blocks)[0, 0]
    assert 1.0 < few < 1.1
    wide = clustered_std(sums_of(100.0, alike), blocks)[0] ** 2 / covariance(sums_of(100.0, alike), blocks)[0, 0]
    lags, total = 3, 0.0  # 4 (48 / 100)^(2/9) = 3.4
    for k in range(1, lags + 1):
        total += 2 * (1 - k / 4) * sum(a * b for a, b in zip(alike[k:], alike[:-k], strict=True)) / (count * 100.0)
    assert wide / few == pytest.approx(1 + total)
    assert wide / few > 2.5


def test_blocks_of_different_demonstrations_are_no_neighbours():
    slope = [*([10.0] * 12), *([-10.0] * 12)] * 2
    apart = Blocks((), np.arange(48) % 2, np.arange(48), np.arange(48.0), np.arange(48.0) + 1)
    near, far = clustered_std(sums_of(100.0, slope), blocks_of(48)), clustered_std(sums_of(100.0, slope), apart)
    assert far[0] < near[0]


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


def alike(residual: np.ndarray) -> Sums:
    """Return the sums of two parameters of which the residuals show the sum only, ten blocks of some rows."""
    motion = np.random.default_rng(0).normal(0, 300.0, len(residual))
    j, r = np.stack([motion, motion], axis=1).reshape(10, -1, 2), residual.reshape(10, -1)
    return Sums(np.einsum("bri,brj->bij", j, j), np.einsum("bri,br->bi", j, r), (r**2).sum(axis=1))


def test_parameters_that_stand_in_for_one_another_are_uncertain_one_by_one_but_not_in_sum():
    found = covariance(alike(np.random.default_rng(1).normal(0, 5, 500)), blocks_of(10))
    assert np.linalg.eigvalsh(found).min() >= -1e-9 * np.abs(found).max()
    assert np.diag(found) == pytest.approx([PRIOR**2 / 2] * 2, rel=0.01)
    assert found.sum() < 1e-3
    fitted = [FittedParameter(n, v, 0.0, v + 14, "N", 0.0) for n, v in (("left", 0.3), ("right", 0.0))]
    assert not any(q.excludes_null for q in fitted)
    assert excludes_null(fitted, found, 0.1)
    assert not excludes_null(fitted, np.diag(np.diag(found)), 0.1)
    absent = [replace(q, value=0.0) for q in fitted]
    assert not excludes_null(absent, found, 0.1)
    limit = FittedParameter("limit", np.inf, np.inf, np.inf, "N", np.inf)
    assert not excludes_null([limit, limit], np.eye(2), 0.1)


def test_many_dependent_parameters_of_an_absent_effect_seldom_exclude_their_null_values():
    rng, count = np.random.default_rng(0), 6
    covered = np.full((count, count), 0.95) + 0.05 * np.eye(count)
    hits = np.zeros(2)
    for values in rng.multivariate_normal(np.zeros(count), covered, size=1000):
        fitted = [FittedParameter("a", v, v - 1.96, v + 1.96, "N", 0.0) for v in values]
        one_by_one = any(q.excludes_null for q in fitted)
        hits += one_by_one, not one_by_one and excludes_null(fitted, covered, 0.1)
    assert hits[1] < 50  # of 1000, at 95 %
