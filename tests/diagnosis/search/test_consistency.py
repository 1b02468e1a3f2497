"""A cart that a servo pulls along a rail, several times: with one damping, or with another one each time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from concent_warp.diagnosis.candidates.baseline import fit_baseline
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.result import UnknownForceFound
from concent_warp.diagnosis.search import consistency
from concent_warp.diagnosis.search.consistency import beyond_effects, inconsistent_effect, variation
from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.observe import observe
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from concent_warp.scene.scene import Scene
from tests.diagnosis.search.test_unknown_force_search import rail, ridden

CFG = DiagnoseCfg(jobs=1, explain=False)


def fitted(dampings):
    """Return the model without damping and with it, fitted to rides with some dampings [N s/m]."""
    rides = [ridden(damping=damping, seconds=2.0, seed=k)[0] for k, damping in enumerate(dampings)]
    demonstrations = tuple(replace(d, name=f"demo_{k}") for k, d in enumerate(rides))
    given = Model(Scene(rail()))
    recording = Recording(rail(), demonstrations)
    windows = observe(given, recording)
    both = (given, given.add_effect("joint_damping"))
    return [fit_baseline(model, windows, cut_blocks(windows)) for model in both]


@pytest.fixture(scope="module")
def same():
    return fitted([6.0] * 6)


@pytest.fixture(scope="module")
def different():
    return fitted([3.0, 9.0, 4.0, 8.0, 3.5, 8.5])


def test_an_effect_with_one_value_is_consistent(same):
    first, last = same
    assert len(last.windows) == 6
    assert last.ratio < 1.1 < 2 < first.ratio
    assert inconsistent_effect(first, last, (), CFG) is None
    assert variation(last, 0, CFG).p > CFG.significance_level


def test_one_with_another_value_in_each_window_explains_more(different):
    first, last = different
    found = inconsistent_effect(first, last, (), CFG)
    assert found is not None
    assert not found.form_error
    assert found.p <= CFG.significance_level
    assert "joint_damping with another value in each window" in found.sentence.lower()
    # Values of each window by itself explain nearly all that a common one leaves.
    assert 0.9 < variation(last, 0, CFG).gain <= 1.0
    # One that the model had before is not what was found, and a single window says nothing.
    assert inconsistent_effect(last, last, (), CFG) is None
    one = observe(Model(Scene(rail())), ridden(damping=5.0, seconds=2.0))
    alone = fit_baseline(last.model, one, cut_blocks(one))
    assert inconsistent_effect(first, alone, (), CFG) is None


def test_formulas_that_are_exact_leave_less_to_errors(different, monkeypatch):
    first, last = different
    share = variation(last, 0, CFG).excess
    monkeypatch.setattr(consistency, "variation", lambda *_: consistency.Variation(0.1 * share, 0.1, 0.001))
    assert inconsistent_effect(first, last, (), CFG) is None
    monkeypatch.setattr(effect_class("joint_damping"), "exact", True)
    found = inconsistent_effect(first, last, (), CFG)
    assert found is not None
    assert not found.form_error
    assert effect_class("gravity_tilt").exact


@pytest.mark.parametrize(
    ("force", "effect", "corrected", "named"),
    [
        (None, None, False, None),
        (("a force", 0.3, False), ("damping", 0.3, False), False, ("a force", False)),
        (("a force", 0.03, True), ("damping", 0.2, False), False, ("damping", False)),
        (("a force", 0.03, True), None, False, ("a force", True)),
        (None, ("damping", 0.2, False), True, ("damping", True)),  # what a correction of the formula takes away
        (("a force", 0.3, False), None, True, ("a force", False)),
    ],
)
def test_a_force_of_unknown_form_comes_before_an_effect_that_varies(monkeypatch, force, effect, corrected, named):
    def found(kind):
        return None if kind is None else UnknownForceFound(kind[0], 0.1, 0.01, kind[1], form_error=kind[2])

    monkeypatch.setattr(consistency, "unknown_force", lambda *_: found(force))
    monkeypatch.setattr(consistency, "inconsistent_effect", lambda *_: found(effect))
    answer = beyond_effects([None, None], (), CFG, map, form_corrected=corrected)  # pyright: ignore[reportArgumentType]
    assert (None if answer is None else (answer.words, answer.form_error)) == named


def test_blocks_of_one_window_alone_do_not_count_as_windows(different):
    _, last = different
    shuffled = np.random.default_rng(0).permutation(len(last.windows))
    other = replace(last, **{n: tuple(getattr(last, n)[k] for k in shuffled) for n in ("windows", "pieces")})
    other = replace(other, blocks=replace(last.blocks, of_row=tuple(last.blocks.of_row[k] for k in shuffled)))
    assert variation(other, 0, CFG).excess == pytest.approx(variation(last, 0, CFG).excess)


def test_where_another_effect_of_the_group_is_the_same_in_all_windows_nothing_is_said(different, same, monkeypatch):
    first, last = different
    other = first.model.add_effect("joint_friction")
    group = {"joint_damping": last.model, "joint_friction": other}
    asked = []

    def refit(model, windows, answer):
        asked.append([added.effect.name for added in model.effects])
        assert windows is last.windows
        return answer

    both = fit_baseline(last.model.add_effect("joint_friction"), last.windows, last.blocks)
    for answer, named in ((same[1], False), (last, True)):
        monkeypatch.setattr(consistency, "fit_baseline", lambda m, w, *_, answer=answer, **__: refit(m, w, answer))
        found = inconsistent_effect(first, last, ({}, group), CFG)
        assert (found is not None) == named
    assert asked == [["joint_friction"]] * 2
    assert inconsistent_effect(first, last, ({"joint_friction": other},), CFG) is not None
    # One that the model has besides is no rival.
    monkeypatch.setattr(consistency, "variation", lambda *_: consistency.Variation(1e6, 0.5, 0.001))
    assert inconsistent_effect(first, both, (group,), CFG) is not None
    assert len(asked) == 2
