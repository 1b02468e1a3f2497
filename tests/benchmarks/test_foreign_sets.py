"""Data sets of the worlds on Drake and on Bullet, as far as they need neither."""

from __future__ import annotations

import sys
from collections import Counter

import pytest

from benchmarks.independent.bullet_world import BULLET
from benchmarks.independent.data_set import TOLERANCE
from benchmarks.independent.drake_world import DRAKE
from benchmarks.independent.foreign.hidden import INSIDE
from benchmarks.independent.foreign.rig import MACHINING, true_physics
from benchmarks.independent.foreign.world import true_model

WORLDS = pytest.mark.parametrize("world", [DRAKE, BULLET], ids=lambda w: w.name)
RIGS = [pytest.param(world, name, id=f"{world.name}-{name}") for world in (DRAKE, BULLET) for name in world.rigs]
CASES = [
    pytest.param(world, case, id=case.name)
    for world in (DRAKE, BULLET)
    for case in world.sets()
    if case.kind in ("single", "pair")
]


@pytest.mark.parametrize(("world", "name"), RIGS)
def test_nominal_values_are_wrong_within_the_tolerances(world, name):
    rig = world.rigs[name]
    true = rig.drawn(5)
    masses = {m for names in rig.masses for m in names.split("+")}
    assert all(0 < abs(true[m] / rig.values[m] - 1) <= TOLERANCE for m in masses)
    for length in rig.lengths:
        assert 0 < abs(true[length] - rig.values[length]) <= min(MACHINING, TOLERANCE * rig.values[length])
    assert {n for n in true if true[n] != rig.values[n]} == masses | set(rig.lengths)


@pytest.mark.parametrize(
    ("world", "least"), [(DRAKE, (10, 8, 8, 12)), (BULLET, (12, 6, 8, 14))], ids=lambda x: getattr(x, "name", "")
)
def test_there_are_enough_data_sets_of_each_kind_with_names_that_differ(world, least):
    cases = world.sets()
    assert len({c.name for c in cases}) == len(cases)
    assert all(c.name.startswith(f"{world.name}-") for c in cases)
    count = Counter(c.kind for c in cases)
    singles = [c for c in cases if c.kind == "single"]
    effects = {e for c in singles for e in c.magnitudes}
    assert all(
        n >= m for n, m in zip((count["null"], count["pair"], count["outside"], len(effects)), least, strict=True)
    )
    assert len({c.rig for c in singles}) >= 5


@WORLDS
def test_noise_is_stated_in_half_of_the_data_sets_of_each_kind(world):
    stated = Counter((c.kind, c.noise_stated) for c in world.sets())
    assert all(abs(stated[kind, True] - stated[kind, False]) <= 1 for kind in ("null", "single", "pair", "outside"))


@pytest.mark.parametrize(("world", "module"), [(DRAKE, "pydrake.all"), (BULLET, "pybullet")], ids=["drake", "bullet"])
def test_the_missing_extra_is_named_where_the_engine_is_not_installed(monkeypatch, world, module):
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delitem(sys.modules, f"benchmarks.independent.{world.name}.simulation", raising=False)
    with pytest.raises(ModuleNotFoundError, match=r"concent-warp\[benchmarks\]"):
        world.make(world.sets()[0])


@pytest.mark.parametrize(("world", "case"), CASES)
def test_the_library_knows_effects_and_true_values_by_their_names(world, case):
    rig = world.rigs[case.rig]
    physics = true_physics(rig, case.seed)
    truth = tuple(INSIDE[name](rig, physics, value) for name, value in case.magnitudes.items())
    model = true_model(rig.scene, truth)
    if all(t.parameters for t in truth):
        assert model is not None
        for added, t in zip(model.effects, truth, strict=True):
            # In which part a servo's damping acts on the rotor is no value of these worlds.
            known = {p.name for p in added.effect.parameters(rig.scene.model)} - {"rotor_damping"}
            assert known == set(t.parameters)
