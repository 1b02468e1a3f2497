import time

import pytest


@pytest.fixture
def train_gpus(script):
    return script("benchmarks.train.gpus")


def row(gpus, worlds, rate, curve, settings="default"):
    facts = dict.fromkeys(("processor", "cores", "python", "mujoco", "mujoco-warp", "warp-lang", "torch", "date"), "x")
    measured = {"gpus": gpus, "worlds": worlds, "seed": 0, "steps_per_second": rate, "curve": curve}
    return {**measured, "machine": facts, "options": "", "settings": settings, "memory": 2048 * gpus}


def test_page_sets_each_number_of_gpus_against_one(train_gpus):
    one = row(1, 8, 1000.0, [(2_000_000, 2.0, 0.5), (4_000_000, 4.0, 0.96), (6_000_000, 6.0, 0.9)])
    two = row(2, 8, 1900.0, [(2_000_000, 1.0, 0.5), (4_000_000, 2.0, 0.6)])
    assert train_gpus.first(one, 0.9) == (4_000_000, 4.0)
    assert train_gpus.first(two, 0.9) is None
    text = train_gpus.page([two, one])
    assert "| default | 1 x 8 | 1,000 | 1.00 | 100% | 1 | 2.0 M, 2 s | 4.0 M, 4 s | - | 90.0% | 2.0 GiB |" in text
    assert "| default | 2 x 8 | 1,900 | 1.90 | 95% | 1 | 2.0 M, 1 s | - | - | 60.0% | 4.0 GiB |" in text
    assert text.index("1 x 8") < text.index("2 x 8")
    assert "2.0 M, 2 s (1 of 2)" in train_gpus.page([one, row(1, 8, 900.0, [(2_000_000, 2.0, 0.1)])])


def test_settings_are_compared_with_themselves(train_gpus):
    curve = [(2_000_000, 2.0, 0.5)]
    slow, fast = row(1, 8, 1000.0, curve), row(1, 8, 3000.0, curve, "fast")
    text = train_gpus.page([slow, fast, row(2, 8, 4500.0, curve, "fast")])
    assert "| fast | 2 x 8 | 4,500 | 1.50 | 75% |" in text


@pytest.mark.parametrize(
    ("rows", "said"),
    [([], "no training at all"), ([row(4, 8, 1.0, [])], "no training on one GPU with default settings")],
)
def test_a_page_without_a_training_on_one_gpu_is_refused(train_gpus, tmp_path, rows, said):
    with pytest.raises(SystemExit, match=said):
        train_gpus.check(rows, [tmp_path / "nothing.jsonl"])


@pytest.mark.parametrize(("installed", "expected"), [(True, 300), (False, None)])
def test_memory_is_that_of_the_fullest_gpu_where_it_can_be_read(train_gpus, monkeypatch, tmp_path, installed, expected):
    asked = tmp_path / "asked"
    if installed:
        program = tmp_path / "nvidia-smi"
        program.write_text(f"#!/bin/sh\necho x >> {asked}\necho 100\necho 300\n")
        program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    ends = time.monotonic() + 10
    with train_gpus.watched_memory(2, 0.01) as found:
        while installed and not found and time.monotonic() < ends:
            time.sleep(0.01)
        time.sleep(0.1)
    assert max(found, default=None) == expected
    assert asked.exists() == installed
