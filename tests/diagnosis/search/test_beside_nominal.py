"""Effects compared beside nominal values: made-up residuals, of which nominal values take up what they can."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis.candidates.candidate import ScreenedCandidate
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.search import beside_nominal
from concent_warp.diagnosis.search.beside_nominal import BesideNominalValues
from concent_warp.diagnosis.search.nominal_values import NominalSensitivities
from concent_warp.effects.effect import Parameter
from concent_warp.effects.library.joints import DryFriction
from concent_warp.fit.effects.cfg import EffectSolverCfg
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.least_squares import Linear

COUNT = 1200
LIKE, OTHER, NOISE = np.random.default_rng(3).normal(size=(3, COUNT))
LENGTH, MASS = (SimpleNamespace(name=name, target=("arm",)) for name in ("length", "mass"))
SHARED = NominalSensitivities((("length", "arm"), ("mass", "arm")), np.stack([0.4 * LIKE, 0.4 * OTHER], axis=1))
"""Residuals in units of the noise, for a change by a tolerance."""


class MadeUpModel(SimpleNamespace):
    """A model that compiles to itself and says which nominal values it has."""

    def __replace__(self, **changes):
        return MadeUpModel(**{**vars(self), **changes})

    def compile(self):
        return self


@pytest.fixture(autouse=True)
def made_up(monkeypatch):
    def changed(one: Any, **changes: Any) -> Any:
        return one.__replace__(**changes) if isinstance(one, MadeUpModel) else plain(one, **changes)

    plain = beside_nominal.replace
    monkeypatch.setattr(beside_nominal, "replace", changed)
    monkeypatch.setattr(beside_nominal, "possible_nominal_effects", lambda model: model.kinds)


def fit_of(residual, kinds, effects=(), columns=()) -> Any:
    """Return a made-up fit: residuals, nominal values that it may have, effects and their sensitivities."""
    window = SimpleNamespace(start=0.0, end=12.0, number=0, clock=np.arange(COUNT) / 100)
    return SimpleNamespace(
        model=MadeUpModel(effects=tuple(effects), kinds=kinds), limit=4.0, cfg=EffectSolverCfg(), noise_scale=1.0,
        blocks=cut_blocks([window]), pieces=[Linear(residual, np.array(columns).reshape(-1, COUNT).T)],  # pyright: ignore
        fit=SimpleNamespace(values=np.zeros(len(effects))),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("column", "size", "kinds", "low", "high"),
    [
        (LIKE, 0.5, [LENGTH, MASS], -0.01, 0.01),  # 1.25 tolerances explain it as well
        (OTHER, 0.5, [LENGTH], 0.15, 0.25),  # no nominal value that the model may have
        (OTHER, 0.5, [LENGTH, MASS], -0.01, 0.01),
        (LIKE, 3.0, [LENGTH, MASS], 0.75, 0.9),  # two tolerances explain 0.8 of 3: (2.2^2 + 1 - 1) / (2.2^2 + 1)
    ],
)
def test_what_nominal_values_take_up_within_their_bounds_is_no_gain_of_an_effect(column, size, kinds, low, high):
    base, candidate = fit_of(NOISE + size * column, kinds), fit_of(NOISE, kinds)
    compared = BesideNominalValues(base, SHARED)
    before, after = compared.errors(base), compared.errors(candidate)
    assert low < 1 - after.sum() / before.sum() < high
    assert compared.ratio(candidate) == pytest.approx(1.0, abs=0.05)
    assert compared.errors(candidate) is after


def test_a_nominal_value_that_was_fitted_stays_within_its_bounds():
    factor = Parameter("length[arm]", "-", 1.0, 0.98, 1.02, 0.001)
    for value, least, most in ((1.0, 0.97, 1.05), (1.015, 1.1, 1.6)):
        effect = SimpleNamespace(
            effect=SimpleNamespace(name="length", target=("arm",), nominal=True, parameters=lambda _m: (factor,)),
            values=(value,),
        )
        base = fit_of(NOISE + 0.8 * LIKE, [LENGTH], [effect], [0.04 * LIKE])
        # It is fitted by its own sensitivity and not once more: from 1.015 only half a tolerance is left downhill.
        base.pieces[0] = Linear(NOISE - 0.8 * LIKE, base.pieces[0].jacobian)
        assert least < BesideNominalValues(base, SHARED).ratio(base) < most


def screened(column, gain) -> ScreenedCandidate:
    effect = DryFriction("hinge")
    return ScreenedCandidate(effect, gain, 0.0, np.zeros(1), (Linear(np.zeros(COUNT), column[:, None]),))


def test_a_candidate_is_fitted_for_what_it_promises_beside_nominal_values(monkeypatch):
    free = np.array([-np.inf, np.inf])
    monkeypatch.setattr(beside_nominal, "_own_bounds", lambda m: np.repeat(free[:, None], len(m.effects), axis=1))
    missing, wrong = np.random.default_rng(4).normal(size=(2, COUNT))
    found = {}
    for error in (0.6, 6.0):
        base = fit_of(NOISE + missing + error * LIKE, [LENGTH])
        both = [screened(missing, 0.1), screened(wrong, 0.0)]
        found[error] = BesideNominalValues(base, SHARED).promoted(both, DiagnoseCfg())
    first, other = found[0.6]
    assert first.linear_gain == pytest.approx(0.5, abs=0.05)
    assert other.linear_gain == 0.0
    # Far more than noise is left beside all: they promise what they did.
    assert [s.linear_gain for s in found[6.0]] == [0.1, 0.0]
