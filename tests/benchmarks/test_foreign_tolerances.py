"""What comparisons say of foreign logs, counted."""

import json

import pytest

from benchmarks.foreign import tolerances
from benchmarks.foreign.cases import all_cases


def row(name, kind="single", beyond=(), *, asked=True, locked=False, **more):
    known = {"name": name, "machine": name.split("-")[0], "kind": kind, "locked": locked, "ratio": 4.0, "seconds": 2.0}
    return known | {"asked": asked, "beyond": list(beyond)} | more


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (row("a-b", beyond=["angle"]), "more"),
        (row("a-b"), "no more"),
        (row("a-b", asked=False), "little"),
        ({"name": "a-b", "kind": "null", "locked": False, "error": "lost"}, "error"),
    ],
)
def test_an_answer_is_one_of_four(found, expected):
    assert tolerances.said(found) == expected


def test_the_page_counts_all_and_names_development_logs_that_say_otherwise():
    rows = [
        row("a-mass", beyond=["angle"]),
        row("a-damping"),
        row("b-hidden", locked=True),
        row("a-null", "null", beyond=["angle", "speed"]),
        row("b-null", "null", asked=False, locked=True),
    ]
    text = tolerances.page(rows, "Here.")
    assert "| one effect, development machines | 2 | 1 | 1 | 0 | 0 |" in text
    assert "| one effect, locked machines | 1 | 0 | 1 | 0 | 0 |" in text
    assert "| nothing hidden, development machines | 1 | 1 | 0 | 0 | 0 |" in text
    assert "| nothing hidden, locked machines | 1 | 0 | 0 | 1 | 0 |" in text
    assert "| `a-damping` | no more | 4.0 x |  |" in text
    assert "| `a-null` | more | 4.0 x | angle, speed |" in text
    assert "b-hidden" not in text


def test_a_log_is_compared_once_and_kept(tmp_path, monkeypatch, capsys):
    tolerances.main(tolerances.Args(out=tmp_path, names=("hoist-overload",)))
    (kept,) = tmp_path.iterdir()
    found = json.loads(kept.read_text())
    assert (found["name"], found["kind"], found["asked"]) == ("hoist-overload", "single", True)
    assert "height" in found["beyond"]
    assert found["ratio"] > 10
    assert "1 of 1" in capsys.readouterr().out
    monkeypatch.setattr(tolerances, "studied", lambda _: pytest.fail("it was compared again"))
    tolerances.main(tolerances.Args(out=tmp_path, names=("hoist-overload",)))


def test_a_log_that_is_not_there_is_said_before_anything_is_written(tmp_path):
    with pytest.raises(
        SystemExit, match=r"no log is called hoist-nul; python -m benchmarks\.foreign --list prints all"
    ):
        tolerances.main(tolerances.Args(out=tmp_path / "out", names=("hoist-null", "hoist-nul")))
    assert not list(tmp_path.iterdir())


def test_an_error_of_a_comparison_is_kept(monkeypatch):
    def broken(*_):
        raise RuntimeError("no such thing")

    monkeypatch.setattr(tolerances, "compare", broken)
    case = next(case for case in all_cases() if case.name == "hoist-null")
    assert "no such thing" in tolerances.studied(case)["error"]
