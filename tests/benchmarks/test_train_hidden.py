import re

import pytest


@pytest.fixture
def hidden(script):
    return script("benchmarks.train.hidden")


def row(case, seed, successes, **given):
    facts = dict.fromkeys(("processor", "cores", "python", "mujoco", "mujoco-warp", "warp-lang", "torch", "date"), "x")
    return {
        "case": case, "seed": seed, "episodes": 100, "successes": successes, "settings": "", "machine": facts,
        "hidden": ["actuator_delay=0.2"], "trained_on": facts, "simulation": {"rate": 1.0}, **given,
    }  # fmt: skip


def test_recovered_share_is_of_the_cost_over_the_seeds_that_both_have(hidden):
    rows = [row("unaware", 1, 20), row("unaware", 2, 40), row("aware", 1, 80), row("aware", 2, 80)]
    text = hidden.page([*rows, row("aware", 3, 0)], reference=0.9)
    (found, low, high) = map(int, re.search(r"\| (\d+)% \[(\d+)%, (\d+)%\] \|", text).groups())
    assert found == round(100 * 0.5 / 0.6)
    assert low < found < high
    assert "1: 20.0%, 2: 40.0%" in text
    assert "3: 0.0%" in text


def test_other_settings_have_a_row_of_their_own_and_the_cost_is_that_of_default_settings(hidden):
    other = row("aware", 1, 60, settings="--environment.observation.history 5")
    text = hidden.page([row("unaware", 1, 20), row("aware", 1, 40), other], reference=0.9)
    rows = [line for line in text.splitlines() if line.startswith("| ours")]
    assert [line.split(" | ")[1] for line in rows] == ["20.0%", "40.0%", "60.0%"]
    assert "history 5" in rows[2]
    assert "57%" in rows[2]


def test_no_share_of_a_cost_that_is_none(hidden):
    text = hidden.page([row("unaware", 1, 95), row("aware", 1, 99)], reference=0.9)
    assert "no cost" in text


def test_cost_is_measured_against_trials_with_nothing_hidden(hidden):
    assert hidden.without_effect() == pytest.approx(0.9965)


def test_folders_without_trainings_and_of_another_effect_are_refused(hidden, tmp_path):
    asked = hidden.Table1Args(out=tmp_path, hidden="actuator_delay=0.2")
    with pytest.raises(SystemExit, match=r"no ended training of unaware, randomised, aware; make them"):
        hidden.trainings(asked)
    for case in ("aware", "unaware"):
        run = tmp_path / "runs" / f"{case}_insert_7"
        run.mkdir(parents=True)
        (run / hidden.RESULT).write_text("{}")
    assert hidden.trainings(asked) == [("unaware", 7), ("aware", 7)]
    made = tmp_path / "models" / hidden.CASES["aware"].material(7)
    made.mkdir(parents=True)
    (made / "hidden.txt").write_text("joint_friction=3")
    with pytest.raises(SystemExit, match=r"made with joint_friction=3 hidden, not actuator_delay=0\.2"):
        hidden.trainings(asked)
