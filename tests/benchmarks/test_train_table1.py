from types import SimpleNamespace

import mujoco
import numpy as np
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


def test_what_is_hidden_distinguishes_rows(train_table1):
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


def test_lead_scale_and_time_of_training_distinguish_rows(train_table1):
    rows = [row("ours", 0, 100), row("ours", 0, 120, lead=0.5), row("ours", 0, 140, seconds=150)]
    assert len({train_table1.named(one, "insert") for one in rows}) == 3
    lines = [line for line in train_table1.page(rows, "insert").splitlines() if line.startswith("| default settings")]
    assert [line.split("|")[2:5] for line in lines] == [
        [" 150 ", " 1 ", " 70.0% "], [" 60 ", " 0.5 ", " 60.0% "], [" 60 ", " 1 ", " 50.0% "],
    ]  # fmt: skip


def test_successes_are_pooled_over_seeds_with_wilsons_interval(train_table1):
    rows = [row("ours", 3, 150), {**row("ours", 4, 30), "episodes": 40}]
    share, shown = train_table1.pooled(rows)
    assert share == 180 / 240
    assert shown == ["75.0%", "69.2% to 80.1%", "180 of 240", "3: 75%, 4: 75%"]
    none, shown = train_table1.pooled([row("ours", 0, 0)])
    assert none == 0
    assert shown[1] == "0.0% to 1.9%"


def test_targets_met_are_a_mean_over_policies_of_means_over_episodes(train_table1):
    assert train_table1.targets([{**row("ours", 0, 1), "met": [3, 0]}]) == 0.5
    many = {**row("ours", 1, 1), "met": [3, 3, 3, 3, 0]}
    assert train_table1.targets([{**row("ours", 0, 1), "met": [0]}, many]) == pytest.approx(0.4)


XML = """
<mujoco><worldbody>
  <body name="a"><joint name="a" type="slide" axis="1 0 0"/><geom size="0.01"/></body>
  <body name="b" mocap="true"><geom size="0.01"/></body>
</worldbody></mujoco>
"""


@pytest.fixture
def two_targets():
    """A task of two stages whose targets are 0.1 m and 0.2 m away from the first body, and its environment."""
    model = mujoco.MjModel.from_xml_string(XML)
    point_b = np.array([[[0.1, 0.0, 0.0], [0.9, 0.0, 0.0]], [[0.2, 0.0, 0.0], [0.2, 0.0, 0.0]]])
    table = SimpleNamespace(
        used=np.array([[True, False], [True, True]]),
        body_a=np.full((2, 2), 1), body_b=np.full((2, 2), 2), point_a=np.zeros((2, 2, 3)), point_b=point_b,
    )  # fmt: skip
    task = SimpleNamespace(table=table, events=SimpleNamespace(stages=("pick", "insert")))
    return task, SimpleNamespace(physics=SimpleNamespace(model=model))


def met(train_table1, two_targets, path, mocap=0.0):
    task, environment = two_targets
    qpos = np.array(path)[:, None] + mocap
    return train_table1.targets_met(task, environment, qpos, np.array([[mocap, 0, 0, 1, 0, 0, 0]]))


def test_a_target_is_met_after_its_pairs_have_been_together_for_long_enough(train_table1, two_targets):
    hold, near = train_table1.HOLD, 0.9 * train_table1.TOLERANCE
    assert met(train_table1, two_targets, [0.0, 0.05, 0.0]) == 0
    assert met(train_table1, two_targets, [0.1 + near] * (hold - 1) + [0.0]) == 0
    assert met(train_table1, two_targets, [0.1 + near] * hold) == 1
    assert met(train_table1, two_targets, [0.1 + 1.1 * train_table1.TOLERANCE] * 3 * hold) == 0
    assert met(train_table1, two_targets, [0.1] * hold, mocap=0.3) == 1


def test_targets_count_in_their_order_alone(train_table1, two_targets):
    hold = train_table1.HOLD
    assert met(train_table1, two_targets, [0.1] * hold + [0.2] * hold) == 2
    assert met(train_table1, two_targets, [0.2] * hold + [0.1] * hold) == 1
    assert met(train_table1, two_targets, [0.1] * hold + [0.2] * (hold - 1)) == 1
    assert met(train_table1, two_targets, [0.1] * hold + [0.2] * hold + [0.0] * 9) == 2


def test_a_stage_without_pairs_is_never_met(train_table1, two_targets):
    task, environment = two_targets
    task.table.used[0] = False
    assert train_table1.apart(task, 0, mujoco.MjData(environment.physics.model)) == np.inf
    assert met(train_table1, two_targets, [0.1] * 20) == 0
