import os
import sys

import pytest

CHILD = "import time; held = bytearray(120 * 2**20); time.sleep(1.5)"
PARENT = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {CHILD!r}])"


@pytest.fixture
def main_job(script):
    return script("benchmarks.fit.main_job")


def test_memory_of_what_a_process_starts_counts(main_job):
    run = main_job.watch([sys.executable, "-c", PARENT], 1)
    assert run.code == 0
    assert run.seconds > 1.5
    assert 0 < run.processor < run.seconds + 1
    assert 120 * 2**20 < run.peak < 300 * 2**20


def test_stages_last_from_the_files_of_one_to_those_of_the_next(main_job, tmp_path):
    written = ["settings.toml", "demo.h5", "history.json", "events_a.json", "schedule_a.png"]
    written += ["comparison.json", "report.html"]
    for k, name in enumerate(written):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (0, 1002 + 3 * k))
    found = main_job.stages(tmp_path, 1000.0, 1025.0)
    assert found == {"start": 2, "record": 3, "fit": 3, "events": 6, "compare": 3, "report": 3, "end": 5}


def test_a_bound_that_is_not_kept_shows(main_job):
    assert main_job.judged(181, main_job.SECONDS) == "**not kept**"
    assert main_job.judged(179, main_job.SECONDS) == "kept"
