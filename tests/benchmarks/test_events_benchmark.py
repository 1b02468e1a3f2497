import numpy as np
import pytest


@pytest.fixture
def events(script):
    return script("benchmarks.events.extraction")


def test_the_block_has_sunk_when_it_is_below_the_rim_for_the_first_time_after_it_came_there(events):
    cfg = events.RealityCfg()
    rim = cfg.task.box_height + cfg.task.block_size / 2
    time = np.arange(6.0)
    height = np.array([0.02, rim + 0.05, rim, rim - 0.0019, rim - 0.0021, rim - 0.01])
    assert events.sunk(cfg, time, height, 1.5) == 4.0
    assert events.sunk(cfg, time, height + 0.05, 1.5) is None


def test_true_stages_come_in_order_and_a_wall_is_met_below_the_rim(events):
    from concent_warp.scene.scene import Scene

    cfg = events.RealityCfg(expert=events.RealityCfg().expert.__class__(speed=2.0))
    recording, (truth,) = events.record(cfg, [0])
    found = events.true_starts(cfg, Scene(recording.scene), truth)
    assert 0 < found["pick"] < found["align"] < found["insert"] < truth.time[-1]
    height = np.interp(found["insert"], truth.time, truth.block_position[:, 2])
    assert height < cfg.task.box_height + cfg.task.block_size / 2
