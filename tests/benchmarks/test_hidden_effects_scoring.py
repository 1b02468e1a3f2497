"""The scoring of the hidden-effect benchmark, from results written by hand."""

import numpy as np
import pytest


@pytest.fixture
def report(script):
    return script("benchmarks.diagnose.hidden_effects_report")


def row(kind, truth, groups=(), *, verdict=None, rig="pendulum", ratio=(3.0, 1.0), rejected=(), interval=None):
    """Return a result: the first of each group is accepted; `truth` maps effects to their true values."""
    hidden = [{"name": name, "parameters": {"p": value}} for name, value in truth.items()]

    def effect(name, accepted):
        parameters = [{"name": "p", "interval": list(interval or (0.0, 1.0))}]
        return {"name": name, "accepted": accepted, "parameters": parameters}

    effects = [effect(group[0], True) for group in groups] + [effect(name, False) for name in rejected]
    default = "effect" if groups else "none_needed"
    return {
        "name": "-".join([rig, kind, *truth]), "kind": kind, "rig": rig, "truth": hidden, "seconds": 1.0,
        "verdict": verdict or default, "groups": [list(g) for g in groups], "effects": effects, "ratio": list(ratio),
    }  # fmt: skip


MASS = {"mass": 0.5}


@pytest.mark.parametrize(
    ("groups", "rejected", "first", "exact", "in_group"),
    [
        ([["mass"]], (), True, True, True),
        ([["mass(block)"]], (), True, True, True),
        ([["mass", "inertia"]], (), True, False, True),
        ([["inertia", "mass"]], (), False, False, True),
        ([["mass"], ["wind"]], (), True, False, True),
        ([["wind"], ["mass"]], (), False, False, False),
        ([["wind"]], ("mass",), False, False, False),
        ([], ("mass",), False, False, False),
    ],
)
def test_an_effect_is_right_first_alone_or_in_its_group(report, groups, rejected, first, exact, in_group):
    one = row("single", MASS, groups, rejected=rejected)
    assert report.first_right(one) is first
    assert report.exactly_right(one) is exact
    assert report.in_group(one) is in_group


def test_a_diagnosis_that_ended_in_an_error_is_right_in_nothing_and_no_false_silence(report):
    one = {"name": "x", "kind": "single", "rig": "arm", "truth": [{"name": "mass", "parameters": {}}], "error": "x"}
    assert not report.first_right(one)
    assert not report.in_group(one)
    assert not report.exactly_right(one)
    assert not report.none_of_these(one)
    assert not report.at_floor(one)
    assert report.alarm(one)


@pytest.mark.parametrize(
    ("groups", "found"),
    [
        ([["mass"], ["wind"]], True),
        ([["wind", "drag"], ["mass"]], True),
        ([["mass", "wind"]], False),
        ([["mass", "wind"], ["wind"]], True),
        ([["mass"]], False),
        ([["mass"], ["drag"]], False),
        ([], False),
    ],
)
def test_two_effects_are_found_where_each_is_in_a_group_of_its_own(report, groups, found):
    assert report.both_found(row("pair", {"mass": 1.0, "wind": 2.0}, groups)) is found


@pytest.mark.parametrize(
    ("verdict", "alarm", "none"),
    [
        ("none_needed", False, False),
        ("none_of_these", True, True),
        ("effect", True, False),
        ("group", True, False),
    ],
)
def test_verdicts_on_data_without_effect_or_with_an_unknown_one(report, verdict, alarm, none):
    assert report.alarm(row("null", {}, verdict=verdict)) is alarm
    assert report.none_of_these(row("outside", {"magnet": 1.0}, verdict=verdict)) is none


def test_coverage_counts_the_parameters_of_effects_that_were_rightly_named(report):
    rows = [
        row("single", MASS, [["mass"]], interval=(0.4, 0.6)),
        row("single", MASS, [["mass"]], interval=(0.5, 0.6)),
        row("single", MASS, [["mass"]], interval=(0.51, 0.6)),
        row("single", MASS, [["mass"]], interval=(None, 0.6)),
        row("single", MASS, [["wind"]], interval=(0.4, 0.6)),
    ]
    assert report.coverage(rows) == [True, True, False]


def test_shares_have_wilsons_interval(report):
    share, low, high = report.wilson([True] * 8 + [False] * 2)
    assert share == 0.8
    assert (low, high) == (pytest.approx(0.4902, abs=1e-4), pytest.approx(0.9433, abs=1e-4))
    assert np.isnan(report.wilson([])).all()
    assert report.figure("a", "b", []) == ["a", "b", "-", "-", "0"]


def test_the_table_counts_each_kind_by_its_own_measure(report):
    rows = [
        row("single", MASS, [["mass"]], rig="drop", ratio=(3.0, 1.0), interval=(0.4, 0.6)),
        row("single", MASS, [["mass", "wind"]], ratio=(3.0, 1.5), interval=(0.6, 0.7)),
        row("single", MASS, [["wind", "mass"]]),
        row("single", MASS, [], verdict="none_of_these"),
        row("null", {}),
        row("null", {}, [["wind"]]),
        row("null", {}),
        row("outside", {"magnet": 1.0}, verdict="none_of_these"),
        row("outside", {"magnet": 1.0}, [["wind"]]),
        row("pair", {"mass": 1.0, "wind": 1.0}, [["mass"], ["wind"]]),
    ]
    found = [(share, count) for _, _, share, _, count in report.all_shares(rows)]
    assert found == [
        ("50 %", "4"),  # right first
        ("100 %", "1"),  # on rigs whose Reality equals the nominal model
        ("33 %", "3"),  # on the others
        ("25 %", "4"),  # exactly right
        ("75 %", "4"),  # in the first group
        ("33 %", "3"),  # false alarms
        ("50 %", "2"),  # none of these
        ("100 %", "1"),  # both found
        ("50 %", "2"),  # error at the floor
        ("50 %", "2"),  # intervals
    ]


def test_detection_limits_are_medians_over_data_that_hide_nothing(report):
    def detectable(size, unit="N"):
        return {"name": "wind", "parameter": "force[block]", "size": size, "unit": unit}

    rows = [{**row("null", {}), "detectable": [detectable(size)]} for size in (1.0, 9.0, 2.0)]
    rows.append({**row("single", MASS), "detectable": [detectable(100.0)]})
    (found,) = report.detection_limits(rows)
    assert found == {"effect": "wind", "rig": "pendulum", "parameter": "force", "unit": "N", "size": 2.0, "sets": 3}
