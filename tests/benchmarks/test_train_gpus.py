import pytest


@pytest.fixture
def train_gpus(script):
    return script("benchmarks.train.gpus")


def row(gpus, worlds, rate, curve):
    facts = dict.fromkeys(("processor", "cores", "python", "mujoco", "mujoco-warp", "warp-lang", "torch", "date"), "x")
    measured = {"gpus": gpus, "worlds": worlds, "seed": 0, "steps_per_second": rate, "curve": curve}
    return {**measured, "machine": facts, "options": ""}


def test_page_sets_each_number_of_gpus_against_one(train_gpus):
    one = row(1, 8, 1000.0, [(2_000_000, 2.0, 0.5), (4_000_000, 4.0, 0.96), (6_000_000, 6.0, 0.9)])
    two = row(2, 8, 1900.0, [(2_000_000, 1.0, 0.5), (4_000_000, 2.0, 0.6)])
    assert train_gpus.first(one, 0.9) == (4_000_000, 4.0)
    assert train_gpus.first(two, 0.9) is None
    text = train_gpus.page([two, one])
    assert "| 1 x 8 | 1,000 | 1.00 | 1 | 2.00 M, 2 s | 2.00 M, 2 s | 4.00 M, 4 s | 90.0% |" in text
    assert "| 2 x 8 | 1,900 | 1.90 | 1 | 2.00 M, 1 s | 2.00 M, 1 s | - | 60.0% |" in text
    assert "2.00 M, 2 s (1 of 2)" in train_gpus.page([one, row(1, 8, 900.0, [(2_000_000, 2.0, 0.1)])])
    assert "default settings" in text
    text = train_gpus.page([{**one, "options": "--environment.stride 2"}])
    assert "`--environment.stride 2`" in text
    assert "default settings" not in text
