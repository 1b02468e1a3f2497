"""Springs along tendons are nominal values of a model."""

import numpy as np
import pytest

from concent_warp.effects.registry import effect_class
from concent_warp.errors import ModelError
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from tests.scenes.foreign import PUSHER

SLED = """
<mujoco>
  <worldbody>
    <body name="stage"><joint name="stage" type="slide"/><geom size="0.1"/></body>
    <body name="sled"><joint name="sled" type="slide"/><geom size="0.1"/></body>
  </worldbody>
  <tendon>
    <fixed name="rope"><joint joint="sled" coef="1"/></fixed>
    <fixed name="spring" stiffness="150" damping="0.3">
      <joint joint="stage" coef="1"/><joint joint="sled" coef="-1"/>
    </fixed>
  </tendon>
</mujoco>
"""


def test_springs_of_tendons_are_nominal_values(tmp_path):
    kind = effect_class("nominal_tendon_stiffness")
    model = Model(Scene(SLED))
    plain = model.compile()
    assert kind.targets(plain) == (("spring",),)
    stiff = model.add_effect(kind.name, ["spring"], {"stiffness[spring]": 1.01})
    stiff.save(tmp_path / "model.toml")
    m = Model.load(tmp_path / "model.toml").compile()
    np.testing.assert_allclose(m.tendon_stiffness, [0, 151.5])
    np.testing.assert_array_equal(m.tendon_damping, plain.tendon_damping)
    assert kind.targets(Model(Scene(PUSHER)).compile()) == ()


def test_a_tendon_that_is_not_there_is_named():
    with pytest.raises(ModelError, match=r"tendons among \['rope', 'spring'\]"):
        Model(Scene(SLED)).add_effect("nominal_tendon_stiffness", ["string"], {})
