"""Tasks of a diagnosis and their progress."""

from __future__ import annotations

import pytest

from concent_warp.diagnosis.tasks import TaskRunner, ignore_progress, run_tasks


def test_tasks_report_their_share_in_order():
    seen: list[tuple[float, str]] = []
    runner = TaskRunner(1, lambda share, text: seen.append((share, text)))
    runner.enter(0.2, 0.6)
    assert runner.run(lambda a, b: a + b, [(1, 2), (3, 4)], "adding", 0.5) == [3, 7]
    assert seen == [(pytest.approx(0.3), "adding, 1 of 2"), (pytest.approx(0.4), "adding, 2 of 2")]
    assert runner.share == pytest.approx(0.4)
    assert runner.run(lambda: 1, [], "nothing") == []
    assert runner.share == pytest.approx(0.4)
    runner.run(abs, [(1,)], "by default a part of what is left")
    assert runner.share == pytest.approx(0.48)
    assert (TaskRunner().jobs, TaskRunner().progress) == (1, ignore_progress)
    ignore_progress(0.5, "half")
    done: list[int] = []
    lazy = run_tasks(done.append, [(k,) for k in range(3)], 1)
    assert done == []
    assert len(list(lazy)) == 3
    assert done == [0, 1, 2]
    alone = run_tasks(done.append, [(9,)], 8)
    list(alone)
    assert done[-1] == 9
