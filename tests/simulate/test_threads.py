"""How many simulations run at a time."""

import os

from concent_warp.simulate.threads import at_most, simulations_at_a_time

CPUS = len(os.sched_getaffinity(0))


def test_one_simulation_runs_for_each_cpu_or_fewer():
    assert simulations_at_a_time() == CPUS
    with at_most(1):
        assert simulations_at_a_time() == 1
        with at_most(None):
            assert simulations_at_a_time() == 1
        with at_most(CPUS + 7):
            assert simulations_at_a_time() == CPUS
        assert simulations_at_a_time() == 1
    assert simulations_at_a_time() == CPUS
