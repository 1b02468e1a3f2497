"""Every broken input of the benchmark, given to the readers of the library."""

from benchmarks.recording import bad_input as benchmark
from benchmarks.recording.bad_input_cases import write_good


def test_every_broken_input_is_refused_in_one_sentence_and_leaves_no_file():
    outcomes = [benchmark.attempt(case, command=False) for case in benchmark.cases()]
    faults = {outcome.case.name: outcome.faults for outcome in outcomes if outcome.faults}
    assert not faults
    assert len(outcomes) >= 30
    assert len({(outcome.case.kind, outcome.case.name) for outcome in outcomes}) == len(outcomes)


def test_the_inputs_are_sound_but_for_what_each_case_breaks():
    case = benchmark.Case("none", "nothing", write_good)
    outcome = benchmark.attempt(case, command=False)
    assert outcome.message == ""
    assert outcome.faults == ["exit status 0", "not one sentence"]
