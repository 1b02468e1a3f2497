import numpy as np
import pytest

from concent_warp.fit.effects.robust import RobustLossCfg, cauchy_cost, cauchy_weight, huber, huber_limit, huber_weight

HUBER = RobustLossCfg.residual_limit


def test_the_loss_is_quadratic_and_then_linear():
    assert huber(np.array([2.0, -2.0, 10.0]), 4.0).tolist() == [2.0, 2.0, 32.0]
    assert huber_weight(np.array([2.0, -8.0]), 4.0).tolist() == [1.0, 0.5]
    rng = np.random.default_rng(0)
    assert huber_limit([rng.normal(0, 0.1, 1000)]) == HUBER
    assert huber_limit([rng.normal(0, 10.0, 10000)]) == pytest.approx(10 * HUBER, rel=0.05)


def test_the_prior_of_an_initial_state_and_its_weights_belong_together():
    o, h = np.array([0.1, -1.0, 4.0, -30.0]), 1e-6
    slope = [(cauchy_cost(o + h * e) - cauchy_cost(o - h * e)) / (2 * h) for e in np.eye(4)]
    np.testing.assert_allclose(cauchy_weight(o) * o, slope, rtol=1e-6)
    assert cauchy_cost(np.array([0.01])) == pytest.approx(0.5 * 0.01**2, rel=1e-4)
    assert cauchy_cost(np.array([100.0])) < 20.0


def test_a_weight_times_the_residual_is_the_slope_of_the_loss():
    r, h = np.array([0.5, -3.9, 4.1, -50.0]), 1e-6
    slope = (huber(r + h, HUBER) - huber(r - h, HUBER)) / (2 * h)
    np.testing.assert_allclose(huber_weight(r, HUBER) * r, slope, rtol=1e-6)
