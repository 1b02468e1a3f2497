"""The benchmark of students at a tiny size: rows as they come, what was stopped goes on, the page."""

from dataclasses import replace

import pytest

import concent_warp as cw
from benchmarks.distil.shapes import KINDS, trial
from benchmarks.distil.student import WORLDS, Args, Benchmark, page, variant_cfg
from benchmarks.measurements import Measurements
from concent_warp.train.distil import dagger
from tests.distil.conftest import TINY


class Clock:
    """Time of which a second passes with each look at it."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        self.now += 1.0
        return self.now


@pytest.mark.parametrize("worlds", [("simulation",), pytest.param(WORLDS, marks=pytest.mark.slow)])
def test_a_stopped_benchmark_goes_on_and_its_page_has_what_was_measured(tmp_path, monkeypatch, worlds):
    monkeypatch.setattr("benchmarks.distil.student.WORLDS", worlds)
    longer = replace(TINY, dagger=replace(TINY.dagger, iterations=6))
    args = Args(
        teachers=("shape_sorter",), controls=(), episodes=1, device="cpu", data=tmp_path / "rows.jsonl", distil=longer
    )
    with monkeypatch.context() as patch:
        patch.setattr(dagger, "time", Clock())  # the training takes more looks than there are seconds
        Benchmark(replace(args, seconds=6.0), tmp_path / "runs").run()
    assert "shape_sorter student 0 training" not in Measurements(args.data).rows
    begun = cw.load_student(tmp_path / "runs" / "shape_sorter_student_0").weights["iteration"]
    assert 0 < begun < 6
    Benchmark(args, tmp_path / "runs").run()
    rows = Measurements(args.data).rows
    parts = ["student 0 training", *(f"{who} 0 {world}" for who in ("student", "teacher") for world in worlds)]
    assert set(rows) == {f"shape_sorter {part}" for part in parts}
    assert not any("error" in row for row in rows.values())
    assert rows["shape_sorter student 0 training"]["samples"] == 36
    text = page(list(rows.values()))
    assert "| the student, by DAgger | 0 |" in text
    assert "| the teacher, which observes the state | 0 | 100.0% |" in text
    before = args.data.read_text()
    Benchmark(args, tmp_path / "runs").run()
    assert args.data.read_text() == before


def test_an_error_is_kept_and_tried_again(tmp_path):
    wrong = replace(TINY, images=replace(TINY.images, cameras=("ceiling",)))
    args = Args(teachers=("shape_sorter",), controls=(), episodes=1, device="cpu", data=tmp_path / "rows.jsonl")
    benchmark = Benchmark(replace(args, distil=wrong), tmp_path / "runs")
    found = benchmark._attempt("key", lambda: benchmark._train(*_teacher(), tmp_path / "runs" / "x"), "t", "student", 0)
    assert not found
    assert "ceiling" in Measurements(args.data).rows["key"]["error"]
    assert benchmark.kept.wanted("key")


def _teacher():
    return cw.load_policy("shape_sorter"), "student", 0


@pytest.mark.parametrize("variant", ["blind", "cloned", "rsl_rl", "student"])
def test_controls_differ_from_the_student_in_one_setting(variant):
    cfg = variant_cfg(TINY, variant, 3)
    assert cfg.seed == 3
    assert cfg.network.blind == (variant == "blind")
    assert (cfg.dagger.beta_end == 1) == (variant == "cloned")
    assert (cfg.method == "rsl_rl") == (variant == "rsl_rl")


def test_a_student_is_tried_by_images_of_either_shape(tmp_path):
    tiny = replace(TINY, dagger=replace(TINY.dagger, iterations=1))
    student = cw.distil(cw.load_policy("shape_sorter"), tiny, device="cpu", out=tmp_path / "run")
    machine = {"processor": "x", "cores": 2, "date": "2026-01-01", "python": "3"}
    machine |= dict.fromkeys(("mujoco", "mujoco-warp", "warp-lang", "torch"), "1")
    rows = [{"name": "tiny", "machine": machine, **trial(student, kind, 1, 0)} for kind in (KINDS[1], KINDS[3])]
    assert [row["kind"] for row in rows] == [KINDS[1], KINDS[3]]
    assert all(row["episodes"] == 1 and sum(row["outcomes"].values()) == 1 for row in rows)
    text = page([], rows)
    assert f"| {KINDS[3]} | {rows[1]['successes']} of 1 |" in text
    assert "## Shapes" not in page([], [])
