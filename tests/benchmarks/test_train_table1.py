import pytest


@pytest.fixture
def train_table1(script):
    return script("benchmarks.train.table1")


def row(case, seed, successes, *, hidden=(), lead=1.0, settings="", seconds=61):
    facts = dict.fromkeys(("processor", "cores", "python", "mujoco", "mujoco-warp", "warp-lang", "torch", "date"), "x")
    return {
        "case": case, "seed": seed, "episodes": 200, "successes": successes, "stages": 3, "met": [3, 0],
        "outcomes": {"missed": 200 - successes, "success": successes}, "hidden": list(hidden),
        "simulation": {"rate": 1.0}, "trained": {"stage": "insert", "steps": 10, "seconds": seconds},
        "machine": facts, "trained_on": facts, "settings": settings, "setpoint_lead_scale": lead,
    }  # fmt: skip


def test_cases_are_ordered_by_the_seeds_that_all_have(train_table1):
    rows = [row("ours", 9, 180), row("ours", 10, 190), row("ours", 0, 0), row("inset", 9, 150), row("inset", 10, 200)]
    text = train_table1.page(rows, "insert")
    assert "| ours | 61.7% | 57.7% to 65.5% | 370 of 600 | 0: 0%, 9: 90%, 10: 95% | 80 % | 50% | 100.0% |" in text
    assert "seeds that all have (9, 10): ours, 92.5% > without optimisation, spheres inset, 87.5%." in text
    assert "Not tried: without contact geometry optimisation;" in text
    assert "## With an effect hidden" not in text
    apart = train_table1.page([row("ours", 0, 1), row("inset", 1, 1)], "insert")
    assert "In the order found" not in apart


def test_what_is_hidden_tells_rows_apart(train_table1):
    late = [row("unaware", 6, 90, hidden=["actuator_delay=0.1"]), row("aware", 6, 150, hidden=["actuator_delay=0.1"])]
    later = [row("unaware", 6, 20, hidden=["actuator_delay=0.2"])]
    rows = [row("ours", 6, 180), *late, *later]
    assert len({train_table1.named(one, "insert") for one in rows}) == len(rows)
    text = train_table1.page(rows, "insert")
    glance = text.split("at a glance")[2].split("Trials")[0]
    assert [line.split("|")[1].strip() for line in glance.splitlines() if line.startswith("| ours")] == [
        "ours, an effect hidden (actuator_delay=0.1)",
        "ours, the hidden effect added (actuator_delay=0.1)",
        "ours, an effect hidden (actuator_delay=0.2)",
    ]
    assert "added (actuator_delay=0.1), 75.0% > ours, an effect hidden (actuator_delay=0.1), 45.0%." in text


def test_lead_scale_and_time_of_training_tell_rows_apart(train_table1):
    rows = [row("ours", 0, 100), row("ours", 0, 120, lead=0.5), row("ours", 0, 140, seconds=150)]
    assert len({train_table1.named(one, "insert") for one in rows}) == 3
    lines = [line for line in train_table1.page(rows, "insert").splitlines() if line.startswith("| default settings")]
    assert [line.split("|")[2:5] for line in lines] == [
        [" 150 ", " 1 ", " 70.0% "], [" 60 ", " 0.5 ", " 60.0% "], [" 60 ", " 1 ", " 50.0% "],
    ]  # fmt: skip
