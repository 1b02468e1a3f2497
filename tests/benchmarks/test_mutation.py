"""The mutation tool: which places it changes, how, which tests it chooses, and what its page counts."""

from pathlib import Path

import pytest

pytest.importorskip("cosmic_ray")

CODE = '''"""Numbers 1 + 1."""
from __future__ import annotations

import warp as wp

LIMIT: int | None = 3


@wp.kernel
def add_on_device(a: wp.array(dtype=float)):
    a[0] = a[0] + 1.0


def outer(x: float | None) -> int | None:
    def inner(y):
        return y * 2

    return inner(x) < LIMIT


def run_cuda(x):
    return x + 1
'''


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    (tmp_path / "kernels").mkdir()
    (tmp_path / "kernels" / "sums.py").write_text(CODE)
    (tmp_path / "kernels" / "sums_cuda.py").write_text(CODE)
    return tmp_path


def test_only_what_python_runs_is_changed(script, tree):
    mutants = script("benchmarks.development.mutants")
    found = mutants.drawn(tree, "kernels", 100, 0)
    assert {(m.file, m.line, m.scope) for m in found} == {
        ("kernels/sums.py", 6, ""),
        ("kernels/sums.py", 16, "outer.<locals>.inner"),
        ("kernels/sums.py", 18, "outer"),
    }
    assert len(found) == 4  # the product and its number are two places of one line


def test_an_exception_that_cannot_be_replaced_is_left_out(script, tree):
    code = "import zlib\ntry:\n    x = 3\nexcept (OSError, zlib.error):\n    x = 0\n"
    (tree / "kernels" / "sums.py").write_text(code)
    mutants = script("benchmarks.development.mutants")
    found = [m for seed in range(20) for m in mutants.drawn(tree, "kernels", 10, seed)]
    assert any(m.operator == "NumberReplacer" for m in found)
    assert all(mutants.mutated(code, m) != code for m in found)


def test_each_mutant_changes_its_line_alone_and_differs_from_the_others(script, tree):
    mutants = script("benchmarks.development.mutants")
    every = [m for _, m in mutants.mutants(tree, "kernels", tree / "kernels" / "sums.py")]
    codes = [mutants.mutated(CODE, m) for m in every]
    assert len(set(codes)) == len(codes)
    for mutant, code in zip(every, codes, strict=True):
        different = [k for k, pair in enumerate(zip(CODE.splitlines(), code.splitlines(), strict=True), 1)
                     if pair[0] != pair[1]]  # fmt: skip
        assert different == [mutant.line]
    changes = {mutants.changed_lines(CODE, code) for code in codes}
    assert ("return y * 2", "return y + 2") in changes
    assert ("return inner(x) < LIMIT", "return inner(x) >= LIMIT") in changes
    assert not any("<<" in after or " is LIMIT" in after for _, after in changes)


def test_a_smaller_sample_is_the_beginning_of_a_larger_one(script, tree):
    drawn = script("benchmarks.development.mutants").drawn
    assert drawn(tree, "kernels", 2, 7) == drawn(tree, "kernels", 4, 7)[:2]
    assert len({tuple(drawn(tree, "kernels", 4, seed)) for seed in range(8)}) > 1


def test_the_tests_chosen_call_the_function_quick_ones_of_the_room_first(script):
    mutation, mutants = script("benchmarks.development.mutation"), script("benchmarks.development.mutants")
    mutant = mutants.Mutant("kernels", "kernels/sums.py", 16, "outer", "NumberReplacer", 0)
    called = "kernels/sums.py::outer"
    tests = {
        "tests/fit/test_a.py::quick": {"seconds": 1.0, "calls": [called]},
        "tests/kernels/test_b.py::slow": {"seconds": 9.0, "calls": [called]},
        "tests/kernels/test_b.py::quick": {"seconds": 2.0, "calls": [called]},
        "tests/kernels/test_b.py::other": {"seconds": 0.1, "calls": ["kernels/sums.py::run_cuda"]},
        "tests/kernels/test_b.py::broken": {"seconds": 0.1, "calls": [called], "outcome": "failed"},
    }
    selection = mutation.Selection.of({"file": {"tests": tests, "imported": []}})
    assert selection.chosen(mutant, 20.0) == (
        ["tests/kernels/test_b.py::quick", "tests/kernels/test_b.py::slow", "tests/fit/test_a.py::quick"], 12.0,
    )  # fmt: skip
    assert selection.chosen(mutant, 4.0)[0] == ["tests/kernels/test_b.py::quick", "tests/fit/test_a.py::quick"]


def test_the_page_counts_what_is_noticed_and_names_what_is_not(script):
    page = script("benchmarks.development.mutation_page")

    def row(outcome, after):
        place = {"room": "fit", "file": "concent_warp/fit/a.py", "line": 1, "scope": "f", "operator": "AddNot"}
        return {**place, "key": after, "before": "if x:", "after": after, "outcome": outcome}

    rows = [row("killed", "a"), row("killed", "b"), row("timed out", "c"), row("survived", "d"), row("survived", "e")]
    line = page.room_line("fit", rows, {("concent_warp/fit/a.py", "if x:", "e"): "never read"})
    assert line == ["fit", "5", "2", "1", "2", "60.0%", "23.1% to 88.2%", "1", "75.0%"]
