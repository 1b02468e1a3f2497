"""Stages along a demonstration and contact slots, against values worked out by hand."""

from dataclasses import FrozenInstanceError

import mujoco
import numpy as np
import pytest
from made_up_task import STAGES, make_events

from concent_warp.errors import TrainError
from concent_warp.events.cfg import StagingCfg
from concent_warp.events.sequence import ContactEvent, ContactEventSequence, ContactPair, Entity, Stage
from concent_warp.kernels.contact_pairs import PairTable
from concent_warp.train.cfg import ChainCfg
from concent_warp.train.task.slots import _by_spread, _select_pairs, slot_table
from concent_warp.train.task.stages import DemonstratedStages, _worst_distance, demonstrated_stages

XML = """
<mujoco><worldbody>
  <body name="goal" pos="0 0 1" quat="0.7071067811865476 0 0 0.7071067811865476"><geom size="0.1"/></body>
  <body name="slider"><joint name="x" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/></body>
</worldbody></mujoco>
"""
M = mujoco.MjModel.from_xml_string(XML)
GOAL, SLIDER = 1, 2


def table_of(targets: list[list[float]], slots: int = 3) -> PairTable:
    """Return stages in which the slider's point (0, 0, 1) is to be at each x of a stage; the first slot is empty."""
    shape = (len(targets), slots)
    active, body_a, body_b = np.zeros(shape, bool), np.zeros(shape, int), np.zeros(shape, int)
    point_a, point_b = np.full((*shape, 3), 9.0), np.full((*shape, 3), -9.0)
    for s, row in enumerate(targets):
        for k, x in enumerate(row, start=1):
            active[s, k], body_a[s, k], body_b[s, k] = True, SLIDER, GOAL
            # The goal is turned by 90 degrees about z: its -y axis is x of the world.
            point_a[s, k], point_b[s, k] = [0, 0, 1], [0, -x, 0]
    none = np.zeros(shape)
    return PairTable(body_a, point_a, none, body_b, point_b, none, np.zeros((*shape, 3)), active)


def data_at(x: float) -> mujoco.MjData:
    d = mujoco.MjData(M)
    d.qpos[:] = x
    mujoco.mj_kinematics(M, d)
    return d


def test_worst_distance_is_that_of_the_pair_farthest_apart():
    table = table_of([[0.5, 2.0], [], [0.25]])
    assert _worst_distance(table, data_at(0.75), 0) == pytest.approx(1.25)
    assert _worst_distance(table, data_at(1.75), 0) == pytest.approx(1.25)
    assert _worst_distance(table, data_at(1.75), 2) == pytest.approx(1.5)
    assert _worst_distance(table, data_at(1.75), 1) == 0.0
    tilted = table_of([[0.5]])
    tilted.point_b[0, 1] = [-3.0, -0.5, -4.0]  # (0.5, -3, -3) in the world, 3 and 4 m beside and below (0.5, 0, 1)
    assert _worst_distance(tilted, data_at(0.5), 0) == pytest.approx(5.0)


def stages_of(times: list[float]) -> list[Stage]:
    event = make_events().stages[0].event
    return [
        Stage(name, 0.0, 0.0, ("robot", "goal"), ContactEvent(time, event.links, event.primitives, event.pairs))
        for name, time in zip(STAGES, times, strict=False)
    ]


CFG = ChainCfg(tolerance=0.125, hold=2)


def stages_along(path: list[float], table: PairTable, times: list[float], period: int = 1, cfg: ChainCfg = CFG):
    return demonstrated_stages(M, table, stages_of(times), np.array(path)[:, None], 0.5, cfg, period)


def test_stage_is_met_when_its_distance_has_been_below_the_tolerance_for_the_held_steps():
    path = [5.0, 1.0, 5.0, 1.0, 1.1, 5.0, 1.0, 2.0, 2.0, 2.0, 3.0, 9.0]
    found = stages_along(path, table_of([[1.0], [2.0], [3.0]]), [0.5, 1.0, 5.25])
    # Stage 0 at rows 3 and 4, stage 1 at rows 7 and 8; the last is not to be met.
    assert found.stage.tolist() == [0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2]
    assert found.start == {0: 0.0, 1: 2.5, 2: 4.5}
    assert found.end == {0: 2.5, 1: 4.5, 2: 5.25}
    with pytest.raises(FrozenInstanceError):
        found.stage = None  # pyright: ignore[reportAttributeAccessIssue]


