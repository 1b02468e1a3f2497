"""Held-out errors of fits with a parameter at a bound, beyond which no fold may lead."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from concent_warp.diagnosis.candidates.baseline import (
    fit_baseline,
    held_out_errors,
    refit_without_effect,
    without_outward,
)
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.diagnosis.search.nominal_values import has_bounded_nominal_values
from concent_warp.effects.effect import AddedEffect
from concent_warp.effects.library.drives import ActuatorGain
from concent_warp.effects.library.joints import JointDamping, JointFriction
from concent_warp.effects.library.nominal import NominalGain
from concent_warp.fit.effects.cfg import EffectSolverCfg
from concent_warp.fit.effects.cross_validation import Blocks, HeldOut, Sums, cut_blocks
from concent_warp.fit.effects.least_squares import Linear
from concent_warp.fit.effects.observe import observe
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine
from tests.scenes.swinging import swing_scene, swung

XML = """
<mujoco><option timestep="0.002"/><worldbody><body name="arm"><joint name="hinge" type="hinge" axis="0 1 0"
damping="{damping}"/><geom name="arm" type="sphere" size="0.01" pos="0 0 -0.2" mass="0.2"/></body></worldbody>
<sensor><jointpos name="angle" joint="hinge"/></sensor></mujoco>
"""
COUNT = 8


def blocks() -> Blocks:
    """Return blocks of one demonstration, in four folds."""
    place = np.arange(COUNT, dtype=float)
    return Blocks((np.arange(COUNT),), np.arange(COUNT) % 4, np.zeros(COUNT, int), place, place + 1)


def sums(slope: float, others: int = 0) -> Sums:
    """Return sums over the blocks for one parameter with this slope of the error, and others."""
    size, rng = 1 + others, np.random.default_rng(0)
    slopes = rng.normal(size=(COUNT, size))
    slopes[:, 0] = slope
    normal = np.tile(np.eye(size), (COUNT, 1, 1))
    return Sums(normal, slopes, np.full(COUNT, 9.0))


def test_no_fold_leads_beyond_a_bound():
    bare = Model(Scene(XML.format(damping=0.0)))
    at_bound = replace(bare, effects=(AddedEffect(JointFriction("hinge"), (0.0,)),))
    inside = replace(bare, effects=(AddedEffect(JointFriction("hinge"), (0.1,)),))
    damping = AddedEffect(JointDamping("hinge"), (0.1,))  # what it does scatters: it is worse where it is held out
    for model, slope, held in ((at_bound, 0.2, True), (at_bound, -0.2, False), (inside, 0.2, False)):
        given = sums(slope, others=1)
        stays = replace(given, normal=given.normal * [[0, 0], [0, 1]], slope=given.slope * [0, 1])
        found = held_out_errors(replace(model, effects=(*model.effects, damping)), given, blocks(), 10.0)
        free, fixed = (HeldOut(one, blocks(), 10.0).own() for one in (given, stays))
        assert found == pytest.approx(fixed if held else free)
        assert given.square.sum() < free.sum() < fixed.sum() - 0.2


def test_what_no_step_of_the_fit_could_take_is_no_gain():
    bare = Model(Scene(XML.format(damping=0.0)))
    inside = replace(bare, effects=(AddedEffect(JointFriction("hinge"), (0.1,)),))
    for given in (sums(1.0), sums(-1.0)):
        assert HeldOut(given, blocks(), 10.0).own().sum() < given.square.sum()
        assert held_out_errors(inside, given, blocks(), 10.0) == pytest.approx(given.square)


def test_what_is_at_a_bound_leaves_the_other_parameters_as_they_are():
    bare = Model(Scene(XML.format(damping=0.0)))
    added = AddedEffect(JointFriction("hinge"), (0.0,)), AddedEffect(JointDamping("hinge"), (0.1,))
    given = sums(1.0, others=1)
    alone = Sums(given.normal[:, 1:, 1:], given.slope[:, 1:], given.square)
    found = held_out_errors(replace(bare, effects=added), given, blocks(), 10.0)
    assert found == pytest.approx(HeldOut(alone, blocks(), 10.0).own())


def test_a_candidate_promises_nothing_that_a_nominal_value_beyond_its_bound_would_explain():
    """The servo is weaker than the model's: its gain is at the end of its tolerance, and would move on alone."""
    recording = swung(damping=0.0)
    model = Model(Scene(swing_scene(kp=1.1))).add(NominalGain("servo"))
    windows = observe(model, recording)
    base = fit_baseline(model, windows, cut_blocks(windows))
    assert base.model.effects[0].values == pytest.approx((0.98,))
    assert has_bounded_nominal_values(base.model)
    assert not has_bounded_nominal_values(model)
    assert base.ratio > 3
    assert screen(base, ActuatorGain("servo")).expected_gain > 0.9
    assert screen(base, JointFriction("hinge")).expected_gain < 0.1


