"""Nominal values within their tolerance, as effects of a model."""

from __future__ import annotations

import numpy as np
import pytest

from concent_warp.effects.library.nominal import NominalMass
from concent_warp.effects.registry import NOMINAL, effect_class, effect_classes
from concent_warp.errors import ModelError
from concent_warp.fit.effects.least_squares import LeastSquaresCfg, Solver
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from tests.scenes.foreign import BALL, PUSHER
from tests.scenes.swinging import NOISE, drawing, swung, windows_of

FRICTION = (1.0, "-", 0.05)
OTHER = {"nominal_latency": (0.0, "s", 5e-4), "nominal_damping": FRICTION, "nominal_friction": FRICTION}
"""Null value, unit and tolerance of nominal values that are known otherwise than the others."""


def test_masses_lengths_and_gains_are_scaled_and_nothing_else():
    model = Model(Scene(PUSHER))
    plain = model.compile()
    heavy = model.add_effect("nominal_mass", ["fore"], {"mass[fore]": 1.01}).compile()
    np.testing.assert_allclose(heavy.body_mass, plain.body_mass * [1, 1, 1.01])
    np.testing.assert_array_equal(heavy.body_inertia, plain.body_inertia)
    assert NominalMass("fore").fields(plain) == ("body_mass",)
    slow = model.add_effect("nominal_inertia", ["fore"], {"inertia[fore]": 0.99}).compile()
    np.testing.assert_allclose(slow.body_inertia[2], 0.99 * plain.body_inertia[2])
    np.testing.assert_array_equal(slow.body_mass, plain.body_mass)
    long = model.add_effect("nominal_length", ["upper"], {"length[upper]": 0.99}).compile()
    np.testing.assert_allclose(long.body_ipos[1:], [[0.1485, 0, 0], [0.12, 0, 0]])
    np.testing.assert_allclose(long.body_pos[1:], [[0, 0, 0.2], [0.297, 0, 0]])
    np.testing.assert_array_equal(long.body_mass, plain.body_mass)
    strong = model.add_effect("nominal_gain", ["elbow"], {"gain[elbow]": 1.02}).compile()
    np.testing.assert_allclose(strong.actuator_gainprm[:, 0], [12, 6.12])
    np.testing.assert_allclose(strong.actuator_biasprm[:, 2], [-0.6, -0.255])


def test_mass_and_inertia_of_a_free_body_are_off_together():
    model = Model(Scene(BALL))
    plain = model.compile()
    body = plain.body(1).name
    heavy = model.add_effect("nominal_mass", [body], {f"mass[{body}]": 0.99}).compile()
    np.testing.assert_allclose(heavy.body_mass[1], 0.99 * plain.body_mass[1])
    np.testing.assert_allclose(heavy.body_inertia[1], 0.99 * plain.body_inertia[1])


def test_the_armature_of_joints_that_have_any_is_scaled():
    model = Model(Scene(PUSHER.replace('damping="0.05"/>', 'damping="0.05" armature="0.01"/>', 1)))
    (kind,) = (k for k in NOMINAL if k.name == "nominal_armature")
    assert kind.targets(model.compile()) == (("shoulder",),)
    assert kind.targets(Model(Scene(PUSHER)).compile()) == ()
    heavy = model.add_effect(kind.name, ["shoulder"], {"armature[shoulder]": 1.02}).compile()
    np.testing.assert_allclose(heavy.dof_armature, [0.0102, 0.0])
    np.testing.assert_array_equal(heavy.dof_damping, model.compile().dof_damping)
    assert kind.is_within(effect_class("armature")("shoulder"))


def test_friction_of_joints_that_have_any_is_scaled_about_all_their_axes():
    rod = """<mujoco><worldbody><body name="rod"><joint name="socket" type="ball" damping="0.02"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.01"/><body name="slider">
        <joint name="slide" type="slide" frictionloss="0.5"/><geom size="0.02"/></body></body></worldbody></mujoco>"""
    model = Model(Scene(rod))
    m = model.compile()
    kinds = {kind.name: kind for kind in NOMINAL}
    assert kinds["nominal_damping"].targets(m) == (("socket",),)
    assert kinds["nominal_friction"].targets(m) == (("slide",),)
    damped = model.add_effect("nominal_damping", ["socket"], {"damping[socket]": 1.1}).compile()
    np.testing.assert_allclose(damped.dof_damping, [0.022, 0.022, 0.022, 0.0])
    np.testing.assert_array_equal(damped.dof_frictionloss, m.dof_frictionloss)
    rough = model.add_effect("nominal_friction", ["slide"], {"friction[slide]": 0.9}).compile()
    np.testing.assert_allclose(rough.dof_frictionloss, [0.0, 0.0, 0.0, 0.45])


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
    assert {kind.name for kind in NOMINAL} >= {"nominal_velocity_gain", "nominal_latency"}
    for kind in NOMINAL:
        assert effect_class(kind.name) is kind
        assert kind.nominal
        for target in kind.targets(model.compile()):
            for p in kind(*target).parameters(model.compile()):
                null, unit, tolerance = OTHER.get(kind.name, (1.0, "-", 0.01))
                assert (p.null, p.unit) == (null, unit)
                assert (p.low, p.high) == pytest.approx((null - 2 * tolerance, null + 2 * tolerance))
                assert p.scale * LeastSquaresCfg().prior == pytest.approx(tolerance)
    with pytest.raises(ModelError, match=r"1\.02"):
        Model(Scene(PUSHER)).add_effect("nominal_mass", ["fore"], {"mass[fore]": 1.1})


