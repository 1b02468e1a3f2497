"""Scoring of the benchmark on independent worlds, on results written by hand."""

import numpy as np
import pytest


@pytest.fixture
def scoring(script):
    return script("benchmarks.independent.scoring")


def truth(*names, target=("block",), known=True):
    return [{"name": n, "parameters": {"p": 1.0}, "target": list(target), "known": known} for n in names]


def row(kind, hidden=(), groups=(), *, verdict=None, interval=(0.0, 2.0), targets=None, **rest):
    """Return a result: the first of each group is accepted."""
    effects = [
        {
            "name": group[0],
            "accepted": True,
            "target": list(targets or ("block",)),
            "parameters": [{"name": "p", "interval": list(interval)}],
        }
        for group in groups
    ]
    said = verdict or ("none_needed" if not groups else "group" if any(len(g) > 1 for g in groups) else "effect")
    found = {
        "name": "-".join([kind, *hidden]), "world": "mujoco", "kind": kind, "rig": "push", "size": "middle",
        "noise_stated": True, "locked": False, "truth": truth(*hidden), "verdict": said,
        "groups": [list(g) for g in groups], "effects": effects, "ratio": [3.0, 1.0], "seconds": 2.0,
    }  # fmt: skip
    return found | rest


def failed(kind, hidden=(), error="time-out"):
    kept = ("name", "world", "kind", "rig", "size", "noise_stated", "locked", "truth", "seconds")
    return {key: value for key, value in row(kind, hidden).items() if key in kept} | {"error": error}


@pytest.mark.parametrize(
    ("hidden", "groups", "right"),
    [
        (["mass"], [["mass"]], True),
        (["mass"], [["mass(block)"]], True),
        (["mass"], [["wind", "mass"]], True),
        (["mass"], [["wind", "mass", "inertia"]], False),
        (["mass"], [["mass"], ["wind"]], False),
        (["mass"], [["mass"], ["mass"]], False),
        (["mass"], [["wind"]], False),
        (["mass"], [], False),
        (["mass", "wind"], [["wind"], ["mass"]], True),
        (["mass", "wind"], [["wind", "mass"], ["mass", "inertia"]], True),
        (["mass", "wind"], [["mass", "wind"], ["inertia"]], False),
        (["mass", "wind"], [["mass", "wind"]], False),
        (["mass", "wind"], [["mass"]], False),
        (["mass", "wind"], [["mass"], ["wind"], ["size"]], False),
    ],
)
def test_exactly_right_is_every_hidden_effect_and_nothing_else(scoring, hidden, groups, right):
    assert scoring.exactly_right(row("single" if len(hidden) == 1 else "pair", hidden, groups)) is right


def test_a_verdict_that_more_is_missing_is_not_exactly_right(scoring):
    more = row("single", ["mass"], [["mass"]], verdict="none_of_these")
    assert not scoring.exactly_right(more)
    assert scoring.right_but_more(more)
    assert not scoring.right_but_more(row("single", ["mass"], [["wind"]], verdict="none_of_these"))
    assert not scoring.right_but_more(row("single", ["mass"], [["mass"]]))


def test_the_right_effect_on_another_body_is_wrong(scoring):
    assert not scoring.exactly_right(row("single", ["mass"], [["mass(box)"]], targets=("box",)))
    assert scoring.exactly_right(row("single", ["mass"], [["mass"]], targets=("box", "block")))


def test_the_first_group_counts_however_large_it_is(scoring):
    assert scoring.in_first_group(row("single", ["mass"], [["wind", "inertia", "size", "mass"]]))
    assert not scoring.in_first_group(row("single", ["mass"], [["wind"], ["mass"]]))
    assert not scoring.in_first_group(row("single", ["mass"]))


@pytest.mark.parametrize("error", ["time-out", "ended with -9: ", "Traceback\nValueError: x"])
def test_a_diagnosis_without_result_is_wrong_in_every_figure(scoring, error):
    for kind, hidden in (("null", ()), ("single", ["mass"]), ("outside", ["slosh"]), ("pair", ["mass", "wind"])):
        one = failed(kind, hidden, error)
        assert not scoring.score(one)
        assert not scoring.exactly_right(one)
        assert not scoring.in_first_group(one)
        assert not scoring.ended(one)
        assert error.splitlines()[-1][:20] in scoring.line(one)
    assert scoring.false_alarm(failed("null", (), error))
    assert scoring.covered([failed("single", ["mass"], error)]) == []


