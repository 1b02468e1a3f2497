"""Parameters that were fitted together: their joint distribution is sampled, saved and read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import truncnorm

import concent_warp as cw
from concent_warp.effects.effect import AddedEffect
from concent_warp.effects.library.joints import JointDamping, JointFriction
from concent_warp.effects.posterior import JointPosterior
from concent_warp.effects.table import posteriors_table, with_posteriors
from tests.scenes.swinging import DAMPING, drawing, swung

NONE, FREE = (-np.inf,) * 2, (np.inf,) * 2
ALIKE = JointPosterior((0.5, 2.0), ((1.0, -0.95), (-0.95, 1.0)), NONE, FREE)
"""Two parameters of which the data determine little but a sum."""
EFFECTS = (
    AddedEffect(JointFriction("hinge"), (0.3,), ((0.1, 0.5),), ALIKE, 0),
    AddedEffect(JointDamping("hinge"), (4.0,), ((0.0, 8.0),), ALIKE, 1),
)


def test_samples_have_mean_and_covariance_of_the_posterior() -> None:
    rows = ALIKE.sample(np.array([0.3, 4.0]), 8000, np.random.default_rng(0))
    np.testing.assert_allclose(rows.mean(axis=0), [0.3, 4.0], atol=0.06)
    np.testing.assert_allclose(np.cov(rows.T), ALIKE.matrix, rtol=0.06)
    assert len(np.unique(rows[:, 0])) == 8000


def test_samples_within_bounds_have_the_truncated_distribution() -> None:
    bounded = replace(ALIKE, low=(0.2, 3.0), high=(1.0, np.inf))
    mean, rng = np.array([0.3, 4.0]), np.random.default_rng(1)
    rows = bounded.sample(mean, 6000, rng)
    assert (rows >= bounded.low).all()
    assert (rows <= bounded.high).all()
    every = rng.multivariate_normal(mean, bounded.matrix, 400_000)
    inside = every[((every >= bounded.low) & (every <= bounded.high)).all(axis=1)]
    np.testing.assert_allclose(rows.mean(axis=0), inside.mean(axis=0), rtol=0.02)
    np.testing.assert_allclose(np.cov(rows.T), np.cov(inside.T), rtol=0.15)
    sampled, expected = (np.asarray(np.corrcoef(values.T)) for values in (rows, inside))
    np.testing.assert_allclose(sampled, expected, atol=0.03)


def test_one_parameter_at_its_bound_has_half_a_normal_distribution() -> None:
    alone = JointPosterior((2.0,), ((0.25,),), (1.0,), (np.inf,))
    rows = alone.sample(np.array([1.0]), 4000, np.random.default_rng(2)).ravel()
    expected = truncnorm(0, np.inf, loc=1.0, scale=1.0)
    for share in (0.1, 0.5, 0.9):
        assert float(np.quantile(rows, share)) == pytest.approx(expected.ppf(share), abs=0.05)


def test_what_is_certain_keeps_its_value_and_a_covariance_of_lower_rank_is_sampled() -> None:
    exact = JointPosterior((1.0,) * 3, ((1.0, 1.0, 0.0), (1.0, 1.0, 0.0), (0.0,) * 3), (-9.0,) * 3, (9.0,) * 3)
    rows = exact.sample(np.array([1.0, 2.0, 3.0]), 50, np.random.default_rng(3))
    np.testing.assert_allclose(rows[:, 1] - rows[:, 0], 1.0, atol=1e-4)
    assert (rows[:, 2] == 3.0).all()
    assert rows[:, 0].std() > 0.5


def test_a_fit_of_two_effects_that_act_alike_knows_their_correlation_and_a_model_file_keeps_it(tmp_path: Path) -> None:
    recording = swung(seconds=0.3)
    model = drawing(recording).add_effect("joint_damping").add_effect("joint_friction")
    fitted = cw.fit_effects(model, recording).model
    posterior = fitted.effects[0].posterior
    assert posterior is not None
    assert fitted.effects[1].posterior is posterior
    assert [a.first for a in fitted.effects] == [0, 1]
    std = np.sqrt(np.diag(posterior.matrix))
    assert posterior.matrix[0, 1] / std.prod() < -0.6  # more of one for less of the other
    ((_, high),) = fitted.effects[0].intervals
    assert fitted.effects[0].values[0] == pytest.approx(DAMPING, rel=0.2)
    assert std[0] == pytest.approx((high - fitted.effects[0].values[0]) / 1.96)
    fitted.save(tmp_path / "model.toml")
    again = cw.load_model(tmp_path / "model.toml")
    assert [(a.posterior, a.first) for a in again.effects] == [(posterior, 0), (posterior, 1)]
    again.without(0).save(tmp_path / "fewer.toml")
    (left,) = cw.load_model(tmp_path / "fewer.toml").effects
    assert left.posterior is not None
    np.testing.assert_allclose(left.posterior.matrix, posterior.matrix[1:, 1:])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"scale": None}, "entries are missing"),
        ({"effects": [0, 2]}, "effects are not right"),
        ({"effects": [0, 0]}, "effects are not right"),
        ({"effects": [0]}, "numbers are missing"),
        ({"scale": [1.0, 0.0]}, "covariance or scale is none"),
        ({"covariance": [[1.0, 0.0]]}, "numbers are missing"),
        ({"covariance": [[1.0, 0.5], [0.4, 1.0]]}, "covariance or scale is none"),
        ({"covariance": [[1.0, 2.0], [2.0, 1.0]]}, "covariance or scale is none"),
        ({"covariance": [[np.inf, 0.0], [0.0, 1.0]]}, "covariance or scale is none"),
        ({"low": ["a", 1.0]}, "numbers are missing"),
    ],
)  # fmt: skip
def test_a_posterior_that_cannot_be_is_refused_with_its_place(changes: dict[str, Any], words: str) -> None:
    (row,) = posteriors_table(EFFECTS)
    assert list(with_posteriors([replace(a, posterior=None, first=0) for a in EFFECTS], [row], Path("m.toml"))) == [
        *EFFECTS
    ]
    wrong = {name: value for name, value in {**row, **changes}.items() if value is not None}
    with pytest.raises(cw.ModelError, match=words) as raised:
        with_posteriors(EFFECTS, [wrong], Path("m.toml"))
    assert "m.toml: posterior 0" in str(raised.value)
