import numpy as np
import pytest

from concent_warp.diagnosis.forces.cfg import DependenceCfg
from concent_warp.diagnosis.forces.dependence import _max_p, _without, blocks_of, dependences, flips

K, CFG = 160, DependenceCfg()


def features(rng):
    phase = np.linspace(0, 20, K)
    speed = np.sin(phase) * (1 + 0.5 * np.sin(0.3 * phase))
    return {
        "direction": np.tanh(20 * speed)[:, None],
        "speed": speed[:, None],
        "constant": np.ones((K, 1)),
        "other": rng.standard_normal((K, 1)),
    }


def test_blocks_are_even_and_span_no_two_demonstrations():
    labels = blocks_of([40, 7, 1], CFG)
    assert len(labels) == 48
    assert len({int(b) for b in labels[:40]} & {int(b) for b in labels[40:47]}) == 0
    assert labels[47] != labels[46]
    assert (np.bincount(labels[:40]) == 2).all()
    assert np.bincount(blocks_of([400], CFG)).tolist() == [4] * 100


def test_flips_are_all_combinations_where_blocks_are_few_and_begin_with_none():
    signs = flips(6, np.random.default_rng(0), CFG)
    assert (signs[0] == 1).all()
    assert len(np.unique(signs * signs[:, -1:], axis=0)) == len(signs) == 32
    assert flips(40, np.random.default_rng(0), CFG).shape == (1000, 40)


def test_p_values_are_uniform_for_noise_however_many_features():
    p = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        found = dependences(rng.standard_normal((K, 1)), np.ones(K), features(rng), blocks_of([K], CFG), seed)
        p.append(found.p)
    assert np.mean(np.array(p) <= 0.05) == pytest.approx(0.05, abs=0.045)
    assert np.mean(p) == pytest.approx(0.5, abs=0.07)


def test_the_feature_behind_a_force_comes_first_with_its_slope():
    rng = np.random.default_rng(1)
    table = features(rng)
    force = -0.7 * table["direction"] + 0.3 * rng.standard_normal((K, 1))
    found = dependences(force, np.full(K, 0.3), table, blocks_of([K], CFG))
    pattern = found.patterns[0]
    assert pattern.feature == "direction"
    assert pattern.slope == pytest.approx(-0.7, abs=3 * pattern.slope_std)
    assert pattern.share == pytest.approx(0.49 * np.mean(table["direction"] ** 2) / np.mean(force**2), rel=0.1)
    assert pattern.p < 0.01
    assert "speed" not in pattern.alternatives
    assert found.all[0].feature == "direction"


def test_a_second_feature_is_found_after_the_first():
    rng = np.random.default_rng(2)
    table = features(rng)
    force = -1.0 * table["direction"] + 0.4 * table["other"] + 0.2 * rng.standard_normal((K, 1))
    found = dependences(force, np.full(K, 0.2), table, blocks_of([K], CFG))
    assert [pattern.feature for pattern in found.patterns] == ["direction", "other"]


def test_features_that_explain_as_much_are_named_as_alternatives():
    rng = np.random.default_rng(3)
    table = features(rng)
    table["almost speed"] = table["speed"] + 0.02 * rng.standard_normal((K, 1))
    force = table["speed"] + 0.5 * rng.standard_normal((K, 1))
    pattern = dependences(force, np.full(K, 0.5), table, blocks_of([K], CFG)).patterns[0]
    assert {pattern.feature, *pattern.alternatives} >= {"speed", "almost speed"}


def test_a_share_too_small_is_no_pattern():
    rng = np.random.default_rng(4)
    table = features(rng)
    force = 0.2 * table["constant"] + rng.standard_normal((K, 1))
    assert dependences(force, np.ones(K), table, blocks_of([K], CFG), in_contact=True).patterns == ()


def test_too_few_blocks_test_nothing():
    found = dependences(np.ones((8, 1)), np.ones(8), {"constant": np.ones((8, 1))}, blocks_of([8], CFG))
    assert found.all == ()
    assert found.p == 1


def test_windows_that_have_no_information_are_left_out():
    rng = np.random.default_rng(6)
    table = features(rng)
    force = table["speed"] + 0.1 * rng.standard_normal((K, 1))
    holes = force.copy()
    holes[::5] = np.nan
    assert dependences(holes, np.full(K, 0.1), table, blocks_of([K], CFG)).patterns[0].feature == "speed"


def test_projecting_out_leaves_what_is_at_right_angles():
    rng = np.random.default_rng(7)
    chosen, y = rng.standard_normal((2, 30)), rng.standard_normal(30)
    assert chosen @ _without(y, chosen) == pytest.approx(np.zeros(2), abs=1e-12)


def test_p_of_a_certain_correlation_is_the_smallest_possible():
    block = np.repeat(np.arange(8), 3)
    x = np.ones((1, 24))
    assert _max_p(np.ones(24), x, block, flips(8, np.random.default_rng(0), CFG)) == pytest.approx([1 / 128])
