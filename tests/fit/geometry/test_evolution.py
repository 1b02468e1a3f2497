"""The evolution strategy, its noise and its checkpoints against formulas, without a simulation."""

from __future__ import annotations

import json
import zipfile
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from concent_warp.errors import ModelError
from concent_warp.fit.geometry.checkpoint import Checkpoint
from concent_warp.fit.geometry.evolution import Evolution, EvolutionCfg
from concent_warp.fit.geometry.perturbation import Perturbation, rbf, smoothed
from concent_warp.scene.spheres.contact_geometry import ContactGeometry
from tests.fit.conftest import HALF, corner_spheres

JITTER = 1e-6
GEOMETRY = corner_spheres(HALF)
COUNT = len(GEOMETRY)
GROWTH = np.sign(GEOMETRY.position)
EVERY = np.ones(COUNT, dtype=bool)


def evolution(faces: Any = None, **options: Any) -> Evolution:
    return Evolution(GEOMETRY, GROWTH, EvolutionCfg(**options), faces)


def two_bodies() -> ContactGeometry:
    """Return spheres of two bodies at random places."""
    rng = np.random.default_rng(7)
    body = np.array([0, 1, 0, 0, 1, 1, 0, 1, 0])
    return ContactGeometry(
        ("a", "b"), body, rng.normal(0, 0.02, (9, 3)), np.full(9, 0.004), np.full(9, 0.1), np.full(9, 0.5)
    )


@pytest.mark.parametrize(("radius", "friction"), [(False, False), (True, False), (False, True), (True, True)])
def test_channels_are_positions_then_logarithms_of_what_else_is_fitted(radius, friction):
    strategy = evolution(fit_radius=radius, fit_friction=friction, radius_sigma=0.06, friction_sigma=0.2)
    channels = 3 + radius + friction
    scales = [2e-3] * 3 + [0.06] * radius + [0.2] * friction
    assert strategy.cfg.scales(2e-3).tolist() == scales
    assert strategy.mean.shape == (COUNT, channels)
    values = np.random.default_rng(0).normal(0, 0.1, (5, COUNT, channels))
    position, radii, frictions = strategy.properties(values)
    np.testing.assert_allclose(position, GEOMETRY.position + values[..., :3])
    if radius:
        assert radii is not None
        np.testing.assert_allclose(radii, GEOMETRY.radius * np.exp(values[..., 3]))
    else:
        assert radii is None
    if friction:
        assert frictions is not None
        np.testing.assert_allclose(frictions, GEOMETRY.friction * np.exp(values[..., 3 + radius]))
    else:
        assert frictions is None
    candidates = strategy.candidates(values)
    np.testing.assert_array_equal(candidates.position, position)
    made = strategy.geometry(values[2])
    np.testing.assert_array_equal(made.position, position[2])
    np.testing.assert_array_equal(made.radius, GEOMETRY.radius if radii is None else radii[2])
    np.testing.assert_array_equal(made.friction, GEOMETRY.friction if frictions is None else frictions[2])


def test_faces_are_flattened_at_the_start_or_in_each_generation_or_not():
    assert EvolutionCfg(flat_start=True, flattening=0.0).flattens
    assert EvolutionCfg(flat_start=False, flattening=0.1).flattens
    assert not EvolutionCfg(flat_start=False, flattening=0.0).flattens


def test_the_first_steps_are_a_share_of_the_distance_unless_they_are_given():
    strategy = evolution(max_sigma=2e-3)
    assert (strategy.sigma, strategy.generation) == (2e-3, 0)
    for distance, sigma in ((6e-3, 1e-3), (np.nan, 1e-3), (np.inf, 1e-3), (0.1, 2e-3)):
        strategy.scale_to(distance)
        assert strategy.sigma == pytest.approx(sigma)
    fixed = evolution(sigma=5e-4)
    fixed.scale_to(6e-3)
    assert fixed.sigma == 5e-4
    assert evolution(sigma_decay=0.9).shrink == 1.0
    later = evolution(sigma_decay=0.9)
    later.generation = 3
    assert later.shrink == pytest.approx(0.729)


