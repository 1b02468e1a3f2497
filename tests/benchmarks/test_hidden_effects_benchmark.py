"""A few of the benchmark's data sets, diagnosed as it does."""

import pytest

from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.model import Model

RIVALS = ("length_scale", "time_base", "size", "gravity_tilt", "air_drag", "contact_compliance")
"""What a ball that flies and bounces may lack: the effects that are most easily taken for one another."""


@pytest.fixture
def data(script):
    return script("benchmarks.diagnose.hidden_effects_data")


def named(data, name):
    """Return the data set of a name."""
    (case,) = (c for c in data.cases() if c.name == name)
    return case


def diagnosed(data, case, effects=()):
    """Return what is hidden in a data set, and the diagnosis."""
    made = data.make(case)
    cfg = DiagnoseCfg(effects=effects, jobs=1, seed=case.seed, explain=False)
    return made.truth, diagnose(Model(made.scene), made.recording, cfg)


@pytest.mark.parametrize(
    ("name", "effects", "above"),
    # Over the short windows of a free body, errors of the initial states hide most of a wrong scale.
    [
        # Among all effects, the friction of a joint is found in tests/test_examples.py too.
        pytest.param(
            "pendulum-joint_friction-middle-0", (), 1.5, id="friction among all effects", marks=pytest.mark.slow
        ),
        pytest.param(
            "drop-length_scale-middle-0", RIVALS, 1.1, id="scale of lengths among its rivals", marks=pytest.mark.slow
        ),
    ],
)
def test_the_hidden_effect_is_named_first_with_its_value(data, name, effects, above):
    (truth,), found = diagnosed(data, named(data, name), effects)
    assert found.verdict == "effect"
    assert [f.name for f in found.accepted] == [truth.effect]
    assert sum(not f.accepted for f in found.effects) >= 2
    values = {p.name: p for p in found.accepted[0].parameters}
    assert values.keys() == truth.parameters.keys()
    for key, value in truth.parameters.items():
        assert values[key].value == pytest.approx(value, rel=0.05)
        assert values[key].low <= value <= values[key].high
    assert found.ratio[0] > above
    assert found.ratio[-1] < 1.05


def test_no_effect_is_named_where_none_is_hidden(data):
    truth, found = diagnosed(data, named(data, "drop-null-0"))
    assert truth == ()
    assert found.verdict == "none_needed"
    assert found.accepted == ()
    assert found.ratio == (pytest.approx(1.0, abs=0.1),)


def test_data_sets_have_names_that_differ_and_effects_that_are_known(data):
    cases = data.cases()
    assert len({c.name for c in cases}) == len(cases)
    assert {"null", "single", "outside", "pair"} == {c.kind for c in cases}
    assert all(bool(c.magnitudes) == (c.kind != "null") for c in cases)
    assert all(len(c.magnitudes) == 2 for c in cases if c.kind == "pair")
