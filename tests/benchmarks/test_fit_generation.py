import numpy as np
import pytest

from concent_warp.fit.fit_geometry import FitCfg, cut_segments
from concent_warp.fit.geometry.evolution import EvolutionCfg
from concent_warp.fit.geometry.search import Search
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.warp_engine import WarpEngine


@pytest.fixture
def benchmark(script):
    return script("benchmarks.fit.generation")


def test_the_bare_loop_simulates_what_the_generation_does(benchmark, drop, swollen):
    cfg = FitCfg(evolution=EvolutionCfg(population=3, neighbours=2))
    search = Search(swollen, cut_segments(swollen, drop.demonstrations, cfg), cfg, "warp")
    found = search.survey(search.used)
    mask, reachable = found.mask, found.reachable
    engine = WarpEngine(swollen, collidable=reachable | mask, device="cpu")
    parts, position = benchmark.generation(search, mask, engine)
    assert set(parts) == set(benchmark.PARTS)
    assert search.evolution.generation == 1
    (segment,) = search.used
    bare = benchmark.Bare(engine, segment.ctrl, segment.qpos, segment.qvel, len(position))
    assert bare.seconds(position) > 0
    end = len(segment.ctrl)
    state = np.tile(segment.qpos, (3, 1)), np.tile(segment.qvel, (3, 1))
    variants = Variants(3, sphere_position=position, qpos=state[0], qvel=state[1])
    rollout = engine.run(variants, segment.ctrl, record=[end]).numpy()
    np.testing.assert_allclose(bare.data.qpos.numpy(), rollout.qpos[:, 0], atol=1e-6)
    assert np.ptp(rollout.qpos[:, 0, 2]) > 1e-5


def test_a_spread_holds_the_median_and_the_extremes(benchmark):
    assert benchmark.spread(np.array([3.0, 1.0, 2.0])) == {"median": 2.0, "low": 1.0, "high": 3.0}
