from dataclasses import replace

import numpy as np
import pytest

from concent_warp.fit.effects.cross_validation import (
    BlockCfg,
    Blocks,
    HeldOut,
    block_sums,
    bootstrap_interval,
    cut_blocks,
    sign_flip_p,
)
from concent_warp.fit.effects.intervals import covariance
from concent_warp.fit.effects.least_squares import LeastSquaresCfg, Linear
from tests.scenes.swinging import swung, windows_of

PRIOR, FOLDS = LeastSquaresCfg.prior, BlockCfg.folds

WIDE = 1e6
"""A limit that no residual reaches, so that nothing is weighed down."""


def even_blocks(rows, count):
    """Blocks of equal size over one window, dealt to five folds in turn."""
    numbers = np.arange(count)
    of_row = (np.arange(rows) * count // rows,)
    return Blocks(of_row, numbers % FOLDS, 0 * numbers, 1.0 * numbers, 1.0 * numbers + 1)


def line(rng, rows, *, slope=0.0, size=2):
    jacobian = rng.normal(size=(rows, size))
    return Linear(rng.normal(size=rows) - jacobian @ np.full(size, slope), jacobian)


def test_blocks_cover_windows_and_are_dealt_in_turn():
    windows = windows_of(swung(seconds=4.0), 1.0)
    blocks = cut_blocks(windows)
    assert BlockCfg().min_blocks <= blocks.count <= BlockCfg().max_blocks
    assert set(np.bincount(blocks.fold)) <= {blocks.count // FOLDS, blocks.count // FOLDS + 1}
    for window, rows in zip(windows, blocks.of_row, strict=True):
        assert (blocks.start[rows] <= window.clock + 1e-9).all()
        assert (window.clock <= blocks.end[rows] + 1e-9).all()


def test_where_there_are_demonstrations_enough_whole_ones_are_held_out():
    window = windows_of(swung(seconds=1.0))[0]
    blocks = cut_blocks([replace(window, number=k) for k in range(7)])
    for number in range(7):
        assert len(set(blocks.fold[blocks.demonstration == number])) == 1
    assert len(set(blocks.fold)) == FOLDS


def test_sums_are_those_of_the_rows_of_each_block():
    rng = np.random.default_rng(0)
    piece, blocks = line(rng, 40), even_blocks(40, 4)
    sums = block_sums([piece], blocks, WIDE)
    part = slice(10, 20)
    np.testing.assert_allclose(sums.normal[1], piece.jacobian[part].T @ piece.jacobian[part])
    np.testing.assert_allclose(sums.slope[1], piece.jacobian[part].T @ piece.residual[part])
    assert sums.square[1] == pytest.approx(np.sum(piece.residual[part] ** 2))


def test_a_row_beyond_the_limit_counts_by_its_huber_weight():
    piece = Linear(np.array([1.0, 8.0]), np.ones((2, 1)))
    sums = block_sums([piece], even_blocks(2, 1), 4.0)
    assert sums.square[0] == pytest.approx(1 + 0.5 * 64)


def test_held_out_errors_are_those_of_fits_without_the_fold():
    rng = np.random.default_rng(1)
    piece, blocks = line(rng, 100, slope=0.5), even_blocks(100, 10)
    found = HeldOut(block_sums([piece], blocks, WIDE), blocks).own()
    rows = blocks.of_row[0]
    for fold in range(FOLDS):
        kept = blocks.fold[rows] != fold
        j, r = np.vstack([piece.jacobian[kept], np.eye(2) / PRIOR]), np.append(piece.residual[kept], [0, 0])
        move = -np.linalg.lstsq(j, r, rcond=None)[0]
        for b in np.flatnonzero(blocks.fold == fold):
            left = piece.residual[rows == b] + piece.jacobian[rows == b] @ move
            assert found[b] == pytest.approx(np.sum(left**2))


def test_held_out_errors_fall_for_an_effect_that_is_there_and_not_for_one_that_is_not():
    rng = np.random.default_rng(2)
    blocks = even_blocks(600, 12)
    there, absent = line(rng, 600, slope=0.5, size=3), line(rng, 600, size=3)
    gains = []
    for piece in (there, absent):
        sums = block_sums([piece], blocks, WIDE)
        gains.append(sums.square.sum() - HeldOut(sums, blocks).own().sum())
    assert gains[0] > 300
    assert -30 < gains[1] < 10


def test_what_a_step_promises_that_the_fit_could_not_take_is_no_gain():
    rng, blocks = np.random.default_rng(2), even_blocks(600, 12)
    promising, fitted = line(rng, 600, slope=0.5, size=3), line(rng, 600, size=3)
    for piece, promises in ((promising, True), (fitted, False)):
        held_out = HeldOut(block_sums([piece], blocks, WIDE), blocks)
        assert (held_out.own().sum() < held_out.sums.square.sum()) == promises
        np.testing.assert_array_equal(held_out.of_fit(), held_out.sums.square if promises else held_out.own())


@pytest.mark.parametrize(("gain", "p"), [([1.0, 2.0, 3.0], 1 / 8), ([1.0, -1.0], 3 / 4), ([-1.0, -1.0, -1.0], 1.0)])
def test_chance_of_the_signs_of_a_few_blocks_is_counted_out(gain, p):
    assert sign_flip_p(np.array(gain), np.random.default_rng(0)) == pytest.approx(p)


def test_chance_of_the_signs_of_many_blocks_is_drawn():
    rng = np.random.default_rng(0)
    sure, nothing = sign_flip_p(np.ones(20), rng), sign_flip_p(np.tile([1.0, -1.0], 10), rng)
    assert sure < 1e-3
    assert nothing == pytest.approx(0.58, abs=0.06)  # a sum of 20 signs is at least 0


def test_the_interval_of_an_even_gain_is_a_point_and_widens_with_scatter():
    rng = np.random.default_rng(0)
    error, group = np.full(20, 2.0), np.zeros(20, dtype=int)
    assert bootstrap_interval(np.ones(20), error, group, rng) == pytest.approx((0.5, 0.5))
    low, high = bootstrap_interval(rng.normal(1, 1, 20), error, group, rng)
    assert low < 0.5 < high
    assert 0.2 < high - low < 0.7  # 4 x 0.5 / sqrt(20) = 0.45


def test_where_there_are_demonstrations_enough_whole_ones_are_resampled():
    rng = np.random.default_rng(0)
    gain = np.repeat(rng.normal(1, 1, 8), 5)  # equal within each demonstration
    group = np.repeat(np.arange(8), 5)
    whole = bootstrap_interval(gain, np.ones(40), group, rng)
    apart = bootstrap_interval(gain, np.ones(40), np.zeros(40, dtype=int), rng)
    assert whole[1] - whole[0] > 1.6 * (apart[1] - apart[0])


def test_covariance_of_white_noise_is_the_inverse_of_the_normal_matrix():
    rng = np.random.default_rng(3)
    piece, blocks = line(rng, 4000), even_blocks(4000, 60)
    found = covariance(block_sums([piece], blocks, WIDE), blocks)
    expected = np.linalg.inv(piece.jacobian.T @ piece.jacobian)
    assert np.diag(found) == pytest.approx(np.diag(expected), rel=0.5)
    assert (np.diag(found) >= np.diag(expected) * (1 - 1e-4)).all()


def test_covariance_grows_where_noise_is_the_same_all_over_a_block():
    rng = np.random.default_rng(4)
    blocks = even_blocks(3000, 60)
    noise = rng.normal(size=60)[blocks.of_row[0]]
    piece = Linear(noise, np.ones((3000, 1)))
    found = covariance(block_sums([piece], blocks, WIDE), blocks)
    assert found[0, 0] == pytest.approx(1 / 60, rel=0.5)  # 60 independent values, not 3000


def test_a_parameter_that_nothing_depends_on_has_the_variance_of_its_prior():
    rng = np.random.default_rng(5)
    known = rng.normal(size=(200, 1))
    piece, blocks = Linear(rng.normal(size=200), np.column_stack([known, 0 * known])), even_blocks(200, 12)
    found = covariance(block_sums([piece], blocks, WIDE), blocks)
    assert found[1, 1] == pytest.approx(PRIOR**2)
    assert found[0, 0] < 0.1
