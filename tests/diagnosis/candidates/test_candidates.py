import pytest

from concent_warp.diagnosis.candidates.candidates import candidates, has_effect, label
from concent_warp.effects.registry import effect_class, effect_classes
from concent_warp.errors import ModelError
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from tests.scenes.swinging import swing_scene
from tests.scenes.tossing import EDGE, toss_scene


def swing():
    return Model(Scene(swing_scene(quaternion=True)))


def test_every_effect_that_may_act_on_a_model_is_a_candidate():
    found = candidates(swing(), {"angle", "turned"})
    m = swing().compile()
    expected = {name for name, kind in effect_classes().items() if kind.targets(m)}
    assert {e.name for e in found} == expected
    assert "joint_friction" in expected
    assert "rolling_friction" not in expected


def test_instruments_without_readings_have_no_residual():
    found = candidates(swing(), {"angle"})
    sensors = [e.target for e in found if e.kind == "sensor"]
    assert sensors
    assert all(target == ("angle",) for target in sensors)
    assert not [e for e in candidates(swing(), set()) if e.kind == "sensor"]


def test_what_a_model_has_already_is_left_out():
    damping = effect_class("joint_damping")("hinge")
    model = swing().add(damping)
    assert has_effect(model, damping)
    assert not has_effect(model, effect_class("joint_friction")("hinge"))
    assert "joint_damping" not in [e.name for e in candidates(model, {"angle"})]


def test_effects_asked_for_are_the_only_ones():
    cube = Model(Scene(toss_scene(EDGE)))
    assert [e.name for e in candidates(cube, set(), ["sliding_friction", "air_drag"])] == [
        "sliding_friction",
        "air_drag",
    ]
    with pytest.raises(ModelError, match="did you mean 'air_drag'"):
        candidates(cube, set(), ["air_drga"])


def test_labels_distinguish_what_shares_a_name():
    friction = effect_class("joint_friction")
    one, other, world = friction("a"), friction("b", "c"), effect_class("air_drag")()
    assert label(one, [one, world]) == "joint_friction"
    assert label(one, [one, other]) == "joint_friction(a)"
    assert label(other, [one, other]) == "joint_friction(b, ...)"
    assert label(world, [world, world]) == "air_drag"
