import numpy as np
import pytest

from concent_warp.comparison.bootstrap import (
    BootstrapCfg,
    _autocorrelation_time,
    _block_length,
    _resampled_demonstrations,
    effective_count,
    mean_interval,
)

WHOLE = BootstrapCfg.min_demonstrations


def autoregressive(rng, n, keep):
    """A first-order autoregressive series of unit variance; its autocorrelation time is (1 + keep) / (1 - keep)."""
    series = np.zeros(n)
    series[0] = rng.normal()
    for i in range(1, n):
        series[i] = keep * series[i - 1] + np.sqrt(1 - keep**2) * rng.normal()
    return series


@pytest.mark.parametrize("keep", [0.0, 0.5, 0.9])
def test_autocorrelation_time_is_that_of_the_process(keep):
    rng = np.random.default_rng(1)
    found = np.mean([_autocorrelation_time(autoregressive(rng, 4000, keep)) for _ in range(10)])
    assert found == pytest.approx((1 + keep) / (1 - keep), rel=0.15)


def test_blocks_are_longer_for_slower_errors_and_at_most_a_quarter():
    rng = np.random.default_rng(2)
    fast, slow = (_block_length(autoregressive(rng, 2000, keep)) for keep in (0.0, 0.95))
    assert slow > 3 * fast
    assert _block_length(np.linspace(0, 1, 100)) <= 25


@pytest.mark.parametrize("keep", [0.0, 0.9])
def test_interval_covers_the_true_mean_about_as_often_as_stated(keep):
    rng = np.random.default_rng(3)
    hits = 0
    for _ in range(120):
        low, high = mean_interval([5 + autoregressive(rng, 600, keep)])
        hits += low <= 5 <= high
    assert hits / 120 >= 0.85


def test_interval_that_ignored_autocorrelation_would_be_several_times_narrower():
    series = autoregressive(np.random.default_rng(4), 2000, 0.95)
    low, high = mean_interval([series])
    naive = 2 * 1.96 * series.std() / np.sqrt(len(series))
    assert high - low > 3 * naive


def test_effective_count_of_independent_samples_is_near_their_number():
    parts = [np.random.default_rng(5).normal(size=500) for _ in range(2)]
    assert 700 < effective_count(parts) <= 1000


def test_of_many_demonstrations_whole_ones_are_resampled():
    rng = np.random.default_rng(6)
    parts = [np.full(50, level) for level in rng.normal(10, 1, WHOLE)]
    low, high = mean_interval(parts)
    spread = np.std([p[0] for p in parts]) / np.sqrt(WHOLE)
    assert high - low == pytest.approx(4 * spread, rel=0.35)
    few_low, few_high = mean_interval(parts[: WHOLE - 1])
    assert few_high - few_low < 1e-9


def test_demonstrations_count_by_their_samples():
    parts = [np.zeros(90), np.ones(10)]
    means = _resampled_demonstrations(parts, np.random.default_rng(0), 2000)
    assert set(np.round(means, 6)) == {0.0, 0.1, 1.0}


def test_level_and_least_number_of_samples_are_settings():
    parts = [np.random.default_rng(8).normal(size=100)]
    low, high = mean_interval(parts)
    inner_low, inner_high = mean_interval(parts, cfg=BootstrapCfg(level=0.5))
    assert low < inner_low < inner_high < high
    assert np.isnan(mean_interval(parts, cfg=BootstrapCfg(min_samples=101))).all()


def test_interval_is_the_same_on_every_call():
    series = np.random.default_rng(7).normal(size=100)
    assert mean_interval([series]) == mean_interval([series])
    assert mean_interval([series]) != mean_interval([series], seed=1)


def test_too_few_samples_have_no_interval_and_infinite_ones_an_infinite_interval():
    assert np.isnan(mean_interval([np.ones(3)])).all()
    assert np.isnan(mean_interval([])).all()
    assert mean_interval([np.array([1.0] * 20 + [np.inf])]) == (np.inf, np.inf)
