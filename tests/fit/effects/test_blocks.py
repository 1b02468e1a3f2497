"""Blocks, folds and their statistics against plain loops."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.fit.effects.cross_validation import (
    BlockCfg,
    Blocks,
    HeldOut,
    Sums,
    block_sums,
    bootstrap_interval,
    cut_blocks,
    sign_flip_p,
)
from concent_warp.fit.effects.least_squares import Linear
from concent_warp.fit.effects.robust import cauchy_cost, cauchy_weight, huber, huber_limit, huber_weight

PRIOR = 10.0


def window(start: float, end: float, number: int = 0, clock: Any = None) -> Any:
    clock = np.linspace(start, end, 9) if clock is None else np.array(clock)
    return SimpleNamespace(start=start, end=end, number=number, clock=clock)


def test_blocks_are_a_sixtieth_of_the_time_but_not_below_the_shortest():
    long = cut_blocks([window(2.0, 14.0)])
    assert long.count == 60
    np.testing.assert_allclose(long.start, 2.0 + 0.2 * np.arange(60))
    np.testing.assert_allclose(long.end, 2.2 + 0.2 * np.arange(60))
    assert cut_blocks([window(0.0, 3.0)]).count == 30  # of 0.1 s
    assert cut_blocks([window(0.0, 1.2)]).count == 12
    assert cut_blocks([window(0.0, 0.6)]).count == 12  # of 0.05 s


def test_windows_are_cut_evenly_and_numbered_on():
    windows = [window(0.0, 1.0, clock=[0.0, 0.099, 0.101, 0.5, 0.95, 1.0, 1.3]), window(1.0, 1.04, clock=[1.0, 1.04])]
    windows += [window(0.0, 0.96, number=1, clock=[-0.2, 0.0, 0.96])]
    blocks = cut_blocks(windows)
    assert blocks.count == 10 + 1 + 10
    assert [rows.tolist() for rows in blocks.of_row] == [[0, 0, 1, 5, 9, 9, 9], [10, 10], [11, 11, 20]]
    np.testing.assert_allclose(blocks.start[[0, 1, 9, 10, 11, 20]], [0.0, 0.1, 0.9, 1.0, 0.0, 0.864])
    np.testing.assert_allclose(blocks.end[[0, 1, 9, 10, 11, 20]], [0.1, 0.2, 1.0, 1.04, 0.096, 0.96])
    assert blocks.demonstration.tolist() == [0] * 11 + [1] * 10
    assert blocks.fold.tolist() == [k % 5 for k in range(21)]


def test_folds_are_whole_demonstrations_where_there_are_as_many():
    four = cut_blocks([window(0.0, 1.0, number=n) for n in (0, 1, 2, 3)])
    assert four.fold.tolist() == [k % 5 for k in range(four.count)]
    five = cut_blocks([window(0.0, 0.4, number=n) for n in (0, 2, 3, 4, 7)])
    assert five.fold.tolist() == np.repeat(np.arange(5), 4).tolist()
    seven = cut_blocks([window(0.0, 0.2, number=n) for n in range(7)], BlockCfg(folds=3))
    assert seven.fold.tolist() == np.repeat(np.arange(7) % 3, 2).tolist()


def random_sums(blocks: int, size: int, seed: int = 0) -> tuple[Sums, Blocks, list[Linear]]:
    rng = np.random.default_rng(seed)
    rows = np.repeat(np.arange(blocks), 4)
    piece = Linear(rng.normal(size=len(rows)) * 3, rng.normal(size=(len(rows), size)))
    at = np.arange(float(blocks))
    cut = Blocks((rows,), np.arange(blocks) % 3, np.zeros(blocks, int), at, at + 1)
    return block_sums([piece], cut, 2.0), cut, [piece]


def test_sums_weigh_rows_by_hubers_weight():
    sums, blocks, (piece,) = random_sums(7, 2)
    weight = np.minimum(1.0, 2.0 / np.abs(piece.residual))
    for b in range(7):
        mine = blocks.of_row[0] == b
        j, r, w = piece.jacobian[mine], piece.residual[mine], np.diag(weight[mine])
        np.testing.assert_allclose(sums.normal[b], j.T @ w @ j)
        np.testing.assert_allclose(sums.slope[b], j.T @ w @ r)
        assert sums.square[b] == pytest.approx(r @ w @ r)


def test_held_out_errors_of_many_samples_are_those_of_each():
    sums, blocks, _ = random_sums(9, 2)
    rng = np.random.default_rng(1)
    signs = rng.choice([-1.0, 1.0], size=(5, 9))
    held = HeldOut(sums, blocks)
    slopes = signs[:, :, None] * sums.slope
    many = held.errors(slopes, sums.square)
    assert many.shape == (5, 9)
    for found, slope in zip(many, slopes, strict=True):
        np.testing.assert_allclose(found, held.errors(slope, sums.square))
    squares = np.tile(sums.square, (5, 1)) * 2
    np.testing.assert_allclose(held.errors(sums.slope, squares)[3], held.errors(sums.slope, 2 * sums.square))
    for fold in range(3):
        out = blocks.fold == fold
        kept = sums.normal[~out].sum(axis=0) + np.eye(2) / PRIOR**2
        move = -np.linalg.solve(kept, sums.slope[~out].sum(axis=0))
        for b in np.flatnonzero(out):
            expected = sums.square[b] + 2 * move @ sums.slope[b] + move @ sums.normal[b] @ move
            assert held.own()[b] == pytest.approx(expected)


def test_the_prior_determines_what_the_data_do_not():
    sums, blocks, _ = random_sums(6, 1)
    weak = Sums(sums.normal * 1e-3, sums.slope, sums.square)
    found = HeldOut(weak, blocks).own()
    move = -sums.slope[blocks.fold != 0].sum() / (weak.normal[blocks.fold != 0].sum() + 0.01)
    first = weak.square[0] + 2 * move * weak.slope[0, 0] + move**2 * weak.normal[0, 0, 0]
    assert found[0] == pytest.approx(first)


@pytest.mark.parametrize("count", [1, 2, 5, 9])
def test_the_probability_of_few_signs_is_that_of_all_of_them(count):
    gain = np.random.default_rng(count).normal(0.3, 1.0, count)
    sums = [np.dot(signs, gain) for signs in product([-1.0, 1.0], repeat=count)]
    expected = np.mean(np.array(sums) >= gain.sum() - 1e-9)
    assert sign_flip_p(gain, np.random.default_rng(0)) == pytest.approx(expected)


def test_equal_sums_count_in_spite_of_rounding():
    gain = np.array([0.1, 0.2, -0.3, 0.3])
    assert sign_flip_p(gain, np.random.default_rng(0)) == pytest.approx(
        np.mean([np.dot(s, [1, 2, -3, 3]) >= 3 for s in product([-1, 1], repeat=4)])
    )


def test_fourteen_signs_are_enumerated_and_fifteen_are_sampled():
    gain = np.ones(14)
    rng = np.random.default_rng(0)
    assert sign_flip_p(gain, rng) == 2.0**-14
    assert rng.bit_generator.state == np.random.default_rng(0).bit_generator.state
    gain = np.random.default_rng(1).normal(0.2, 1.0, 15)
    signs = np.random.default_rng(2).choice([-1.0, 1.0], size=(500, 15))
    expected = (1 + np.sum(signs @ gain >= gain.sum())) / 501
    assert sign_flip_p(gain, np.random.default_rng(2), samples=500) == pytest.approx(expected)
    assert sign_flip_p(np.full(15, 1.0), np.random.default_rng(3), samples=99) == pytest.approx(0.01)


@pytest.mark.parametrize("demonstrations", [7, 8, 9])
def test_the_bootstrap_resamples_blocks_or_eight_demonstrations_and_more(demonstrations):
    rng = np.random.default_rng(demonstrations)
    count = 3 * demonstrations
    gain, error = rng.normal(1, 1, count), rng.uniform(1, 3, count)
    group = np.repeat(np.arange(demonstrations) * 2, 3)
    found = bootstrap_interval(gain, error, group, np.random.default_rng(5), samples=300)
    if demonstrations >= 8:
        gain, error = gain.reshape(-1, 3).sum(axis=1), error.reshape(-1, 3).sum(axis=1)
    chosen = np.random.default_rng(5).integers(len(gain), size=(300, len(gain)))
    shares = [gain[row].sum() / error[row].sum() for row in chosen]
    np.testing.assert_allclose(found, np.quantile(shares, [0.025, 0.975]))


def test_no_error_at_all_gives_a_finite_share():
    low, high = bootstrap_interval(np.ones(3), np.zeros(3), np.zeros(3), np.random.default_rng(0), samples=9)
    assert low == high == pytest.approx(3e12)


def test_robust_losses_at_written_down_points():
    np.testing.assert_allclose(huber(np.array([-3.0, 0.0, 3.0, -5.0]), 3.0), [4.5, 0.0, 4.5, 10.5])
    np.testing.assert_allclose(huber_weight(np.array([-6.0, 0.0, 3.0, 1e-13]), 3.0), [0.5, 1.0, 1.0, 1.0])
    assert cauchy_cost(np.array([2.0, -2.0, 0.0])) == pytest.approx(2 * 2.0 * np.log(2.0))
    assert cauchy_cost(np.array([6.0])) == pytest.approx(2.0 * np.log(10.0))
    np.testing.assert_allclose(cauchy_weight(np.array([0.0, 2.0, -6.0])), [1.0, 0.5, 0.1])
    assert huber_limit([np.array([1.0, -5.0]), np.array([2.0])]) == pytest.approx(4 * 1.4826 * 2.0)
    assert huber_limit([np.array([0.1, -0.5])]) == 4.0


def test_parameters_that_folds_share_are_estimated_from_all_blocks():
    rng = np.random.default_rng(4)
    rows = np.arange(60) // 6
    blocks = Blocks((rows,), np.arange(10) % 5, np.zeros(10, int), np.arange(10.0), np.arange(10.0) + 1)
    jacobian, noise = rng.normal(size=(60, 2)), rng.normal(size=60)
    jacobian[:, 0] *= np.where(rows % 5 == 0, 50.0, 0.01)  # one fold alone determines the first parameter
    sums = block_sums([Linear(noise, jacobian)], blocks, np.inf)
    apart, together = HeldOut(sums, blocks).own(), HeldOut(sums, blocks, 10.0, np.array([True, False])).own()
    assert apart.sum() > 10 * noise @ noise
    assert together.sum() < 1.3 * noise @ noise
    # Where all are shared, each fold has the least-squares step of all data.
    step = -np.linalg.solve(jacobian.T @ jacobian + 0.01 * np.eye(2), jacobian.T @ noise)
    left = (noise + jacobian @ step) ** 2
    expected = [left[rows == b].sum() for b in range(10)]
    assert HeldOut(sums, blocks, 10.0, np.ones(2, bool)).own() == pytest.approx(expected)
