import numpy as np
import pytest

from concent_warp.errors import ModelError
from concent_warp.scene.shapes.solid import Box
from concent_warp.scene.spheres.mass import split_mass

HALF = np.array([0.02, 0.03, 0.04])
MASS = 0.08
INERTIA = MASS / 3 * (np.sum(HALF**2) * np.eye(3) - np.diag(HALF**2))


def totals(positions, radii, mass, com):
    """Inertia about `com`, summed sphere by sphere."""
    inertia = np.zeros((3, 3))
    for p, r, m in zip(positions, radii, mass, strict=True):
        d = p - com
        inertia += 0.4 * m * r**2 * np.eye(3) + m * (d @ d * np.eye(3) - np.outer(d, d))
    return mass.sum(), mass @ positions / mass.sum(), inertia


def rotation(seed):
    q, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    return q


def test_spheres_keep_mass_com_and_inertia():
    rng = np.random.default_rng(0)
    positions = rng.uniform(-0.9, 0.9, (200, 3)) * HALF
    radii = rng.uniform(0.001, 0.003, 200)
    turn, com = rotation(1), np.array([0.003, -0.002, 0.004])
    split = split_mass((positions + com) @ turn.T, radii, MASS, turn @ com, turn @ INERTIA @ turn.T)
    mass, centre, inertia = totals((positions + com) @ turn.T, radii, split.mass, turn @ com)
    assert mass == pytest.approx(MASS, rel=1e-12)
    np.testing.assert_allclose(centre, turn @ com, atol=1e-10)
    np.testing.assert_allclose(inertia, turn @ INERTIA @ turn.T, atol=1e-8 * np.trace(INERTIA))
    assert (split.mass >= 0).all()
    assert split.inertia_error < 1e-8


def test_masses_are_even_where_even_masses_fit():
    positions = np.random.default_rng(2).uniform(-1, 1, (100, 3)) * HALF
    radii = np.full(100, 0.002)
    even = np.full(100, MASS / 100)
    _, com, _ = totals(positions, radii, even, np.zeros(3))
    inertia = totals(positions, radii, even, com)[2]
    np.testing.assert_allclose(split_mass(positions, radii, MASS, com, inertia).mass, even, rtol=1e-6)


def test_a_scarce_exact_solution_is_found():
    # Many spheres near the surface and a few inside: the solid's inertia needs the few.
    surface = Box(HALF).sample(300, np.random.default_rng(3))[0]
    inner = np.random.default_rng(4).uniform(-0.3, 0.3, (12, 3)) * HALF
    split = split_mass(np.concatenate([surface, inner]), np.full(312, 0.004), MASS, np.zeros(3), INERTIA)
    assert split.inertia_error < 1e-8
    assert split.com_error < 1e-10
    assert split.mass[300:].sum() > 5 * 12 / 312 * MASS


def test_spheres_on_the_surface_keep_mass_and_com_and_come_near_the_inertia():
    positions = Box(HALF).sample(300, np.random.default_rng(5))[0]
    radii = np.full(300, 0.004)
    split = split_mass(positions, radii, MASS, np.zeros(3), INERTIA)
    mass, centre, inertia = totals(positions, radii, split.mass, np.zeros(3))
    assert mass == pytest.approx(MASS, rel=1e-9)
    np.testing.assert_allclose(centre, 0, atol=1e-8)
    assert split.inertia_error == pytest.approx(np.linalg.norm(inertia - INERTIA) / np.linalg.norm(INERTIA), rel=1e-6)
    even = totals(positions, radii, np.full(300, MASS / 300), np.zeros(3))[2]
    assert 1e-3 < split.inertia_error < 0.5 * np.linalg.norm(even - INERTIA) / np.linalg.norm(INERTIA)


def test_com_outside_the_spheres_leaves_the_mass():
    positions = np.random.default_rng(6).uniform(-0.01, 0.01, (50, 3))
    split = split_mass(positions, np.full(50, 0.002), MASS, np.array([0.05, 0, 0]), INERTIA)
    assert split.mass.sum() == pytest.approx(MASS)
    assert 0.03 < split.com_error < 0.06
    assert (split.mass >= 0).all()


def test_one_sphere_and_a_massless_body_are_split():
    assert split_mass(np.zeros((1, 3)), np.ones(1), MASS, np.zeros(3), INERTIA).mass == pytest.approx([MASS])
    assert split_mass(np.zeros((3, 3)), np.ones(3), 0.0, np.zeros(3), np.zeros((3, 3))).mass == pytest.approx([0, 0, 0])


def test_negative_mass_is_refused():
    with pytest.raises(ModelError, match="mass >= 0"):
        split_mass(np.zeros((1, 3)), np.ones(1), -1.0, np.zeros(3), INERTIA)
