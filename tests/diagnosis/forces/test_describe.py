"""Sentences about unexplained forces, and which of them are significant."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis.forces import features
from concent_warp.diagnosis.forces.body_forces import with_significance
from concent_warp.diagnosis.forces.cfg import LocateForcesCfg
from concent_warp.diagnosis.forces.dependence import (
    Dependences,
    Pattern,
    min_share,
)
from concent_warp.diagnosis.forces.describe import (
    _direction_words,
    body_sentence,
    joint_sentence,
    nothing_sentence,
    pattern_sentence,
)
from concent_warp.diagnosis.forces.force_data import BodyForce, ForceSeries, JointForce, PhaseForce
from concent_warp.diagnosis.forces.point_of_action import ForcePlace
from concent_warp.diagnosis.forces.result import UnexplainedForces

CFG = LocateForcesCfg()
NOTHING = Dependences((), ())


def pattern(feature: str, slope: float, **changes: Any) -> Pattern:
    """Return a pattern."""
    return replace(Pattern(feature, slope, 0.01, 0.42, 0.03, ()), **changes)


def joint(*patterns: Pattern, **changes: Any) -> JointForce:
    """Return the force of a joint."""
    series = (
        ForceSeries("d0", np.array([0.1, 0.2]), np.array([0.2, np.nan]), np.array([0.1, 0.1])),
        ForceSeries("d1", np.array([0.1, 0.25]), np.array([0.1, -0.4]), np.array([0.1, 0.1])),
    )
    base = JointForce("hinge", "N m", 0.123, 0.0456, 2.0, 0.0789, 0.01, True, Dependences((), patterns), series)
    return replace(base, **changes)


@pytest.mark.parametrize(
    ("found", "sentence"),
    [
        (
            joint(pattern(features.SPEED, -0.5)),
            "hinge: 0.12 N m unexplained (rms; noise 0.046); it opposes motion and grows with speed "
            "(-0.5 ± 0.02 N m per rad/s; 42 % of it, p = 0.03).",
        ),
        (
            joint(pattern(features.LOADED, 0.25), pattern(features.CONSTANT, 0.1, alternatives=("a", "b", "c", "d"))),
            "hinge: 0.12 N m unexplained (rms; noise 0.046); it goes with motion and grows with load "
            "(0.25 ± 0.02; 42 % of it, p = 0.03); besides, it is constant (0.1 ± 0.02 N m; 42 % of it, p = 0.03), "
            "which these data cannot distinguish from a or b or c.",
        ),
        (
            joint(pattern(features.ACCELERATION, -0.5, p=0.001, smallest_p=0.001), unit="N"),
            "hinge: 0.12 N unexplained (rms; noise 0.046); it opposes acceleration, as missing inertia does "
            "(-0.5 ± 0.02 N per m/s²; 42 % of it, p <= 0.001).",
        ),
        (
            joint(pattern(features.POSITION, 0.5), unit="N"),
            "hinge: 0.12 N unexplained (rms; noise 0.046); it pushes away from a position "
            "(0.5 ± 0.02 N per m; 42 % of it, p = 0.03).",
        ),
        (
            joint(),
            "hinge: 0.12 N m unexplained (rms; noise 0.046); it follows none of the features, and is largest at 0.25 s "
            "of d1.",
        ),
        (
            joint(pattern(features.SPEED, -0.5), significant=False),
            "hinge: 0.12 N m unexplained (rms; noise 0.046), no more than noise; smallest detectable steady force: "
            "0.079 N m.",
        ),
    ],
)  # fmt: skip
def test_sentences_about_joints(found, sentence):
    assert joint_sentence(found) == sentence


def test_slopes_have_the_unit_of_their_feature():
    for feature, size in (
        ("angular velocity", "N m per rad/s"), (features.DRAG, "N m per (m/s)²"), (features.COMMAND_RATE, "N m s"),
        (features.DRIVE, ""), (features.GRAVITY, ""), (features.LIMIT, ""), ("world x", "N m"),
    ):  # fmt: skip
        found = pattern_sentence("torque", Dependences((), (pattern(feature, 2.0),)), "N m")
        text = f"(2 ± 0.02 {size}".rstrip()
        assert f"{text}; 42 % of it" in found
    words = pattern_sentence("block, force", Dependences((), (pattern("block y", -2.0),)), "N")
    assert words == "block, force: is along -block y (-2 ± 0.02 N; 42 % of it, p = 0.03)."
    speed = pattern_sentence("force", Dependences((), (pattern(features.SPEED, 0.0),)), "N")
    assert speed == "force: goes with motion and grows with speed (0 ± 0.02 N per m/s; 42 % of it, p = 0.03)."


PLACE = ForcePlace(
    np.array([0.01, -0.02, 0.03]),
    np.array([0.001, 0.002, 0.003]),
    np.array([1.0, 0, 0]),
    "+x face",
    (),
    0.0,
    None,
    False,
)


def phase(**changes: Any) -> PhaseForce:
    """Return the force on a body in a phase."""
    base = PhaseForce(
        "slide", (("d0", 0.1, 0.25), ("d1", 0.3, 0.5)), "world", np.array([3.0, 0, -4.0]), np.array([0.1, 0.2, 0.3]),
        0.7, np.array([0.3, 0.4, 0]), np.zeros(3), 0.02, 0.0, "sign flips", True, None, np.array([0, 1.0, 0]),
    )  # fmt: skip
    return replace(base, **changes)


HEAD = "block, slide (d0 0.10-0.25 s, d1 0.30-0.50 s): 5 ± 0.5 N unexplained along -z +x"


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({}, f"{HEAD}; p = 0.02."),
        ({"p": 0.01, "smallest_p": 0.01}, f"{HEAD}; p <= 0.01."),
        ({"place": PLACE}, f"{HEAD}, at (10, -20, 30) mm: +x face, ± 5.9 mm; p = 0.02."),
        (
            {"place": replace(PLACE, hidden=("x", "z"))},
            f"{HEAD}, at (?, -20, ?) mm: +x face, ± 3.9 mm (its contacts hide the place along x and z); p = 0.02.",
        ),
        (
            {"place": replace(PLACE, hidden=("x", "y", "z"))},
            f"{HEAD}, at (?, ?, ?) mm: +x face (its contacts hide the place along x and y and z); p = 0.02.",
        ),
        (
            {"place": replace(PLACE, against="world")},
            f"{HEAD}, at its contact with world (+x face); p = 0.02.",
        ),
        (
            {"place": replace(PLACE, through_center=True)},
            f"{HEAD}; its line passes through the centre of mass, as that of weight, wind or inertia does; p = 0.02.",
        ),
        ({"place": replace(PLACE, off=0.0123)}, f"{HEAD}, on a line that misses it by 12 mm; p = 0.02."),
        (
            {"spans": (("d0", 0.1, 0.25), ("d1", 0.3, 0.5), ("d2", 0, 1), ("d3", 0, 1))},
            f"{HEAD.replace('0.50 s)', '0.50 s and 2 more)')}; p = 0.02.",
        ),
    ],
)
def test_sentences_about_bodies(changes, sentence):
    assert body_sentence("block", phase(**changes)) == sentence


def test_impacts_have_an_impulse():
    text = body_sentence("block", phase(phase="impact", frame="sliding", vector=np.array([0.0, 0, 0])))
    assert text.startswith("block, impact (")
    assert text.endswith("0 ± 0 N unexplained with its sliding; 0.5 N s a time; p = 0.02.")


def test_directions_have_the_axes_that_count():
    assert _direction_words(np.array([0.26, 0, 1.0]), "world") == "along +z +x"
    assert _direction_words(np.array([0.25, 0, 1.0]), "world") == "along +z"
    assert _direction_words(np.array([-1.0, 0.9, -1.1]), "block") == "along -z -x +y of block"
    assert _direction_words(np.zeros(3), "sliding") == "with its sliding"


def test_the_size_of_a_force_has_the_error_along_it():
    assert phase().size == 5.0
    assert phase().size_std == pytest.approx(np.hypot(0.6 * 0.1, 0.8 * 0.3))
    document = phase(place=PLACE).to_json()
    assert document["spans"][1] == {"demonstration": "d1", "start": 0.3, "end": 0.5}
    assert (document["size"], document["size_std"]) == (5.0, phase().size_std)
    assert document["place"]["face"] == "+x face"
    assert document["vector"] == [3.0, 0.0, -4.0]
    assert phase().to_json()["place"] is None


def body(*phases: PhaseForce, **changes: Any) -> BodyForce:
    """Return the force on a body."""
    series = (ForceSeries("d0", np.array([0.1]), np.array([[0.1, 0.2, 0.3]]), np.array([0.1])),)
    base = BodyForce("block", 0.5, 0.1, 1.2, 0.01, False, NOTHING, NOTHING, phases, series)
    return replace(base, **changes)


def test_bodies_of_which_nothing_more_is_known_have_a_sentence_too():
    assert nothing_sentence(body()) == "block: nothing beyond noise (force 0.5 N rms, noise 0.1 N)."
    assert nothing_sentence(body(significant=True)) == (
        "block: unexplained forces (force 0.5 N rms, noise 0.1 N) that are steady in no phase and follow none of the "
        "features."
    )


def test_all_forces_are_listed_with_sentences_and_arrows():
    placed = phase(place=PLACE, vector=np.array([0.0, 1.2345, 0.0]))
    seen = body(placed, phase(phase="free", significant=False), significant=True)
    some = Dependences((), (pattern("world x", 1.0),))
    both = replace(seen, torque=some, force=some)
    found = UnexplainedForces(0.1, (joint(),), (both, body()), 0.05)
    sentences = found.sentences()
    assert [s.split(":")[0] for s in sentences] == [
        "hinge", "block, slide (d0 0.10-0.25 s, d1 0.30-0.50 s)", "block, force", "block, torque", "block",
    ]  # fmt: skip
    assert "N m; 42 %" in sentences[3]
    quiet = UnexplainedForces(0.1, (), (replace(both, significant=False),), 0.05)
    assert len(quiet.sentences()) == 1
    assert found.arrows() == [
        {
            "body": "block", "phase": "slide", "point": [0.01, -0.02, 0.03], "vector": [0.0, 1.0, 0.0],
            "std": [0.001, 0.002, 0.003], "label": "1.23 N, slide",
        }
    ]  # fmt: skip
    document = found.to_json()
    assert (document["window"], document["level"], document["sentences"]) == (0.1, 0.05, sentences)
    assert document["joints"][0]["series"][0]["force"] == [0.2, None]
    assert document["joints"][0]["detectable"] == 0.0789
    assert document["bodies"][0]["force"]["patterns"][0]["alternatives"] == []
    assert document["bodies"][0]["phases"][0]["phase"] == "slide"
    assert document["bodies"][1]["series"][0]["force"] == [[0.1, 0.2, 0.3]]


def test_phases_are_significant_at_their_share_of_the_level_and_keep_their_place_then():
    least = min_share(CFG.dependence, True)
    phases = (
        phase(p=0.0125, share=least, place=PLACE, significant=False),
        phase(p=0.0126, share=0.9, place=PLACE, significant=False),
        phase(p=0.01, share=least - 1e-9, place=PLACE, significant=False),
        phase(phase="free", p=0.01, share=min_share(CFG.dependence, False), place=PLACE, significant=False),
    )
    found = with_significance(body(*phases), True, CFG)
    assert [p.significant for p in found.phases] == [True, False, False, True]
    assert [p.place is not None for p in found.phases] == [True, False, False, True]
    assert found.significant
    none = with_significance(body(*phases), False, CFG)
    assert not any(p.significant for p in none.phases)
    assert not none.significant
    assert with_significance(body(ratio=1.71), False, CFG).significant
    assert not with_significance(body(ratio=1.7), False, CFG).significant
    assert not with_significance(body(), True, CFG).significant
    some = Dependences((), (pattern("world x", 1.0),))
    for torque, force in ((some, NOTHING), (NOTHING, some)):
        assert with_significance(body(force=force, torque=torque), True, CFG).significant
        assert not with_significance(body(force=force, torque=torque), False, CFG).significant
