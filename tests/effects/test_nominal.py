"""Nominal values within their tolerance, as effects of a model."""

from __future__ import annotations

import numpy as np
import pytest

from concent_warp.effects.registry import NOMINAL, effect_class, effect_classes
from concent_warp.errors import ModelError
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from tests.scenes.foreign import BALL, PUSHER


def test_masses_lengths_and_gains_are_scaled_and_nothing_else():
    model = Model(Scene(PUSHER))
    plain = model.compile()
    heavy = model.add_effect("nominal_mass", ["fore"], {"mass[fore]": 1.01}).compile()
    np.testing.assert_allclose(heavy.body_mass, plain.body_mass * [1, 1, 1.01])
    np.testing.assert_allclose(heavy.body_inertia[2], 1.01 * plain.body_inertia[2])
    long = model.add_effect("nominal_length", ["upper"], {"length[upper]": 0.99}).compile()
    np.testing.assert_allclose(long.body_ipos[1:], [[0.1485, 0, 0], [0.12, 0, 0]])
    np.testing.assert_allclose(long.body_pos[1:], [[0, 0, 0.2], [0.297, 0, 0]])
    np.testing.assert_array_equal(long.body_mass, plain.body_mass)
    strong = model.add_effect("nominal_gain", ["elbow"], {"gain[elbow]": 1.02}).compile()
    np.testing.assert_allclose(strong.actuator_gainprm[:, 0], [12, 6.12])
    np.testing.assert_allclose(strong.actuator_biasprm[:, 2], [-0.6, -0.255])


def test_a_free_body_has_a_size_and_no_length():
    model = Model(Scene(BALL))
    m = model.compile()
    classes = {kind.name: kind for kind in NOMINAL}
    assert not classes["nominal_length"].targets(m)
    (target,) = classes["nominal_size"].targets(m)
    larger = model.add_effect("nominal_size", target, {f"size[{target[0]}]": 1.01}).compile()
    np.testing.assert_allclose(larger.geom_size[larger.geom_bodyid > 0, 0], 1.01 * m.geom_size[m.geom_bodyid > 0, 0])
    np.testing.assert_allclose(larger.body_mass, m.body_mass)


def test_nominal_values_are_no_candidates_and_stay_within_two_tolerances(tmp_path):
    assert not {kind.name for kind in NOMINAL} & set(effect_classes())
    model = Model(Scene(PUSHER)).add_effect("nominal_mass", ["fore"], {"mass[fore]": 1.015})
    model.save(tmp_path / "model.toml")
    assert Model.load(tmp_path / "model.toml").effects[0].values == (1.015,)
    for kind in NOMINAL:
        assert effect_class(kind.name) is kind
        assert kind.nominal
        for target in kind.targets(model.compile()):
            for p in kind(*target).parameters(model.compile()):
                assert (p.null, p.low, p.high) == (1.0, pytest.approx(0.98), pytest.approx(1.02))
    with pytest.raises(ModelError, match=r"1\.02"):
        Model(Scene(PUSHER)).add_effect("nominal_mass", ["fore"], {"mass[fore]": 1.1})
