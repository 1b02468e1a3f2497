"""Every broken input of the benchmark, given to the readers of the library."""

import importlib
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("bad_input")


def test_every_broken_input_is_refused_in_one_sentence_and_leaves_no_file(benchmark):
    outcomes = [benchmark.attempt(case, command=False) for case in benchmark.cases()]
    faults = {outcome.case.name: outcome.faults for outcome in outcomes if outcome.faults}
    assert not faults
    assert len(outcomes) >= 30
    assert len({(outcome.case.kind, outcome.case.name) for outcome in outcomes}) == len(outcomes)


def test_the_inputs_are_sound_but_for_what_each_case_breaks(benchmark):
    case = benchmark.Case("none", "nothing", importlib.import_module("bad_input_cases").write_good)
    outcome = benchmark.attempt(case, command=False)
    assert outcome.message == ""
    assert outcome.faults == ["exit status 0", "not one sentence"]