def test_each_kind_is_right_by_its_own_measure(scoring):
    assert scoring.score(row("null"))
    assert not scoring.score(row("null", (), [["mass"]]))
    assert not scoring.score(row("null", verdict="none_of_these"))
    assert scoring.score(row("outside", ["slosh"], verdict="none_of_these"))
    assert scoring.score(row("outside", ["slosh"], [["mass"]], verdict="none_of_these"))
    assert not scoring.score(row("outside", ["slosh"], [["mass"]]))
    assert not scoring.score(row("outside", ["slosh"]))
    assert scoring.score(row("geometry", ["contact_geometry"], [["contact_geometry"]]))


def test_coverage_counts_true_values_of_accepted_effects_only(scoring):
    rows = [
        row("single", ["mass"], [["mass"]]),
        row("single", ["mass"], [["mass"]], interval=(1.1, 2.0)),
        row("single", ["mass"], [["mass"]], interval=(None, 2.0)),
        row("single", ["mass"], [["wind", "mass"]]),
        row("pair", ["mass", "wind"], [["size"], ["wind"]]),
    ]
    assert scoring.covered(rows) == [True, False, True]


def test_a_saved_model_is_never_worse_on_held_out_data(scoring):
    rows = [
        row("single", ["mass"], [["mass"]], held_out={"changed": True, "before": 3.0, "after": 1.0}),
        row("single", ["mass"], [["mass"]], held_out={"changed": True, "before": 1.0, "after": 1.001}),
        row("single", ["mass"], [["mass"]], held_out={"changed": True, "error": "diverged"}),
        row("null", held_out={"changed": False}),
        failed("single", ["mass"]),
    ]
    assert scoring.never_worse(rows) == [True, False, False]


def test_wilsons_interval_and_words(scoring):
    share, low, high = scoring.wilson([True] * 8 + [False] * 2)
    assert share == 0.8
    assert (low, high) == (pytest.approx(0.4902, abs=1e-4), pytest.approx(0.9433, abs=1e-4))
    assert np.isnan(scoring.wilson([])).all()
    assert scoring.wilson([True] * 3)[2] == 1.0
    assert scoring.figure([]) == "-"
    assert scoring.figure([True] * 8 + [False] * 2) == "80 % [49-94] (8 of 10)"


def test_the_figures_take_each_set_where_it_belongs(scoring):
    rows = [
        row("single", ["mass"], [["mass"]]),
        row("single", ["mass"], [["wind"]]),
        row("single", ["mass"], [["mass"]], noise_stated=False),
        row("single", ["mass"], [["wind"]], world="drake"),
        row("null"),
        row("null", (), [["mass"]]),
        row("outside", ["slosh"], verdict="none_of_these"),
        row("pair", ["mass", "wind"], [["mass"], ["wind"]]),
        failed("pair", ["mass", "wind"]),
        row("geometry", ["contact_geometry"], [["size", "contact_geometry"]]),
    ]
    found = {title: scoring.figure(measure(rows)).split(" [")[0] for title, _, _, measure in scoring.FIGURES}
    counts = {title: len(measure(rows)) for title, _, _, measure in scoring.FIGURES}
    assert found["exactly right, MuJoCo, noise stated"] == "50 %"
    assert found["exactly right, MuJoCo, noise not stated"] == "100 %"
    assert found["exactly right, Drake, noise stated"] == "0 %"
    assert counts["exactly right, Drake, noise not stated"] == 0
    assert found["right one in the first group"] == "50 %"
    assert found["nothing hidden, false alarms"] == "50 %"
    assert found["two effects, both and nothing else"] == "50 %"
    assert found["contact geometry, exactly right"] == "100 %"
    assert found["came to a settled result in time"] == "90 %"


def test_the_page_shows_what_is_wrong_and_the_earlier_state(script):
    page = script("benchmarks.independent.page")
    rows = [row("single", ["mass"], [["mass"]], name="a"), failed("null") | {"name": "b"}]
    rows.append(row("single", ["mass"], [["wind"]], name="c", locked=True))
    earlier = [row("single", ["mass"], [["wind"]], name="a")]
    text = page.page([page._slim(r) for r in rows], earlier, [], "Host.")
    wrong, locked = text.split("## Wrong, development")[1].split("## Wrong, locked")
    assert "`b`" in wrong
    assert "time-out" in wrong
    assert "`a`" not in wrong
    assert "`c`" in locked
    assert "100 % [21-100] (1 of 1) | 0 % [0-79] (0 of 1)" in text
