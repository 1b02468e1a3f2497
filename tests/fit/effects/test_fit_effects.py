import numpy as np
import pytest

from concent_warp.effects.registry import effect_class
from concent_warp.errors import ModelError
from concent_warp.fit.effects.fit import fit_effects
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from tests.scenes.swinging import DAMPING, drawing, swing_scene, swung


def model_with(recording, *names):
    model = drawing(recording)
    for name in names:
        (target,) = effect_class(name).targets(model.compile())
        model = model.add(effect_class(name)(*target))
    return model


@pytest.fixture(scope="module")
def recording():
    return swung()


def test_values_and_intervals_are_in_the_model_and_survive_saving(recording, tmp_path):
    fitted = fit_effects(model_with(recording, "joint_damping"), recording)
    ((damping,),) = fitted.parameters
    assert damping.low < DAMPING < damping.high
    assert 0.1 * DAMPING < damping.high - damping.low < 0.15 * DAMPING  # friction scatters by 3 %
    assert damping.excludes_null
    assert fitted.converged
    assert fitted.remarks == ()
    fitted.model.save(tmp_path / "m.toml")
    (added,) = Model.load(tmp_path / "m.toml").effects
    assert added.values == (damping.value,)
    assert added.intervals == ((damping.low, damping.high),)


def test_the_fall_of_the_error_is_reported_by_channel(recording):
    fitted = fit_effects(model_with(recording, "joint_damping"), recording)
    assert fitted.before > 3
    assert fitted.after == pytest.approx(1.0, abs=0.1)
    assert fitted.fall == pytest.approx(1 - (fitted.after / fitted.before) ** 2)
    (channel,) = fitted.channels
    assert (channel.channel, channel.before, channel.after) == ("angle", fitted.before, fitted.after)


def test_a_fit_that_begins_at_the_noise_is_not_said_to_have_failed(recording):
    model = model_with(recording, "joint_damping")
    for _ in range(3):
        fitted = fit_effects(model, recording)
        assert fitted.after < 1.05
        assert fitted.remarks == ()
        model = fitted.model


def test_intervals_cover_the_truth_about_as_often_as_stated():
    covered = []
    for seed in range(12):
        recording = swung(seconds=1.0, seed=seed)
        ((damping,),) = fit_effects(model_with(recording, "joint_damping"), recording).parameters
        covered.append(damping.low < DAMPING < damping.high)
    assert sum(covered) >= 9  # of 12 at 95 %; fewer than 9 has a chance of 1 in 5000


def test_an_effect_that_is_not_needed_is_reported_to_do_nothing(recording):
    fitted = fit_effects(model_with(recording, "joint_damping", "joint_friction"), recording)
    damping, friction = (group[0] for group in fitted.parameters)
    assert damping.excludes_null
    assert not friction.excludes_null
    assert "joint_friction may be absent: within its interval it does nothing." in fitted.remarks


def test_what_the_recording_does_not_determine_is_named(recording):
    model = model_with(recording, "joint_damping", "actuator_saturation")
    fitted = fit_effects(model, recording)
    limit = fitted.parameters[1][0]
    assert np.isinf(limit.high)
    assert not limit.excludes_null
    assert "The recording hardly determines limit." in fitted.remarks


def test_parameters_that_act_alike_are_named():
    recording = swung()
    model = model_with(recording, "mass", "inertia", "armature", "gravity_compensation", "actuator_gain")
    fitted = fit_effects(model, recording)
    assert any("act so alike" in remark or "hardly determines" in remark for remark in fitted.remarks)


def test_a_parameter_that_runs_to_its_bound_is_named():
    pumped = swung(damping=-0.5 * DAMPING)
    model = Model(Scene(swing_scene(DAMPING))).add(effect_class("joint_damping")("hinge"))
    fitted = fit_effects(model, pumped)
    ((damping,),) = fitted.parameters
    assert (damping.value, damping.null) == (0.0, DAMPING)
    assert damping.at_bound
    assert any(remark.startswith("damping[hinge] ended on its bound") for remark in fitted.remarks)


def test_a_model_that_diverges_is_refused(recording):
    wild = swing_scene().replace('damping="0.0"', 'stiffness="-1e8"')
    model = Model(Scene(wild)).add(effect_class("armature")("hinge"))
    with pytest.raises(ModelError, match="does not stay finite"):
        fit_effects(model, recording)


def test_a_model_without_effects_is_refused(recording):
    with pytest.raises(ModelError, match="no effects to fit"):
        fit_effects(drawing(recording), recording)


def test_progress_rises_to_one(recording):
    seen = []
    fit_effects(
        model_with(recording, "joint_damping"), recording, progress=lambda share, text: seen.append((share, text))
    )
    shares = [share for share, _ in seen]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert all(text for _, text in seen)
