"""What the hidden effect of a data set of the independent worlds gains."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.independent import visible
from benchmarks.independent.split import locked_names
from benchmarks.independent.worlds import all_sets, make
from concent_warp.model import Model

SETS = {case.name: case for case in all_sets()}


@pytest.mark.parametrize(
    ("name", "effect", "values"),
    [
        ("tumble-inertia-small", "inertia", (1.147,)),
        ("drop-time_base-small", "time_base", (0.006,)),
        ("tumble-worn_edge-middle", "contact_geometry", (0.008,)),
        ("tumble-slosh-middle", None, ()),
    ],
)
def test_the_hidden_effect_is_that_of_the_library_with_its_true_values(name, effect, values):
    case = SETS[name]
    data = make(case)
    found = visible.true_effect(case, data, Model(data.scene))
    assert (None if found is None else found.effect.name) == effect
    if found is not None:
        assert found.values == pytest.approx(values, abs=1e-3)
        assert ("edge_x+z-" in found.effect.target) is found.effect.is_part
        beside = {a.effect.name for a in visible.nominal_values(Model(data.scene), found)}
        assert {"nominal_mass", "nominal_size", "nominal_latency"} >= beside


def test_locked_sets_are_not_looked_at():
    locked = sorted(locked_names())[0]
    with pytest.raises(SystemExit, match=f"no development set with one hidden effect is called {locked}"):
        visible.main(visible.Args((locked,), Path()))
