"""Tasks and the CPUs that they share."""

import os

from concent_warp.diagnosis.tasks import run_tasks
from concent_warp.simulate.parallel import limit_simulations, simulations_at_a_time

CPUS = len(os.sched_getaffinity(0))


def allowed(_: int) -> int:
    return simulations_at_a_time()


def test_tasks_share_the_cpus():
    with limit_simulations(2):
        assert list(run_tasks(allowed, [(0,)], 2)) == [min(2, CPUS)]  # one task alone may take all
        assert list(run_tasks(allowed, [(0,), (1,)], 2)) == [1, 1]
        assert list(run_tasks(allowed, [(0,), (1,), (2,)], 2)) == [1, 1, 1]
    assert list(run_tasks(allowed, [(0,), (1,)], 4)) == [min(2, CPUS)] * 2
