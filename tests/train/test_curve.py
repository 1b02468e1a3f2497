"""Curves in run folders."""

import json

from concent_warp.train.learning.metrics import CURVE, curve, read_curve


def point(iteration: int) -> dict[str, float]:
    return {"iteration": iteration, "steps": 10 * iteration, "seconds": 0.5 * iteration, "success": 0.1 * iteration}


def test_rounds_are_read_as_they_were_written(tmp_path):
    assert read_curve(tmp_path) == []
    with curve(tmp_path, 0) as write:
        for k in (1, 2):
            write(point(k))
        assert read_curve(tmp_path) == [point(1), point(2)]  # while training goes on, too


def test_rounds_after_the_checkpoint_are_written_anew(tmp_path):
    with curve(tmp_path, 0) as write:
        for k in (1, 2, 3):
            write(point(k))
    with (tmp_path / CURVE).open("a") as file:
        file.write(json.dumps(point(4))[:-5])
    with curve(tmp_path, 20) as write:
        write(point(3) | {"success": 0.9})
    assert [row["iteration"] for row in read_curve(tmp_path)] == [1, 2, 3]
    assert read_curve(tmp_path)[-1]["success"] == 0.9