def test_displacements_keep_their_direction_and_are_no_longer_than_the_largest():
    strategy = evolution(max_displacement=0.01, fit_radius=True)
    values = np.array([[0.006, 0.0, 0.008, 3.0], [0.03, 0.0, 0.04, -2.0], [0.0, 0.0, 0.0, 1.0], [0.0, -0.02, 0.0, 0.0]])
    expected = np.array(
        [[0.006, 0.0, 0.008, 3.0], [0.006, 0.0, 0.008, -2.0], [0.0, 0.0, 0.0, 1.0], [0.0, -0.01, 0.0, 0.0]]
    )
    np.testing.assert_allclose(strategy.bounded(values), expected)
    np.testing.assert_allclose(strategy.bounded(values[None]), expected[None])


@pytest.mark.parametrize(("population", "antithetic"), [(6, True), (7, True), (5, False)])
def test_candidates_are_the_estimate_plus_scaled_noise_in_opposite_pairs(population, antithetic):
    strategy = evolution(population=population, antithetic=antithetic, sigma=1e-4, sigma_decay=0.5, fit_radius=True)
    strategy.generation = 2
    strategy.mean = np.full((COUNT, 4), 1e-3)
    mask = GEOMETRY.position[:, 2] < 0
    found = strategy.ask(mask, np.random.default_rng(0))
    assert found.shape == (population, COUNT, 4)
    cfg = strategy.cfg
    noise = Perturbation(
        GEOMETRY.with_position(GEOMETRY.position + 1e-3), mask, cfg.noise, cfg.length,
        growth=GROWTH, swelling=cfg.swelling, swelling_length=cfg.swelling_length,
    ).sample(-(-population // 2) if antithetic else population, 4, np.random.default_rng(0))  # fmt: skip
    scaled = noise * np.array([1e-4, 1e-4, 1e-4, 0.05]) / 4
    away = found - strategy.mean
    np.testing.assert_allclose(away[:: 2 if antithetic else 1], scaled, atol=1e-15)
    if antithetic:
        np.testing.assert_allclose(away[1::2], -scaled[: population // 2], atol=1e-15)
    assert (away[:, ~mask] == 0).all()


def told(losses: Any, **options: Any) -> tuple[Evolution, np.ndarray]:
    """Return a strategy that has been told losses of random candidates, and these."""
    strategy = evolution(**({"momentum": 0.6, "flattening": 0.0} | options))
    strategy.mean = np.full((COUNT, 3), 5e-4)
    candidates = np.random.default_rng(1).normal(0, 1e-3, (len(losses), COUNT, 3))
    strategy.tell(candidates, np.array(losses, dtype=float), EVERY)
    return strategy, candidates


def test_the_estimate_moves_towards_the_mean_of_the_elites():
    losses = [5.0, 1.0, 4.0, 2.0, np.inf, 3.0, 9.0, 8.0]
    strategy, candidates = told(losses)
    np.testing.assert_allclose(strategy.mean, 5e-4 + 0.6 * (candidates[[1, 3]].mean(axis=0) - 5e-4))
    assert strategy.generation == 1
    strategy, candidates = told(losses, elite_share=0.4)
    np.testing.assert_allclose(strategy.mean, 5e-4 + 0.6 * (candidates[[1, 3, 5]].mean(axis=0) - 5e-4))
    strategy, candidates = told(losses, elite_share=0.01, momentum=1.0)
    np.testing.assert_allclose(strategy.mean, candidates[1])


def test_of_equal_losses_the_first_count_and_those_that_diverged_never():
    strategy, candidates = told([1.0] * 8)
    np.testing.assert_allclose(strategy.mean, 5e-4 + 0.6 * (candidates[:2].mean(axis=0) - 5e-4))
    strategy, candidates = told([np.inf, np.inf, 2.0, np.inf, np.inf, np.inf, np.inf, np.inf])
    np.testing.assert_allclose(strategy.mean, 5e-4 + 0.6 * (candidates[2] - 5e-4))
    strategy, _ = told([np.inf] * 8)
    np.testing.assert_array_equal(strategy.mean, 5e-4)
    assert strategy.generation == 1


def test_the_step_may_be_smoothed_and_stays_within_bounds():
    strategy, candidates = told([1.0, 2.0, 3.0, 4.0], mean_smoothing=0.03)
    step = 0.6 * (candidates[0] - 5e-4)
    shifted = GEOMETRY.with_position(GEOMETRY.position + 5e-4)
    np.testing.assert_allclose(strategy.mean, 5e-4 + smoothed(shifted, EVERY, step, 0.03))
    plain, _ = told([1.0, 2.0, 3.0, 4.0])
    assert np.abs(plain.mean - strategy.mean).max() > 1e-5
    bounded, _ = told([1.0, 2.0, 3.0, 4.0], max_displacement=1e-4)
    assert np.linalg.norm(bounded.mean, axis=1).max() <= 1e-4 * (1 + 1e-9)


class Flat:
    """Faces whose flattening is the opposite of the displacement and a constant."""

    def flattening(self, displacement: np.ndarray) -> np.ndarray:
        return -displacement + 1e-3


def test_each_generation_flattens_a_share_inside_the_mask():
    strategy = evolution(faces=Flat(), flattening=0.1, momentum=0.6, fit_radius=True)
    strategy.mean = np.full((COUNT, 4), 5e-4)
    mask = GEOMETRY.position[:, 0] > 0
    strategy.tell(np.full((4, COUNT, 4), 5e-4), np.arange(4.0), mask)
    np.testing.assert_allclose(strategy.mean[mask, :3], 5e-4 + 0.1 * (1e-3 - 5e-4))
    np.testing.assert_allclose(strategy.mean[~mask], 5e-4)
    np.testing.assert_allclose(strategy.mean[:, 3], 5e-4)
    off = evolution(faces=Flat(), flattening=0.0)
    off.tell(np.zeros((4, COUNT, 3)), np.arange(4.0), mask)
    np.testing.assert_array_equal(off.mean, 0.0)
    without = evolution(faces=None, flattening=0.1)
    without.tell(np.zeros((4, COUNT, 3)), np.arange(4.0), mask)
    np.testing.assert_array_equal(without.mean, 0.0)


def test_the_kernel_falls_with_the_square_of_the_distance():
    a, b = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.4]]), np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.0], [0.0, 0.5, 0.0]])
    found = rbf(a, b, 0.2)
    assert found.shape == (2, 3)
    for i, j in np.ndindex(2, 3):
        assert found[i, j] == pytest.approx(np.exp(-(np.linalg.norm(a[i] - b[j]) ** 2) / 0.08))