def test_last_stage_ends_no_sooner_than_it_starts():
    found = stages_along([1.0, 1.0, 7.0, 7.0], table_of([[1.0], [2.0]]), [0.25, 0.75])
    assert found.end == {0: 1.0, 1: 1.0}


def test_a_stage_that_is_met_at_once_again_counts_from_the_start():
    # Both stages have the same target: the second one's steps are counted anew, and not from those of the first.
    found = stages_along([1.0] * 6, table_of([[1.0], [1.0], [1.0]]), [0.5, 1.0, 1.5])
    assert found.stage.tolist() == [0, 0, 1, 1, 2]
    assert found.start == {0: 0.0, 1: 1.0, 2: 2.0}


def test_targets_are_checked_once_a_period():
    path = [5.0, 1.0, 1.0, 1.0, 1.0, 5.0, 5.0, 5.0, 1.0, 1.0, 1.0]
    found = stages_along(path, table_of([[1.0], [2.0]]), [0.5, 1.0], 4, ChainCfg(tolerance=0.125, hold=2))
    # Rows 0, 4 and 8 are checked: met in 4 and 8, and the next stage begins with the end.
    assert found.stage.tolist() == [0] * 10
    assert found.start == {0: 0.0, 1: 5.0}
    path = [5.0, 1.0, 1.0, 1.0, 1.0, 5.0, 5.0, 5.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    found = stages_along(path, table_of([[1.0], [2.0]]), [0.5, 1.0], 4)
    assert found.stage.tolist() == [0] * 12 + [1]
    assert found.start == {0: 0.0, 1: 6.0}
    first = stages_along([1.0, 5.0, 5.0, 5.0], table_of([[1.0], [2.0]]), [0.5, 1.0], 2, ChainCfg(0.125, hold=1))
    assert first.stage.tolist() == [0, 0, 1]
    assert first.start == {0: 0.0, 1: 1.0}


def test_a_distance_of_exactly_the_tolerance_is_not_within_it():
    # The last position is that after the last step, and is not checked.
    for path in ([0.125] * 5, [0.0, 9.0, 0.0, 9.0, 0.0, 9.0], [9.0, 0.0, 0.0]):
        with pytest.raises(TrainError):
            stages_along(path, table_of([[0.0], [2.0]]), [0.5, 1.0])
    assert stages_along([0.124] * 5, table_of([[0.0], [2.0]]), [0.5, 1.0]).start == {0: 0.0, 1: 1.0}


def test_a_target_that_is_not_met_is_an_error_with_its_smallest_distance():
    path = [1.0, 1.0, 2.5, 2.1875, 2.75, 4.0]
    with pytest.raises(TrainError) as error:
        stages_along(path, table_of([[1.0], [2.0], [3.0]]), [0.5, 1.0, 1.5])
    text = str(error.value)
    assert "stage 'align'" in text
    assert "all pairs within 125 mm for 2 control steps" in text
    assert "187.5 mm at best" in text
    assert "--environment.chain.tolerance" in text
    with pytest.raises(TrainError, match=r"'pick'.*1000\.0 mm at best"):
        stages_along([3.0, 2.0, 3.0, 3.0], table_of([[1.0], [2.0]]), [0.5, 1.0])


def test_a_demonstration_of_one_stage_has_nothing_to_meet():
    found = stages_along([9.0, 9.0, 9.0], table_of([[1.0]]), [0.75])
    assert found.stage.tolist() == [0, 0]
    assert (found.start, found.end) == ({0: 0.0}, {0: 0.75})
    assert isinstance(found, DemonstratedStages)


def pair(a: str, b: str, point: tuple[float, float, float], force: float) -> ContactPair:
    return ContactPair(a, b, (point[0], 0.5, 0.25), point, (0.0, 0.0, 1.0), force)


def sequence(pairs: list[ContactPair], bodies: tuple[str, str] = ("block", "box")) -> ContactEventSequence:
    """Return a sequence of an empty stage and one with these pairs."""
    robot = {"left": "left", "right": "right"}
    entities = [Entity(name, "robot", body) for name, body in robot.items()]
    entities += [Entity(f"block{k}", "object", "block", k) for k in range(9)]
    entities += [Entity(f"box{k}", "object", "box", k) for k in range(9)]
    entities.append(Entity("table", "world", "world"))
    none, event = ContactEvent(0.0, (), (), ()), ContactEvent(1.0, (), (), tuple(pairs))
    stages = (Stage("pick", 0.0, 1.0, ("robot", "block"), none), Stage("align", 1.0, 2.0, bodies, event))
    return ContactEventSequence("demo", 0.01, 200, StagingCfg(), tuple(entities), (), (), stages)


LEFT = [pair("left", "block0", (x, 0.0, 0.0), force) for x, force in ((0.0, 1.0), (1.0, 2.0), (3.0, 1.0))]
RIGHT = [pair("right", "block1", (0.0, y, 0.0), 1.0) for y in (0.0, 2.0)]
BOX = [pair("block2", "box0", (0.0, 0.0, z), force) for z, force in ((0.0, 1.0), (4.0, 3.0), (5.0, 1.0), (10.0, 2.0))]


def test_pairs_are_ordered_by_distance_from_those_before_the_strongest_first():
    # From 4: 10 is 6 away; then 0 is 4 away and 5 only 1.
    assert _by_spread(BOX) == [BOX[1], BOX[3], BOX[0], BOX[2]]
    assert _by_spread(LEFT) == [LEFT[1], LEFT[2], LEFT[0]]
    assert _by_spread(BOX[:1]) == BOX[:1]
    rng = np.random.default_rng(0)
    points = rng.normal(size=(9, 3))
    many = [pair("left", "block0", tuple(p), f) for p, f in zip(points.tolist(), rng.random(9), strict=True)]
    order = [int(np.argmax([p.force for p in many]))]
    while len(order) < 9:
        gaps = [min(np.linalg.norm(points[i] - points[j]) for j in order) for i in range(9)]
        order.append(int(np.argmax(gaps)))
    assert _by_spread(many) == [many[i] for i in order]
    same = [pair("left", f"block{k}", (1.0, 2.0, 3.0), 1.0) for k in range(3)]
    assert sorted(_by_spread(same), key=lambda p: p.b) == same


def test_pairs_of_the_opening_bodies_come_first_and_take_the_slots_that_are_left():
    events = sequence([*LEFT, *RIGHT, *BOX])

    def chosen(count: int, of: ContactEventSequence = events) -> list[ContactPair]:
        return _select_pairs(of, of.stages[1], count)

    box, left, right = _by_spread(BOX), _by_spread(LEFT), _by_spread(RIGHT)
    assert chosen(1) == box[:1]
    assert chosen(2) == [*box[:1], *left[:1]]
    assert chosen(3) == [*box[:1], *left[:1], *right[:1]]
    assert chosen(4) == [*box[:2], *left[:1], *right[:1]]
    assert chosen(6) == [*box, *left[:1], *right[:1]]
    # All of the opening bodies are in: the others get the rest in turn.
    assert chosen(7) == [*box, *left[:2], *right[:1]]
    assert chosen(8) == [*box, *left[:2], *right]
    assert chosen(9) == chosen(20) == [*box, *left, *right]
    grasp = sequence([*BOX, *RIGHT, *LEFT], ("robot", "block"))
    assert chosen(5, grasp) == [*right[:2], *left[:2], *box[:1]]
    assert chosen(2, grasp) == [*right[:1], *left[:1]]
    assert chosen(6, grasp) == [*right, *left, *box[:1]]
    assert chosen(0) == []
    assert _select_pairs(events, events.stages[0], 4) == []


def test_slots_have_bodies_points_and_normals_of_their_pairs_and_zeros_beyond():
    xml = """<mujoco><worldbody>
      <body name="box"><geom size="0.1"/></body><body name="right"><geom size="0.1"/></body>
      <body name="block"><geom size="0.1"/></body><body name="left"><geom size="0.1"/></body>
    </worldbody></mujoco>"""
    m = mujoco.MjModel.from_xml_string(xml)
    events = sequence([*RIGHT[:1], *BOX[:2]])
    table, robot = slot_table(m, events, 5)
    expected = [*_by_spread(BOX[:2]), RIGHT[0]]
    assert table.used.tolist() == [[False] * 5, [True, True, True, False, False]]
    assert robot.tolist() == [[False] * 5, [False, False, True, False, False]]
    assert table.body_a.tolist() == [[0] * 5, [3, 3, 2, 0, 0]]
    assert table.body_b.tolist() == [[0] * 5, [1, 1, 3, 0, 0]]
    for name, of in (("point_a", "point_a"), ("point_b", "point_b"), ("normal", "normal")):
        values = np.zeros((2, 5, 3))
        values[1, :3] = [getattr(one, of) for one in expected]
        np.testing.assert_array_equal(getattr(table, name), values)
    assert not table.radius_a.any()
    assert not table.radius_b.any()
    assert table.radius_a.shape == (2, 5)