def test_velocity_gains_are_those_of_actuators_with_velocity_feedback_and_scale_nothing_else():
    kind = effect_class("nominal_velocity_gain")
    model = Model(Scene(PUSHER))
    assert kind.targets(model.compile()) == (("shoulder", "elbow"),)
    without = Model(Scene(PUSHER.replace(' kv="0.25"', "")))
    assert kind.targets(without.compile()) == (("shoulder",),)
    assert kind.targets(Model(Scene(PUSHER.replace(' kv="0.6"', "").replace(' kv="0.25"', ""))).compile()) == ()
    assert kind.targets(Model(Scene(BALL)).compile()) == ()
    plain, changed = (
        m.compile() for m in (model, model.add_effect(kind.name, ["elbow"], {"velocity_gain[elbow]": 1.02}))
    )
    np.testing.assert_allclose(changed.actuator_biasprm[:, :3], [[0, -12, -0.6], [0, -6, -0.255]])
    np.testing.assert_array_equal(changed.actuator_gainprm, plain.actuator_gainprm)
    np.testing.assert_array_equal(changed.dof_damping, plain.dof_damping)


def test_a_latency_shifts_the_readings_of_its_sensor_alone():
    kind = effect_class("nominal_latency")
    m = Model(Scene(PUSHER)).compile()
    assert kind.targets(m) == (("shoulder_position", "elbow_position"),)
    effect, time = kind("shoulder_position", "elbow_position"), np.array([0.1, 0.4])
    asked = []

    def read(sensor: str, at: np.ndarray) -> np.ndarray:
        asked.append((sensor, at.tolist()))
        return at[:, None]

    shifted = effect.measure(m, read, np.array([4e-4, -7e-4]))
    for sensor, delay in (("shoulder_position", 4e-4), ("elbow_position", -7e-4), ("other", 0.0)):
        np.testing.assert_allclose(shifted(sensor, time), time[:, None] - delay, rtol=1e-12)
    assert [sensor for sensor, _ in asked] == ["shoulder_position", "elbow_position", "other"]


def test_a_latency_moves_predictions_along_the_motion_without_another_simulation():
    recording = swung(quaternion=True, seconds=1.0)
    (window,) = windows_of(recording)
    effect = effect_class("nominal_latency")("angle", "turned")
    prediction = Prediction(drawing(recording), (effect,), [window])
    assert prediction.measured_only.tolist() == [True, True]
    rows = {r.channel: r.rows for r in window.readings}
    plain, moved = (prediction.residuals([SimulationRequest(0, np.array([d, 0.0]))])[0] for d in (0.0, 1e-3))
    assert prediction.simulated == pytest.approx(1.0)
    np.testing.assert_array_equal(moved[rows["turned"]], plain[rows["turned"]])
    angle = next(r for r in window.readings if r.channel == "angle")
    (reader,) = prediction.readers([SimulationRequest(0, np.zeros(2))])
    earlier = reader("angle", angle.time - 1e-3)
    np.testing.assert_allclose(moved[rows["angle"]], (angle.value - earlier)[:, 0] / NOISE, atol=1e-9)
    assert np.abs(moved - plain).max() > 1.0


@pytest.mark.parametrize("delay", [6e-4, -4e-4])
def test_the_delay_of_a_channel_is_found(delay):
    recording = swung(damping=0.0)
    (d,) = recording.demonstrations
    d.measured["angle"].time[:] += delay
    solver = Solver(Prediction(drawing(recording), (effect_class("nominal_latency")("angle"),), windows_of(recording)))
    assert solver.fit().values[0] == pytest.approx(delay, abs=1e-4)


def test_a_delay_beyond_the_tolerance_of_clocks_ends_at_the_bound():
    recording = swung(damping=0.0)
    (d,) = recording.demonstrations
    d.measured["angle"].time[:] += 4e-3
    solver = Solver(Prediction(drawing(recording), (effect_class("nominal_latency")("angle"),), windows_of(recording)))
    assert solver.fit().values[0] == pytest.approx(1e-3)


def test_the_springs_of_a_model_are_nominal_values():
    kind = effect_class("nominal_stiffness")
    sprung = """<mujoco><worldbody><body><joint name="loose"/><geom size=".1"/><body>
    <joint name="sprung" stiffness="0.5"/>
    <geom size=".1"/></body></body></worldbody></mujoco>"""
    model = Model(Scene(sprung))
    assert kind.targets(model.compile()) == (("sprung",),)
    assert model.add_effect(kind.name, ["sprung"], {"stiffness[sprung]": 1.02}).compile().jnt_stiffness.tolist() == [
        0,
        0.51,
    ]
    assert kind.targets(Model(Scene(PUSHER)).compile()) == ()
