"""Shares that round to nothing are said to be small, not zero."""

from dataclasses import replace

from concent_warp.diagnosis.result import UnknownForceFound


def test_a_force_that_explains_next_to_nothing_is_not_said_to_explain_zero():
    found = UnknownForceFound("a force", gain=0.1, p=0.01, share=2e-5, form_error=True)
    assert found.sentence.startswith("A force explains less than 0.1 % of the discrepancy besides")
    assert replace(found, share=0.0123).sentence.startswith("A force explains 1.2 % of the discrepancy besides")
