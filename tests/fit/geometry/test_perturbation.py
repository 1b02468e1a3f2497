import numpy as np
import pytest

from concent_warp.fit.geometry.offset import offset_directions
from concent_warp.fit.geometry.perturbation import Perturbation, rbf, smoothed
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from tests.fit.conftest import DROP


@pytest.fixture(scope="module")
def geometry():
    return ContactGeometryCfg(count=60).build(Scene(DROP))


def test_a_gaussian_process_sample_has_the_covariance_of_the_kernel(geometry):
    mask = np.ones(len(geometry), dtype=bool)
    samples = Perturbation(geometry, mask, "gaussian_process", 0.015).sample(4000, 3, np.random.default_rng(0))
    found = np.einsum("csx,ctx->st", samples, samples) / (3 * len(samples))
    expected = rbf(geometry.position, geometry.position, 0.015)
    assert np.abs(found - expected).max() < 0.06


def test_noise_at_the_centroid_is_one_direction_for_the_whole_object(geometry):
    mask = np.ones(len(geometry), dtype=bool)
    sample = Perturbation(geometry, mask, "centroid", 0.015).sample(1, 3, np.random.default_rng(0))[0]
    direction = sample / np.linalg.norm(sample, axis=1, keepdims=True)
    np.testing.assert_allclose(direction, np.broadcast_to(direction[0], direction.shape), atol=1e-9)


def test_nothing_outside_the_mask_moves(geometry):
    mask = geometry.position[:, 2] > 0
    for kind in ("gaussian_process", "centroid", "independent"):
        sample = Perturbation(geometry, mask, kind, 0.015).sample(3, 3, np.random.default_rng(0))
        assert (sample[:, ~mask] == 0).all()
        assert (sample[:, mask] != 0).all()


def test_swelling_moves_faces_outward_together(geometry):
    mask = np.ones(len(geometry), dtype=bool)
    growth = offset_directions(geometry, Scene(DROP))
    swell = Perturbation(geometry, mask, "gaussian_process", 0.015, growth=growth, swelling=50.0, swelling_length=1.0)
    sample = swell.sample(200, 3, np.random.default_rng(0))
    along = (sample * growth).sum(axis=2)
    assert np.corrcoef(along[:, 0], along[:, -1])[0, 1] > 0.99


def test_smoothing_keeps_a_constant_and_damps_a_spike(geometry):
    mask = np.ones(len(geometry), dtype=bool)
    constant = np.ones((len(geometry), 3))
    spike = np.zeros((len(geometry), 1))
    spike[0] = 1.0
    np.testing.assert_allclose(smoothed(geometry, mask, constant, 0.01), constant)
    assert smoothed(geometry, mask, spike, 0.01)[0, 0] < 0.9
