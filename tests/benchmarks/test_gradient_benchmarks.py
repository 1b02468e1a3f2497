import pytest

from concent_warp.fit.fit_geometry import FitCfg
from concent_warp.fit.geometry.evolution import EvolutionCfg
from concent_warp.fit.newton.descent import GradientCfg


def test_slopes_of_settling_are_those_of_central_differences(script):
    benchmark = script("benchmarks.fit.gradient_check")
    row = benchmark.check("settle", 1, 0.1, "cpu")
    assert benchmark.relative([row])[0] < 0.1
    for name in benchmark.FACTORS:
        exact, difference = row[name]
        assert exact == pytest.approx(difference, rel=0.25)
    assert benchmark.check("settle", 0, 5.0, "cpu") is None


def test_curves_begin_with_the_simulations_of_the_gradients(script):
    benchmark = script("benchmarks.fit.es_vs_gradient")
    fit = FitCfg(EvolutionCfg(population=4), generations=2, gradient=GradientCfg(starts=2, iterations=3))
    row = benchmark.run(benchmark.Args(fit=fit), "settle", 0, "gradient+es")
    first, *rest = row["curve"]
    assert first["simulations"] >= 2 * 2 * 3
    assert len(rest) == 2
    assert rest[0]["simulations"] > first["simulations"]
    assert benchmark.at_budget(row["curve"], rest[0]["simulations"], "fitted") == rest[0]["fitted"]
    assert benchmark.reached(row["curve"], first["fitted"], "fitted") == first["simulations"]


def test_a_world_takes_the_same_memory_whatever_their_number(script):
    benchmark = script("benchmarks.fit.gradient_throughput")
    one, four = benchmark.measure(1, "cpu", 1), benchmark.measure(4, "cpu", 1)
    assert one["bytes"] == four["bytes"] > 0
    assert four["seconds"] > 0


def test_a_page_keeps_what_other_machines_measured_and_takes_in_all_parts(script, tmp_path, monkeypatch):
    benchmark = script("benchmarks.fit.es_vs_gradient")
    facts = benchmark.machine("cpu")
    point = {"simulations": 10, "seconds": 1.0, "fitted": 1.0, "unseen": 2.0, "loss_mm": 1.0}

    def rows(scene, device):
        common = {"scene": scene, "seed": 0, "start": [3.0, 3.0], "helped": True, "curve": [point, point]}
        return {f"{scene} 0 {method} {device}": {**common, "method": method} for method in benchmark.METHODS}

    paths = [tmp_path / "a.jsonl", tmp_path / "b.jsonl"]
    for path, scene in zip(paths, ("settle", "push"), strict=True):
        kept = benchmark.Measurements(path)
        for key, row in rows(scene, "cuda:0").items():
            kept.add(key, {**row, "machine": {"device": "a graphics processor", **facts}})
    written = {}
    before = {"machines": {"cpu": {**facts, "date": "2020-01-01"}}, "rows": rows("tumble", "cpu")}
    monkeypatch.setattr(benchmark, "FOLDER", tmp_path)
    monkeypatch.setattr(benchmark, "read_data", lambda _: before)
    monkeypatch.setattr(benchmark, "write_data", lambda _, data: written.update(data))
    monkeypatch.setattr(benchmark, "write_page", lambda _, text: written.update(page=text))
    benchmark.report(benchmark.Args(out=paths[0], parts=(paths[1],), report=True))
    cpu, cuda = written["page"].split("Measured ")[1:]
    assert cpu.startswith("2020-01-01")
    assert "| tumble | 1 |" in cpu
    assert "a graphics processor" in cuda
    assert "| settle | 1 |" in cuda
    assert "| push | 1 |" in cuda
    assert set(written["machines"]) == {"cpu", "cuda:0"}
    assert len(written["rows"]) == 6
