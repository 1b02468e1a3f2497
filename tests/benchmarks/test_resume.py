import os
import time

import numpy as np
import pytest

from concent_warp.model import Model
from tests.fit.conftest import DROP, HALF, corner_spheres


@pytest.fixture
def resume(script):
    return script("benchmarks.fit.resume")


@pytest.fixture
def saved(tmp_path):
    from concent_warp.scene.scene import Scene

    Model(Scene(DROP), corner_spheres(HALF)).save(tmp_path / "model.toml")
    (tmp_path / "comparison.json").write_text('{"a": [1, 2]}')
    np.savez(tmp_path / "rollout.npz", qpos=np.zeros((4, 7)))
    return tmp_path


def test_whole_files_can_be_read(resume, saved):
    assert all(resume.readable(path) for path in saved.iterdir())


@pytest.mark.parametrize("name", ["model.geometry.npz", "model.scene.xml", "comparison.json", "rollout.npz"])
def test_a_file_cut_short_is_found_out(resume, saved, name):
    path = saved / name
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert not all(resume.readable(path) for path in saved.iterdir())


def test_a_checkpoint_cut_short_is_found_out(resume, saved):
    whole = (saved / "rollout.npz").read_bytes()
    (saved / "checkpoint.npz").write_bytes(whole[:-9])
    assert not resume.readable(saved / "checkpoint.npz")


def test_processor_time_counts_work_and_not_sleep(resume):
    start = resume.processor_time(os.getpid())
    time.sleep(0.3)
    slept = resume.processor_time(os.getpid())
    while resume.processor_time(os.getpid()) < slept + 0.2:
        sum(range(10000))
    assert slept - start < 0.2
    assert time.process_time() > 0.2
