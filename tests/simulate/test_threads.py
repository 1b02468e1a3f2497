"""How many simulations run at a time."""

import os

from concent_warp.simulate.parallel import limit_simulations, simulations_at_a_time

CPUS = len(os.sched_getaffinity(0))


def test_one_simulation_runs_for_each_cpu_or_fewer():
    assert simulations_at_a_time() == CPUS
    with limit_simulations(1):
        assert simulations_at_a_time() == 1
        with limit_simulations(None):
            assert simulations_at_a_time() == 1
        with limit_simulations(CPUS + 7):
            assert simulations_at_a_time() == CPUS
        assert simulations_at_a_time() == 1
    assert simulations_at_a_time() == CPUS
