"""Data sets of the world on Drake, as far as they need no Drake."""

from __future__ import annotations

import sys
from collections import Counter

import pytest

from benchmarks.independent.data_set import TOLERANCE
from benchmarks.independent.drake.hidden import INSIDE
from benchmarks.independent.drake.rig import MACHINING, true_physics
from benchmarks.independent.drake.rigs import DRAKE_RIGS
from benchmarks.independent.drake_world import drake_sets, make_drake, true_model


@pytest.mark.parametrize("name", DRAKE_RIGS)
def test_nominal_values_are_wrong_within_the_tolerances(name):
    rig = DRAKE_RIGS[name]
    true = rig.drawn(5)
    masses = {m for names in rig.masses for m in names.split("+")}
    assert all(0 < abs(true[m] / rig.values[m] - 1) <= TOLERANCE for m in masses)
    for length in rig.lengths:
        assert 0 < abs(true[length] - rig.values[length]) <= min(MACHINING, TOLERANCE * rig.values[length])
    assert {n for n in true if true[n] != rig.values[n]} == masses | set(rig.lengths)


def test_there_are_enough_data_sets_of_each_kind_with_names_that_differ():
    cases = drake_sets()
    assert len({c.name for c in cases}) == len(cases)
    count = Counter(c.kind for c in cases)
    assert count["null"] >= 10
    assert count["pair"] >= 8
    assert count["outside"] >= 8
    singles = [c for c in cases if c.kind == "single"]
    assert len({e for c in singles for e in c.magnitudes}) >= 12
    assert len({c.rig for c in singles}) >= 5


def test_noise_is_stated_in_half_of_the_data_sets_of_each_kind():
    stated = Counter((c.kind, c.noise_stated) for c in drake_sets())
    assert all(abs(stated[kind, True] - stated[kind, False]) <= 1 for kind in ("null", "single", "pair", "outside"))


def test_the_missing_extra_is_named_where_drake_is_not_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "pydrake.all", None)
    for name in ("recording", "simulation"):
        monkeypatch.delitem(sys.modules, f"benchmarks.independent.drake.{name}", raising=False)
    with pytest.raises(ModuleNotFoundError, match=r"concent-warp\[benchmarks\]"):
        make_drake(drake_sets()[0])


@pytest.mark.parametrize("case", [c for c in drake_sets() if c.kind in ("single", "pair")], ids=lambda c: c.name)
def test_the_library_knows_effects_and_true_values_by_their_names(case):
    rig = DRAKE_RIGS[case.rig]
    physics = true_physics(rig, case.seed)
    truth = tuple(INSIDE[name](rig, physics, value) for name, value in case.magnitudes.items())
    model = true_model(rig.scene, truth)
    if all(t.parameters for t in truth):
        for added, t in zip(model.effects, truth, strict=True):
            # In which part a servo's damping acts on the rotor is no value of Drake's world.
            known = {p.name for p in added.effect.parameters(rig.scene.model)} - {"rotor_damping"}
            assert known == set(t.parameters)
