import sys

import pytest


@pytest.fixture
def trials(script):
    return script("benchmarks.train.trials")


def row(seed, successes, **given):
    facts = dict.fromkeys(("processor", "cores", "python", "mujoco", "mujoco-warp", "warp-lang", "torch", "date"), "x")
    return {
        "case": "ours", "seed": seed, "episodes": 100, "successes": successes, "settings": "", "spheres": 512,
        "machine": facts, "trained_on": facts, "simulation": {"rate": 1.0},
        "trained": {"steps": 9_830_400, "stage": given.get("stage", "insert")},
        "stress": {"successes": successes // 2, "episodes": 50}, **given,
    }  # fmt: skip


def test_tasks_and_stages_have_tables_of_their_own(trials):
    rows = [row(1, 90), row(2, 80), row(3, 40, task="round_peg", stage="insert"), row(1, 20, stage="all")]
    text = trials.page(rows)
    insertion, chain, peg = (text.index(f"\n## {title}") for title in ("Insertion", "The whole task", "A round peg"))
    assert insertion < chain < peg
    assert "| default | 512 | 9.8 M | 85.0% | 79.4% to 89.3% | 1: 90.0%, 2: 80.0% |" in text[insertion:chain]
    assert "1: 20.0%" in text[chain:peg]
    assert "3: 40.0%" in text[peg:]
    assert "Stacking" not in text


def test_another_case_has_a_row_of_its_own_and_is_compared_on_the_seeds_that_both_have(trials):
    ours = [row(1, 90), row(2, 80), row(3, 40)]
    others = [row(seed, successes, case="inset") for seed, successes in ((1, 85), (2, 77), (4, 10))]
    text = trials.page([*ours, *others])
    assert "| default | 512 | 9.8 M | 70.0% |" in text
    assert "| default, without optimisation, spheres inset | 512 | 9.8 M | 57.3% |" in text
    assert "spheres inset: 81.0%, ours 85.0% with the same settings on the seeds that both have (1, 2)" in text
    assert "The difference is 4.0 points [-8.7, 16.7]" in text
    assert "both have" not in trials.page([*ours, row(1, 85, case="inset", settings="--seed 3")])
    fewer = [row(seed, successes, case="surface") | {"spheres": 100} for seed, successes in ((1, 85), (2, 77))]
    assert "geometry optimisation: 81.0%, ours 85.0%" in trials.page([*ours, *fewer])
    assert "both have" not in trials.page([*ours, *(one | {"case": "inset"} for one in fewer)])


def test_prediction_is_of_insertion_alone(trials):
    rows = [row(seed, 50 + 10 * seed) for seed in range(4)]
    away = row(9, 0, task="stacking", stage="insert") | {"stress": {"successes": 50, "episodes": 50}}
    assert "over 4 policies" in trials.page([*rows, away])
    assert "correlation over 4 policies, settings and seeds mixed: 1.00" in trials.page([*rows, away])


def test_prediction_is_of_policies_that_learned_what_they_are_tried_on(trials):
    rows = [row(seed, 50 + 10 * seed) for seed in range(4)]
    earlier = row(9, 0, case="surface") | {"stress": {"successes": 50, "episodes": 50}}
    earlier["trained"] = earlier["trained"] | {"stage": "align"}
    text = trials.page([*rows, earlier])
    assert "correlation over 4 policies, settings and seeds mixed: 1.00" in text
    assert "| default, without contact geometry optimisation | 512 |" in text


def test_a_folder_without_trainings_is_refused_and_no_page_is_written(trials, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", ["trials", str(tmp_path)])
    monkeypatch.setattr(trials, "write_page", lambda *_: pytest.fail("a page is written"))
    with pytest.raises(SystemExit, match="no trainings in"):
        trials.main()


def test_a_case_that_does_not_exist_is_refused(trials, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["trials", "--case", "insett"])
    monkeypatch.setattr(trials, "write_page", lambda *_: pytest.fail("a page is written"))
    with pytest.raises(SystemExit, match="--case insett: no such case; expected one of ours, surface, inset"):
        trials.main()