def test_a_nominal_value_may_leave_the_bound_to_which_the_lack_of_a_candidate_has_led():
    """The residual is 2 a + 3 b: a value with the sensitivity a rises alone and beside b, and falls beside a + b."""
    a, b = np.eye(2).repeat(20, axis=1)
    of_rows = Blocks((np.arange(40) // 5,), *(np.arange(8) % 4, np.zeros(8, int), np.arange(8.0), np.arange(8.0) + 1))
    for bound, value, beside, free in (
        ("high", 1.02, [], False),
        ("high", 1.02, [b], False),
        ("high", 1.02, [a + b], True),
        ("low", 0.98, [], True),
        ("low", 0.98, [a + b], False),
        ("inside", 1.01, [], True),
    ):
        model = Model(Scene(swing_scene(kp=1.1))).add_effect("nominal_gain", ["servo"], {"gain[servo]": value})
        pieces = [Linear(-2 * a - 3 * b, np.stack([a, *beside], axis=1))]
        base = SimpleNamespace(
            model=model, blocks=of_rows, limit=np.inf, cfg=EffectSolverCfg(),
            fit=SimpleNamespace(values=[value]), solver=lambda: SimpleNamespace(prior=np.zeros_like),
        )  # fmt: skip
        (found,) = without_outward(base, pieces)  # pyright: ignore[reportArgumentType]
        assert bool(found.jacobian[:, 0].any()) is free, bound
        np.testing.assert_array_equal(found.jacobian[:, 1:], pieces[0].jacobian[:, 1:])


def test_an_effect_at_its_null_value_gains_nothing_over_the_model_without_it():
    """The model has more damping than the arm: friction below zero would help, and is none."""
    truth, model = Model(Scene(XML.format(damping=0.002))), Model(Scene(XML.format(damping=0.006)))
    steps = 1000
    rollout = MujocoEngine(truth).run(Variants(1, qpos=np.array([[1.0]]), qvel=np.zeros((1, 1))), np.zeros((steps, 0)))
    time, noise = 0.01 * np.arange(200), np.random.default_rng(0).normal(size=200)
    value = np.interp(time, rollout.numpy().time, rollout.numpy().sensordata[0, :, 0]) + 1e-3 * noise
    seen = {"angle": Channel(time, value[:, None], noise_std=1e-3)}
    one = Demonstration("one", "swing", qpos=np.array([1.0]), qvel=np.zeros(1), measured=seen)
    windows = observe(model, Recording(model.scene.xml, (one,), "made up"))
    with_friction = fit_baseline(model.add(JointFriction("hinge")), windows, cut_blocks(windows))
    without = refit_without_effect(with_friction, 0)
    assert with_friction.model.effects[0].values == (0.0,)
    assert with_friction.ratio > 3
    assert with_friction.errors.sum() == pytest.approx(without.errors.sum(), rel=1e-3)
