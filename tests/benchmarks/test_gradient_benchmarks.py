import pytest

from concent_warp.fit.evolution import EvolutionCfg
from concent_warp.fit.geometry import FitCfg
from concent_warp.fit.gradient import GradientCfg


def test_slopes_of_settling_are_those_of_central_differences(script):
    benchmark = script("gradient_check")
    row = benchmark.check("settle", 1, 0.1, "cpu")
    assert benchmark.relative([row])[0] < 0.1
    for name in benchmark.FACTORS:
        exact, difference = row[name]
        assert exact == pytest.approx(difference, rel=0.25)
    assert benchmark.check("settle", 0, 5.0, "cpu") is None


def test_curves_begin_with_the_gradients_and_cost_what_they_cost(script):
    benchmark = script("es_vs_gradient")
    fit = FitCfg(EvolutionCfg(population=4), generations=2, gradient=GradientCfg(starts=2, iterations=3))
    row = benchmark.run(benchmark.Args(fit=fit), "settle", 0, "gradient+es")
    first, *rest = row["curve"]
    assert first["simulations"] >= 2 * 2 * 3
    assert len(rest) == 2
    assert rest[0]["simulations"] > first["simulations"]
    assert benchmark.at_budget(row["curve"], rest[0]["simulations"], "fitted") == rest[0]["fitted"]
    assert benchmark.reached(row["curve"], first["fitted"], "fitted") == first["simulations"]


def test_a_world_takes_the_same_memory_whatever_their_number(script):
    benchmark = script("gradient_throughput")
    one, four = benchmark.measure(1, "cpu", 1), benchmark.measure(4, "cpu", 1)
    assert one["bytes"] == four["bytes"] > 0
    assert four["seconds"] > 0