@pytest.mark.parametrize("kind", ["gaussian_process", "centroid", "independent"])
def test_a_sample_is_made_body_by_body_from_standard_normals(kind):
    geometry = two_bodies()
    mask = np.array([True, True, False, True, True, False, True, True, True])
    growth = np.random.default_rng(8).normal(size=(9, 3))
    for swelling in (0.0, 2.0):
        found = Perturbation(geometry, mask, kind, 0.03, growth=growth, swelling=swelling, swelling_length=0.1).sample(
            4, 5, np.random.default_rng(3)
        )
        rng, expected = np.random.default_rng(3), np.zeros((4, 9, 5))
        for rows in ([0, 3, 6, 8], [1, 4, 7]):
            points = geometry.position[rows]
            factor = {
                "gaussian_process": np.linalg.cholesky(rbf(points, points, 0.03) + JITTER * np.eye(len(rows))),
                "centroid": rbf(points, points.mean(axis=0)[None], 0.03),
                "independent": np.eye(len(rows)),
            }[kind]
            drawn = rng.normal(size=(4, factor.shape[1], 5))
            for c in range(4):
                expected[c, rows] = factor @ drawn[c]
            if swelling:
                slow = np.linalg.cholesky(rbf(points, points, 0.1) + JITTER * np.eye(len(rows)))
                sizes = 2.0 * rng.normal(size=(4, len(rows)))
                for c in range(4):
                    expected[c, rows, :3] += (slow @ sizes[c])[:, None] * growth[rows]
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_swelling_needs_a_growth_and_a_mask_may_hold_no_sphere_of_a_body():
    geometry = two_bodies()
    mask = geometry.body == 1
    plain = Perturbation(geometry, mask, "gaussian_process", 0.03).sample(2, 3, np.random.default_rng(0))
    without = Perturbation(geometry, mask, "gaussian_process", 0.03, swelling=2.0).sample(
        2, 3, np.random.default_rng(0)
    )
    np.testing.assert_array_equal(plain, without)
    assert (plain[:, geometry.body == 0] == 0).all()
    assert (plain[:, mask] != 0).all()


