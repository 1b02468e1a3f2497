from __future__ import annotations

import numpy as np
import pytest

from concent_warp.perception.rigid_motion import consensus, inverse, kabsch, transformed

RNG = np.random.default_rng(0)


def transform(rng: np.random.Generator) -> np.ndarray:
    axis = rng.normal(size=3)
    angle = rng.uniform(0, np.pi)
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    result = np.eye(4)
    result[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    result[:3, 3] = rng.normal(size=3)
    return result


def test_kabsch_recovers_rigid_motions_exactly():
    motions = np.array([transform(RNG) for _ in range(20)])
    source = RNG.normal(size=(20, 6, 3))
    np.testing.assert_allclose(kabsch(source, transformed(motions, source)), motions, atol=1e-10)


def test_kabsch_never_mirrors_not_even_flat_or_mirrored_points():
    flat = RNG.normal(size=(8, 3)) * [1, 1, 0]
    motion = transform(RNG)
    np.testing.assert_allclose(kabsch(flat, transformed(motion, flat)), motion, atol=1e-10)
    points = RNG.normal(size=(8, 3))
    rotation = kabsch(points, points * [1, 1, -1])[:3, :3]
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_inverse_undoes_a_motion():
    motion = transform(RNG)
    np.testing.assert_allclose(inverse(motion) @ motion, np.eye(4), atol=1e-12)


def test_consensus_finds_the_motion_among_forty_percent_wrong_points():
    motion, source = transform(RNG), RNG.normal(0, 0.02, size=(50, 3))
    noise = 2e-4
    target = transformed(motion, source) + RNG.normal(0, noise, source.shape)
    wrong = np.arange(50) < 20
    target[wrong] += RNG.normal(0, 0.03, (20, 3))
    # A fit to all of them would be far off.
    assert np.abs(transformed(kabsch(source, target), source) - transformed(motion, source)).max() > 3e-3
    result = consensus(source, target, 0.006, np.random.default_rng(1))
    assert result is not None
    found, agrees = result
    assert agrees[~wrong].mean() > 0.9
    assert np.abs(transformed(found, source) - transformed(motion, source)).max() < 3 * noise


def test_consensus_rejects_small_slips_though_the_tolerance_is_wide():
    motion, source = transform(RNG), RNG.normal(0, 0.02, size=(60, 3))
    target = transformed(motion, source) + RNG.normal(0, 1e-4, source.shape)
    slipped = np.arange(60) < 15
    target[slipped] += [2e-3, 0, 0]
    result = consensus(source, target, 0.006, np.random.default_rng(1))
    assert result is not None
    assert not result[1][slipped].any()
    assert np.abs(transformed(result[0], source) - transformed(motion, source)).max() < 2e-4


def test_consensus_is_none_where_points_agree_on_nothing():
    assert consensus(np.zeros((2, 3)), np.zeros((2, 3)), 1.0, np.random.default_rng(0)) is None
    source, target = RNG.normal(size=(30, 3)), RNG.normal(size=(30, 3))
    assert consensus(source, target, 1e-3, np.random.default_rng(0)) is None
