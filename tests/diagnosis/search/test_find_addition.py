"""One addition of a search, with candidates that are made up."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.search import find_addition
from concent_warp.effects.library.drives import ActuatorGain
from concent_warp.simulate.time_limit import TimeUpError
from tests.diagnosis.made_up import CLEAR, OPEN, Comparison, finding, node, procedure


class MadeUp(SimpleNamespace):
    """A fitted candidate."""

    fit, std = "its fit", None

    def share(self, base: Any) -> float:
        """Return its gain over a baseline."""
        return self.gain - getattr(base, "less", 0.0)

    def removed(self, base: Any) -> np.ndarray:
        """Return what it takes from the residuals of a baseline."""
        return np.array([self.share(base)])


def candidate(name: str, *, is_part: bool = False) -> Any:
    """Return a candidate, or a part of an element."""
    return SimpleNamespace(name=name, is_part=is_part, singles_last=False, target=(), elements=())


def searched(
    monkeypatch, made, gains: dict[str, tuple[float, bool]], null: np.ndarray, ratio: float = 2.0, step=1, base=None,
    refitted=0.05, implausible=(), **given
):  # fmt: skip
    """Return what a search adds whose candidates have these gains, and notes of what is asked for."""
    notes: dict[str, Any] = {"bases": []}
    fitted = [
        MadeUp(name=n, gain=g, model=SimpleNamespace(name=f"model {n}", effects=["own", f"added {n}"]))
        for n, (g, _) in gains.items()
    ]
    monkeypatch.setattr(find_addition, "candidates", lambda *_: [candidate("effect")])
    monkeypatch.setattr(made.additions.finder, "_screened", lambda *_: ["s1", "s2", "s3"])
    monkeypatch.setattr(find_addition, "max_gain_under_null", lambda *args: notes.setdefault("null", args[2:]) and null)
    monkeypatch.setattr(
        find_addition,
        "detectable_size",
        lambda _b, s, needed: notes.update(needed=needed) or (s if s != "s2" else None),
    )

    def assess(base, c, _null, step, _effects, cfg):
        notes["bases"].append(base)
        notes["level"], notes["min_gain"] = cfg.significance_level, cfg.min_gain
        enough = c.share(base) >= cfg.min_gain if "explained" in given else True
        return finding(c.name, c.share(base), accepted=gains[c.name][1] and enough, step=step)

    class Fits:
        left = ()

        def __init__(self, *_):
            pass

        def unsettled(self, _name):
            return []

        def fit(self, _screened, needed, _windows, _promise):
            notes["asked"] = needed
            return fitted

    def plausible(_base, _fitted, findings, _cfg):
        return [replace(f, accepted=f.accepted and f.name not in implausible) for f in findings]

    def refit(base, rivals):
        notes["rivals"] = [c.name for c in rivals]
        return SimpleNamespace(**{**vars(base), "less": refitted})

    monkeypatch.setattr(find_addition, "assess", assess)
    monkeypatch.setattr(find_addition, "CandidateFits", Fits)
    monkeypatch.setattr(find_addition, "without_implausible", plausible)
    monkeypatch.setattr(find_addition, "refit_from_rivals", refit)
    monkeypatch.setattr(find_addition, "profile_widening", lambda _base, c: f"width of {c.name}")
    monkeypatch.setattr(find_addition, "group_indistinguishable", lambda _base, accepted, *_: accepted[:2])
    return made.additions.finder.find(base or node(ratio), step, **given), notes


def test_an_effect_of_an_implausible_size_is_not_added(monkeypatch):
    gains = {"a": (0.7, True), "b": (0.6, True)}
    (best, _), _ = searched(monkeypatch, procedure(), gains, np.zeros(1), implausible=("a",))
    assert best.name == "b"


def test_the_first_of_the_group_is_added_and_all_findings_are_kept(monkeypatch):
    made = procedure()
    gains = {"a": (0.5, True), "b": (0.7, True), "c": (0.6, False), "d": (0.65, True)}
    (best, sizes), notes = searched(monkeypatch, made, gains, np.arange(101) / 1000)
    assert best.name == "a"
    assert sizes == ("s1", "s3")
    assert notes["asked"] == pytest.approx(0.095)
    assert notes["needed"] == pytest.approx(0.095)
    assert notes["null"] == (400, 0)
    assert "rivals" not in notes
    assert made.record.groups == [("a", "b")]
    assert made.record.widening == {1: "width of a"}
    assert [(base.ratio, c.name) for base, c in made.record.unprofiled.values()] == [(2.0, "a")]
    assert [{n: m.name for n, m in models.items()} for models in made.record.hypotheses] == [
        {"a": "model a", "b": "model b"}
    ]
    assert list(made.record.rivals) == [1]
    assert [(r.finding.name, r.added, r.fit) for r in made.record.rivals[1]] == [
        (n, f"added {n}", "its fit") for n in "bdca"
    ]
    assert [(f.name, f.accepted, f.reason, f.step) for f in made.record.findings] == [
        ("a", True, "", 1),
        ("b", False, "the data cannot distinguish it from the accepted one", 1),
        ("d", False, "another one explains more", 1),
        ("c", False, "another one explains more", 1),
    ]


def test_a_doubtful_gain_is_judged_against_a_baseline_that_is_refitted_from_its_rivals(monkeypatch):
    made = procedure()
    gains = {"a": (0.3, True), "b": (0.39, True), "c": (0.9, False), "d": (0.35, True), "e": (0.2, True)}
    _, notes = searched(monkeypatch, made, gains, np.zeros(10))
    assert notes["needed"] == 0.05
    assert notes["rivals"] == ["b", "d", "a"]
    assert [getattr(b, "less", 0.0) for b in notes["bases"]] == [0.0] * 5 + [0.05] * 5
    clear = procedure()
    _, notes = searched(monkeypatch, clear, {"a": (0.4, True)}, np.zeros(10))
    assert "rivals" not in notes


def test_where_nothing_is_accepted_findings_are_kept_by_gain(monkeypatch):
    made = procedure()
    (best, _), _ = searched(monkeypatch, made, {"a": (0.1, False), "b": (0.2, False)}, np.zeros(10))
    assert best is None
    assert [f.name for f in made.record.findings] == ["b", "a"]
    assert (made.record.groups, made.record.rivals) == ([], {})


def test_a_residual_that_is_little_more_than_noise_is_searched_at_a_stricter_level(monkeypatch):
    for ratio, factor, level, gain in (
        (1.0, 1.0, 0.005, 0.125),
        (1.09, 1.0, 0.005, 0.125),
        (1.11, 1.0, 0.05, 0.05),
        (1.3, 1.2, 0.005, 0.125),  # 1.08 x the largest noise
        (1.33, 1.2, 0.05, 0.05),
    ):
        made, null = procedure(), np.arange(1001) / 1000
        made.context.noise_factors = {"angle": factor}
        (best, sizes), notes = searched(monkeypatch, made, {"a": (0.9, True)}, null, ratio)
        assert best.name == "a"
        assert sizes == ("s1", "s3")
        assert notes["asked"] == notes["needed"] == pytest.approx(1 - level)
        assert notes["level"] == level
        assert len(made.record.findings) == len(made.record.groups) == 1
        # Where chance is less than that, an effect must still remove a share of the error.
        other = procedure()
        other.context.noise_factors = made.context.noise_factors
        _, notes = searched(monkeypatch, other, {"a": (0.9, True)}, np.zeros(10), ratio)
        assert (notes["needed"], notes["min_gain"]) == (gain, gain)
    stricter = procedure(quiet_significance_level=0.001)
    _, notes = searched(monkeypatch, stricter, {"a": (0.9, True)}, np.arange(1001) / 1000, 1.0)
    assert notes["asked"] == pytest.approx(0.999)


@pytest.mark.parametrize(
    ("ratio", "factor", "gains", "added"),
    [
        # 0.05 less over the model as refitted from its rivals
        (1.2, 1.0, (0.20, 0.15), None),  # 0.306 is beyond the noise
        (1.2, 1.0, (0.21, 0.15), "a"),
        (1.24, 1.0, (0.22, 0.15), None),
        (1.26, 1.0, (0.12, 0.1), "a"),  # more than a little
        (1.44, 1.2, (0.20, 0.15), None),  # 1.2 x the largest noise
        (1.0, 1.0, (0.18, 0.0), "a"),
    ],
)
def test_an_effect_that_removes_a_smaller_part_of_little_beyond_the_noise_is_refused(
    monkeypatch, ratio, factor, gains, added
):
    made = procedure()
    made.context.noise_factors = {"angle": factor}
    given = {"a": (gains[0], True), "b": (gains[1], True), "c": (gains[1], False)}
    (best, sizes), _ = searched(monkeypatch, made, given, np.zeros(10), ratio)
    assert (None if best is None else best.name) == added
    assert made.record.part_refused is (added is None)
    assert [f.accepted for f in made.record.findings] == [added is not None, False, False]
    assert made.record.groups == ([] if added is None else [("a", "b")])
    assert sizes == ("s1", "s3")
    if added is None:
        assert made.record.findings[0].reason == "removes a part of what may be errors in formulas"


def test_candidates_are_screened_and_started_by_gradients_where_asked_for(monkeypatch):
    made = procedure()
    monkeypatch.setattr(find_addition, "linear_at_measured_states", lambda _base, _cfg: "shared")
    monkeypatch.setattr(find_addition, "ranking", lambda _base, _screened, names, _seed: f"ranked {names}")
    monkeypatch.setattr(find_addition, "label", lambda effect, _among: effect)
    monkeypatch.setattr(
        find_addition, "screen", lambda _base, effect, _cfg, at: effect.upper() if at == "shared" else ""
    )
    made.context.enter_addition(0, 0.0, 0.25)
    assert made.additions.finder._screened(node(2.0), ["a", "b"], 0) == ["A", "B"]
    assert made.context.runner.share == pytest.approx(0.1 + 0.25 * 0.75 * 0.9)
    assert made.seen[-1][1] == "ranked ['a', 'b']"
    made.additions.finder.gradient = SimpleNamespace(apply=lambda _base, screened, _runner: screened[::-1])
    assert made.additions.finder._screened(node(2.0), ["a", "b"], 0) == ["B", "A"]


def test_where_the_data_are_explained_the_intervals_of_the_answer_decide_on_a_candidate(monkeypatch):
    ends = {"a": [OPEN], "b": [OPEN, CLEAR], "c": [CLEAR]}
    monkeypatch.setattr(find_addition, "add_candidate", lambda _base, c: c)
    monkeypatch.setattr(find_addition, "nominal_errors", lambda c, _cfg, shared: f"nominal {c.name} {shared}")
    compared = []

    def comparison(base, _doubted=None):
        compared.append(base)
        return Comparison(base)

    def answer(c, widening, nominal):
        assert (widening, nominal) == ({1: f"width of {c.name}"}, f"nominal {c.name} shared")
        return [(CLEAR,), tuple(ends[c.name])]

    def established(_c, parameters, share, *rest):
        assert (share, len(rest)) == (DiagnoseCfg().search.dependent_share, 2)
        return [any(p.excludes_null for p in group) for group in parameters]

    monkeypatch.setattr(find_addition, "joint_parameters", answer)
    monkeypatch.setattr(find_addition, "established_effects", established)
    gains = {"a": (0.9, True), "b": (0.7, True), "c": (0.6, False)}
    for explained, added, seen in ((False, "a", ["a", "b"]), (True, "b", ["b"])):
        made = procedure()
        made.context.beside_nominal = comparison
        (best, _), _ = searched(monkeypatch, made, gains, np.zeros(10), explained=explained)
        assert best.name == added
        assert made.record.groups == [tuple(seen)]
        first = next(f for f in made.record.findings if f.name == "a")
        assert first.accepted is not explained
        assert (first.reason == "its parameters may be at their null values") is explained
        assert len(compared) == explained


def leaving(before: float, after: float) -> Any:
    """Return what finds that so much is left beside nominal values of the model, and of the candidate "a"."""
    left = {"": np.full(4, before / 4), "a": np.full(4, after / 4)}
    return lambda base, _doubted=None: Comparison(base, left)


@pytest.mark.parametrize(
    ("step", "gain", "beside", "nominal", "added"),
    [
        (0, 0.07, (100.0, 94.0), 0, "a"),
        (-1, 0.06, (100.0, 94.0), 0, "a"),  # as the first, where errors of impacts count as noise
        (0, 0.07, (100.0, 96.0), 0, None),  # nominal values take up most of it
        (0, 0.06, (100.0, 90.0), 0, None),
        (0, 0.13, (100.0, 99.0), 0, "a"),  # clear by itself
        (1, 0.07, (100.0, 94.0), 0, None),  # beside another effect
        (0, 0.07, (100.0, 94.0), 1, None),  # beside what nominal values leave
    ],
)
def test_a_small_effect_on_the_model_as_given_counts_where_nominal_values_do_not_take_it_up(
    monkeypatch, step, gain, beside, nominal, added
):
    monkeypatch.setattr(find_addition, "add_candidate", lambda _base, c: c)
    monkeypatch.setattr(find_addition, "nominal_errors", lambda *_: None)
    monkeypatch.setattr(find_addition, "joint_parameters", lambda *_: [(CLEAR,)])
    monkeypatch.setattr(find_addition, "established_effects", lambda *_: [True])
    made = procedure()
    made.context.beside_nominal = leaving(*beside)
    made.record.beside_impacts, step = step < 0, max(step, 0)
    (best, _), asked = searched(
        monkeypatch, made, {"a": (gain, True)}, np.zeros(10), 1.0, step=step, base=node(1.0, nominal=nominal),
        refitted=0.0, explained=True,
    )  # fmt: skip
    assert (None if best is None else best.name) == added
    small = step == 0 and not nominal
    least = 0.05 if made.record.beside_impacts else 0.0625
    assert asked["min_gain"] == (least if small else 0.125)


@pytest.mark.parametrize(
    ("gain", "beside_impacts", "added"), [(0.07, False, None), (0.07, True, "a"), (0.13, False, "a")]
)
def test_a_small_effect_of_a_sensor_counts_only_beside_errors_of_impacts(monkeypatch, gain, beside_impacts, added):
    monkeypatch.setattr(find_addition, "add_candidate", lambda _base, c: c)
    monkeypatch.setattr(find_addition, "nominal_errors", lambda *_: None)
    monkeypatch.setattr(find_addition, "joint_parameters", lambda *_: [(CLEAR,)])
    monkeypatch.setattr(find_addition, "established_effects", lambda *_: [True])
    plain = finding
    monkeypatch.setitem(globals(), "finding", lambda *a, **k: replace(plain(*a, **k), family="measurement"))
    made = procedure()
    made.context.beside_nominal = leaving(100.0, 92.0)
    made.record.beside_impacts = beside_impacts
    (best, _), _ = searched(
        monkeypatch, made, {"a": (gain, True)}, np.zeros(10), 1.0, step=0, base=node(1.0), refitted=0.0, explained=True
    )
    assert (None if best is None else best.name) == added


@pytest.mark.parametrize(
    ("ratio", "step", "before", "after", "added"),
    [
        (1.9, 0, 1.8, 1.79, False),  # nominal values explain as much
        (1.9, 0, 1.8, 1.7, True),  # 11 % beyond them
        (1.9, 0, 1.05, 1.0, False),  # 9 %: so near to noise an effect must remove 12.5 %
        (1.9, 0, 1.05, 0.97, True),
        (2.1, 0, 1.05, 1.05, True),  # far off: many nominal values near their bounds at once are less plausible
        (2.1, 1, 1.05, 1.0, False),  # what an effect left
        (2.1, 1, 1.2, 1.2, True),  # nominal values leave more than noise of it
    ],
)
def test_an_effect_on_a_small_remainder_must_explain_more_than_nominal_values(
    monkeypatch, ratio, step, before, after, added
):
    made = procedure()
    made.context.beside_nominal = leaving(before**2, after**2)
    best, _ = searched(
        monkeypatch, made, {"a": (0.5, True)}, np.zeros(10), ratio, step, refitted=0.0, beside_nominal=True
    )[0]
    assert (best is not None) is added
    (found,) = made.record.findings
    assert found.accepted is added
    assert found.reason == ("" if added else "explains little beyond nominal values within their tolerance")


@pytest.mark.parametrize("decides", [True, False])
def test_candidates_are_promoted_and_compared_beside_nominal_values_where_that_is_asked_for(monkeypatch, decides):
    made, promoted, compared = procedure(), [], []

    class Asked(Comparison):
        def promoted(self, screened, cfg):
            promoted.append((screened, cfg.min_gain))
            return screened

    made.context.beside_nominal = lambda base, _doubted=None: Asked(base, decides=decides)
    searched(
        monkeypatch,
        made,
        {"a": (0.5, True), "b": (0.6, True), "c": (0.4, True)},
        np.zeros(10),
        3.0,
        beside_nominal=True,
    )
    made.record.forget(0, 0)
    assert promoted == [(["s1", "s2", "s3"], made.context.cfg.min_gain)]

    def group(_base, accepted, *rest):
        compared.append(rest[-1])
        return accepted[:1]

    monkeypatch.setattr(find_addition, "group_indistinguishable", group)
    made.additions.finder.find(node(3.0), 0, beside_nominal=True)
    assert (compared[0] is not None) is decides
    found = {f.name: (f.accepted, f.reason) for f in made.record.findings}
    more = "another one explains more"
    assert found == {"a": (True, ""), "b": (False, more + " beside nominal values" * decides), "c": (False, more)}
    made.additions.finder.find(node(3.0), 0)
    assert compared[1] is None
    assert len(promoted) == 2


class Parts:
    """A search in which one candidate is a part, and notes of what it asks for."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, fits: dict[str, tuple[float, float]]) -> None:
        """Prepare a search whose candidates have a gain and a noise ratio."""
        self.screened: list[list[str]] = []
        self.fitted: list[tuple[list[str], float]] = []
        self.null: list[list[str]] = []
        self.among: list[list[str]] = []
        self.time = True
        notes, found = self, {}
        for name, (gain, ratio) in fits.items():
            effect = SimpleNamespace(name=name, is_alone=False)
            found[name] = MadeUp(
                name=name, gain=gain, ratio=ratio, effect=effect, model=SimpleNamespace(effects=[name])
            )
        effects = [candidate("whole"), candidate("part", is_part=True), candidate("other")]

        class Fits:
            left = ()

            def __init__(self, *_):
                self.fits = []

            def unsettled(self, _name):
                return []

            def fit(self, screened, needed, _windows, _promise):
                notes.fitted.append((screened, needed))
                self.fits += [found[s] for s in screened if s in found]
                return self.fits

        def chance(_base, screened, *_):
            self.null.append(screened)
            return np.full(10, 0.01 * len(screened))

        def assess(_base, c, null, step, among, _cfg):
            self.among.append([e.name for e in among])
            return replace(finding(c.name, c.gain, step=step), p=float(null[0]))

        monkeypatch.setattr(find_addition, "candidates", lambda *_: effects)
        monkeypatch.setattr(find_addition, "max_gain_under_null", chance)
        monkeypatch.setattr(find_addition, "detectable_size", lambda _b, s, needed: f"{s} {needed}")
        monkeypatch.setattr(find_addition, "CandidateFits", Fits)
        monkeypatch.setattr(find_addition, "assess", assess)
        monkeypatch.setattr(find_addition, "without_implausible", lambda _b, _c, findings, _cfg: findings)
        monkeypatch.setattr(find_addition, "profile_widening", lambda _base, c: f"width of {c.name}")
        monkeypatch.setattr(
            find_addition,
            "group_indistinguishable",
            lambda _b, accepted, *_: [max(accepted, key=lambda pair: pair[1].gain)],
        )

    def find(self, made: Any, ratio: float = 2.0) -> tuple[str | None, tuple[str, ...]]:
        """Return the name of what is added to a model of a noise ratio, and the detectable sizes."""

        def screen(_base, effects, _step, **_):
            if not self.time and effects[0].is_part:
                raise TimeUpError
            self.screened.append([e.name for e in effects])
            return self.screened[-1]

        made.additions.finder._screened = screen
        best, sizes = made.additions.finder.find(node(ratio), 0)
        return None if best is None else best.name, sizes


