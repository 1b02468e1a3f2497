from __future__ import annotations

import numpy as np
import pytest

from concent_warp.perception.rigid_motion import kabsch

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


def transformed(motion: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ np.swapaxes(motion[..., :3, :3], -1, -2) + motion[..., None, :3, 3]


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