def test_smoothing_is_the_mean_over_the_kernel_of_the_same_body():
    geometry = two_bodies()
    mask = np.array([True, True, False, True, True, False, True, True, True])
    values = np.random.default_rng(9).normal(size=(9, 4))
    expected = values.copy()
    for i in np.flatnonzero(mask):
        near = [j for j in np.flatnonzero(mask) if geometry.body[j] == geometry.body[i]]
        weight = np.array([np.exp(-np.sum((geometry.position[i] - geometry.position[j]) ** 2) / 2e-4) for j in near])
        expected[i] = weight @ values[near] / weight.sum()
    np.testing.assert_allclose(smoothed(geometry, mask, values, 0.01), expected)
    np.testing.assert_array_equal(smoothed(geometry, geometry.body == 2, values, 0.01), values)


def checkpoint() -> Checkpoint:
    rng = np.random.default_rng(0)
    return Checkpoint(
        cfg=asdict(EvolutionCfg()), start=GEOMETRY.position, mean=rng.normal(size=(COUNT, 3)),
        best_mean=rng.normal(size=(COUNT, 3)), collidable=rng.random(COUNT) < 0.5, frozen=rng.random(COUNT) < 0.5,
        random_state=dict(rng.bit_generator.state), numbers={"generation": 3, "best": 0.25, "lowest": float("inf")},
        history=[{"loss": 0.5}], stopped=None,
    )  # fmt: skip


def test_a_checkpoint_comes_back_as_it_was_saved(tmp_path):
    saved, path = checkpoint(), tmp_path / "one" / "two" / "checkpoint.npz"
    saved.save(path)
    found = Checkpoint.load(path)
    for name in Checkpoint.ARRAYS:
        np.testing.assert_array_equal(getattr(found, name), getattr(saved, name))
        assert getattr(found, name).dtype == getattr(saved, name).dtype
    for name in Checkpoint.TEXTS:
        assert getattr(found, name) == json.loads(json.dumps(getattr(saved, name)))
    assert [p.name for p in path.parent.iterdir()] == ["checkpoint.npz"]
    replace(saved, stopped="done").save(path)
    assert Checkpoint.load(path).stopped == "done"


def broken(kind: str, path: Path) -> None:
    """Make a file that is no checkpoint."""
    if kind == "missing":
        path.unlink()
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "cut":
        path.write_bytes(path.read_bytes()[:-400])
    elif kind == "other":
        np.savez(path, start=np.zeros(3))
    elif kind == "text":
        content: dict[str, Any] = dict(np.load(path)) | {"numbers": np.array("no json")}
        np.savez(path, **content)
    elif kind == "flipped":
        with zipfile.ZipFile(path) as archive:
            at = archive.getinfo("mean.npy").header_offset + 200
        data = bytearray(path.read_bytes())
        data[at] ^= 0xFF
        path.write_bytes(bytes(data))
    elif kind == "squeezed":
        np.savez_compressed(path, **dict(np.load(path)))
        with zipfile.ZipFile(path) as archive:
            at = archive.getinfo("mean.npy").header_offset + 60
        data = bytearray(path.read_bytes())
        data[at : at + 40] = b"\xff" * 40
        path.write_bytes(bytes(data))


@pytest.mark.parametrize("kind", ["missing", "empty", "cut", "other", "text", "flipped", "squeezed"])
def test_a_file_that_is_not_whole_is_refused_with_its_name(kind, tmp_path):
    path = tmp_path / "checkpoint.npz"
    checkpoint().save(path)
    broken(kind, path)
    with pytest.raises(ModelError, match="not a checkpoint of a fit") as error:
        Checkpoint.load(path)
    assert "checkpoint.npz" in str(error.value)
    assert "delete it to start anew" in str(error.value)


def test_a_checkpoint_belongs_to_its_settings_and_its_start():
    saved = checkpoint()
    saved.check(asdict(EvolutionCfg()), GEOMETRY.position.copy())
    with pytest.raises(ModelError, match="other settings") as error:
        saved.check(asdict(EvolutionCfg(length=0.02, population=8)), GEOMETRY.position)
    assert "{'length': 0.02, 'population': 8}" in str(error.value)
    assert "{'length': 0.03, 'population': 32}" in str(error.value)
    with pytest.raises(ModelError, match="other settings"):
        saved.check(asdict(EvolutionCfg()) | {"new": 1}, GEOMETRY.position)
    for start in (GEOMETRY.position + 1e-12, GEOMETRY.position[:4]):
        with pytest.raises(ModelError, match="another starting geometry"):
            saved.check(asdict(EvolutionCfg()), start)