@pytest.mark.parametrize(
    ("whole", "other", "ratio", "needed"),
    [
        ((0.7, 1.1), (0.6, 1.5), 2.0, False),
        ((0.7, 1.11), (0.6, 1.0), 2.0, True),  # the one that gains most counts
        (None, None, 1.1, False),
        (None, None, 1.11, True),
    ],
)
def test_parts_are_candidates_where_no_other_one_explains_the_data(monkeypatch, whole, other, ratio, needed):
    fits = {n: v for n, v in (("whole", whole), ("other", other), ("part", (0.9, 1.0))) if v is not None}
    made, parts = procedure(), Parts(monkeypatch, fits)
    added, sizes = parts.find(made, ratio)
    assert added == ("part" if needed else "whole" if whole else None)
    least = 0.125 if ratio <= 1.1 else 0.05
    assert sizes == (f"whole {least}", f"other {least}")
    first, rest = ["whole", "other"], [["part"]] if needed else []
    assert parts.screened == [first, *rest]
    # Chance has the best of all of them, for those that were fitted before as well.
    assert parts.null == [first, *([[*first, "part"]] if needed else [])]
    assert parts.fitted == [(screened, least) for screened in (first, *rest)]  # more than chance reaches
    assert all(among == (["whole", "other", "part"] if needed else first) for among in parts.among)
    assert {f.p for f in made.record.findings} == ({0.03} if needed else {0.02} if whole else set())
    assert len(made.record.findings) == len(fits) - (not needed)


