"""Pieces of work and the CPUs that they share."""

import os

from concent_warp.diagnosis.procedure import _run_all
from concent_warp.simulate.threads import at_most, simulations_at_a_time

CPUS = len(os.sched_getaffinity(0))


def allowed(_: int) -> int:
    return simulations_at_a_time()


def test_pieces_of_work_share_the_cpus():
    with at_most(2):
        assert list(_run_all(allowed, [(0,)], 2)) == [min(2, CPUS)]  # one piece alone may take all
        assert list(_run_all(allowed, [(0,), (1,)], 2)) == [1, 1]
        assert list(_run_all(allowed, [(0,), (1,), (2,)], 2)) == [1, 1, 1]
    assert list(_run_all(allowed, [(0,), (1,)], 4)) == [min(2, CPUS)] * 2