def test_beside_a_provisional_addition_candidates_must_promise_what_it_left():
    made = procedure()
    assert (made.context.cfg.max_remainder, made.context.cfg.search.remainder_promise) == (0.15, 0.75)
    assert made.additions.finder._least_promise(node(2.0)) == 0
    made.record.provisional = 1
    # 1 - 1 / 2^2 of the squared residual is more than noise.
    assert made.additions.finder._least_promise(node(2.0)) == pytest.approx(0.75 * 0.85 * 0.75)
    assert made.additions.finder._least_promise(node(0.9)) == 0


def test_parts_are_no_candidates_beside_what_may_be_errors_in_formulas(monkeypatch):
    made, parts = procedure(), Parts(monkeypatch, {"whole": (0.7, 1.5), "part": (0.9, 1.0)})
    made.record.provisional = 0
    assert parts.find(made)[0] == "whole"
    assert parts.screened == [["whole", "other"]]


def test_parts_of_an_effect_that_was_asked_for_are_candidates_from_the_start(monkeypatch):
    for asked, first in ((("part",), ["whole", "part", "other"]), (("whole",), ["whole", "other"])):
        made, parts = procedure(effects=asked), Parts(monkeypatch, {"whole": (0.7, 1.0)})
        assert parts.find(made)[0] == "whole"
        assert parts.screened == [first]


def test_without_time_for_parts_the_other_candidates_stay(monkeypatch):
    made, parts = procedure(), Parts(monkeypatch, {"whole": (0.7, 1.5)})
    parts.time = False
    assert parts.find(made)[0] == "whole"
    assert made.context.budget.unsettled == ["Not screened: part."]
    assert made.context.budget.cut == {0}


@pytest.mark.parametrize(
    ("ratio", "other", "kept"), [(1.9, 1.9, True), (2.1, 2.1, False), (5.0, 8.0, False), (5.0, 10.0, True)]
)
def test_a_single_gain_that_leaves_much_is_no_candidate_unless_all_others_leave_far_more(ratio, other, kept):
    part, whole = ActuatorGain("servo", "kp"), ActuatorGain("servo")
    fitted: list[Any] = [SimpleNamespace(effect=e, ratio=r) for e, r in ((part, ratio), (whole, other))]
    assert find_addition.without_imitations(node(50.0), fitted, DiagnoseCfg()) == fitted[0 if kept else 1 :]
    # Where it is the only candidate, the model itself is what leaves more.
    assert find_addition.without_imitations(node(other), fitted[:1], DiagnoseCfg()) == fitted[: int(kept)]
