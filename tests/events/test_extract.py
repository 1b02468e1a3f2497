"""Extraction from contact logs written by hand: a robot link, a block of two spheres, and a fixed plate."""

from typing import Any

import numpy as np
import pytest
from gripper_task import Task, insert_from

from concent_warp.errors import EventsError
from concent_warp.events.cfg import StagingCfg
from concent_warp.events.extract import _from_log, extract
from concent_warp.events.roles import Roles
from concent_warp.events.sequence import ContactEventSequence, Entity
from concent_warp.events.touches import BodyPoses
from concent_warp.simulate.engine import ContactLog

DT = 0.01
STEPS = 100
LINK, PLATE, FLOOR = 0, 3, 4
ROLES = Roles(
    bodies=("world", "hand", "block", "plate"),
    body_role=("world", "robot", "object", "object"),
    entities=(
        Entity("hand", "robot", "hand"),
        Entity("block_sphere0", "object", "block", 0),
        Entity("block_sphere1", "object", "block", 1),
        Entity("plate_sphere0", "object", "plate", 2),
        Entity("floor", "world", "world"),
    ),
    geom_body=np.array([1, 2, 2, 3, 0]),
    geom_entity=np.arange(5),
)
Row = tuple[int, int, int, tuple[float, float, float], tuple[float, float, float], float]


def still() -> BodyPoses:
    """Return the motion of bodies that stay where they are, the block turned by a quarter about z at (1, 0, 0)."""
    position = np.zeros((STEPS, 4, 3))
    position[:, 2] = 1, 0, 0
    rotation = np.tile(np.eye(3), (STEPS, 4, 1, 1))
    rotation[:, 2] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    return BodyPoses(DT, position, rotation)


def log(*rows: Row) -> ContactLog:
    """Return a log of contacts (step, first geom, second geom, point, normal from first to second, normal force)."""
    ordered = sorted(rows, key=lambda row: row[:3])
    normal = np.array([row[4] for row in ordered], dtype=float).reshape(-1, 3)
    force = np.array([row[5] for row in ordered])[:, None] * normal
    return ContactLog(
        variant=np.zeros(len(ordered), dtype=int),
        step=np.array([row[0] for row in ordered], dtype=int),
        geom=np.array([row[1:3] for row in ordered], dtype=int).reshape(-1, 2),
        position=np.array([row[3] for row in ordered], dtype=float).reshape(-1, 3),
        normal=normal,
        distance=np.zeros(len(ordered)),
        force=force + 0.3 * np.cross(force, [0, 0, 1]),
    )


def touch(
    steps: range, a: int, b: int, normal: tuple[float, float, float] = (0, 1, 0), force: float = 2.0
) -> list[Row]:
    return [(step, a, b, (1.0, 0.5, 0.0), normal, force) for step in steps]


def events(*rows: list[Row], cfg: StagingCfg | None = None) -> ContactEventSequence:
    return _from_log(log(*(row for part in rows for row in part)), ROLES, still(), cfg=cfg)


def test_an_interval_has_times_peak_force_point_and_normal_in_the_frame_of_b():
    sequence = events(touch(range(20, 30), LINK, 1), touch(range(25, 26), LINK, 1, force=3.0))
    (contact,) = sequence.body_contacts
    assert (contact.a, contact.b) == ("hand", "block")
    assert (contact.start, contact.end) == (0.2, 0.3)
    assert contact.force == pytest.approx(5.0)
    assert contact.point == pytest.approx((0.5, 0, 0))
    assert contact.normal == pytest.approx((-1, 0, 0))


def test_the_order_of_geoms_in_the_log_does_not_matter():
    one = events(touch(range(20, 30), FLOOR, 1, normal=(0, 0, 1)))
    other = events(touch(range(20, 30), 1, FLOOR, normal=(0, 0, -1)))
    assert one.body_contacts == other.body_contacts
    assert (one.body_contacts[0].a, one.body_contacts[0].b) == ("block", "world")
    assert one.body_contacts[0].normal == pytest.approx((0, 0, 1))


def test_of_two_objects_the_one_that_the_robot_touches_for_longer_comes_first():
    held = touch(range(0, 60), LINK, PLATE)
    (contact,) = (c for c in events(held, touch(range(20, 60), 1, PLATE)).body_contacts if c.a != "hand")
    assert (contact.a, contact.b) == ("plate", "block")


def test_chatter_is_closed_and_taps_are_dropped():
    flicker = [row for k in range(20, 60, 4) for row in touch(range(k, k + 1), LINK, 1)]
    sequence = events(flicker, touch(range(80, 82), LINK, PLATE))
    assert [(c.a, c.b, c.start, c.end) for c in sequence.body_contacts] == [("hand", "block", 0.2, 0.57)]
    assert [e.name for e in sequence.entities] == ["block_sphere0", "hand"]


def test_a_sphere_counts_only_while_its_bodies_do():
    sequence = events(touch(range(20, 40), LINK, 1), touch(range(30, 31), LINK, 2), touch(range(60, 61), LINK, 2))
    assert [(c.b, c.start, c.end) for c in sequence.contacts] == [
        ("block_sphere0", 0.2, 0.4),
        ("block_sphere1", 0.3, 0.31),
    ]


def test_a_squeeze_is_a_grasp_and_opens_at_the_first_touch():
    sequence = events(touch(range(20, 90), LINK, 1), touch(range(40, 90), LINK, 2, normal=(0, -1, 0)))
    assert [(s.name, s.start, s.end) for s in sequence.stages] == [("pick", 0.2, 1.0)]
    assert sequence.stages[0].event.primitives == ("block_sphere0", "block_sphere1")


def test_a_touch_that_moves_nothing_opens_no_stage():
    assert events(touch(range(20, 90), LINK, 1)).stages == ()


def test_contacts_at_the_start_open_no_stage():
    squeeze = touch(range(0, 90), LINK, 1) + touch(range(0, 90), LINK, 2, normal=(0, -1, 0))
    assert events(squeeze, touch(range(0, 90), 1, PLATE)).stages == ()


def test_a_new_contact_of_objects_is_align_if_one_is_held_and_else_has_the_names_of_both():
    squeeze = touch(range(20, 90), LINK, 1) + touch(range(20, 90), LINK, 2, normal=(0, -1, 0))
    lying = touch(range(50, 90), 1, PLATE, normal=(0, 0, -1))
    assert [s.name for s in events(squeeze, lying).stages] == ["pick", "align"]
    assert [s.name for s in events(lying).stages] == ["contact block-plate"]


def test_spheres_that_touch_rarely_are_no_part_of_the_target():
    squeeze = touch(range(20, 100), LINK, 1) + touch(range(20, 100), LINK, 2, normal=(0, -1, 0))
    event = events(squeeze, touch(range(85, 88), LINK, 1, normal=(0, 1, 0))).stages[0].event
    assert len(event.pairs) == 2
    rare = [row for k in range(20, 100, 5) for row in touch(range(k, k + 1), LINK, 2, normal=(0, -1, 0), force=10.0)]
    event = events(touch(range(20, 100), LINK, 1), rare).stages[0].event
    assert event.primitives == ("block_sphere0",)
    always = events(touch(range(20, 100), LINK, 1), rare, cfg=StagingCfg(min_touch_share=0.1)).stages[0].event
    assert always.primitives == ("block_sphere0", "block_sphere1")


def test_no_contact_at_all_gives_an_empty_sequence_that_can_be_saved(tmp_path):
    sequence = events()
    assert (sequence.entities, sequence.contacts, sequence.stages) == ((), (), ())
    sequence.save(tmp_path / "empty.json")
    assert ContactEventSequence.load(tmp_path / "empty.json") == sequence


def test_only_the_chosen_variant_is_read():
    both = log(*touch(range(20, 40), LINK, 1))
    other = ContactLog(**{**vars(both), "variant": np.ones(len(both.step), dtype=int)})
    assert _from_log(other, ROLES, still()).body_contacts == ()
    assert len(_from_log(other, ROLES, still(), variant=1).body_contacts) == 1


def test_geoms_of_another_model_are_refused():
    with pytest.raises(EventsError, match="geoms that the model lacks"):
        events(touch(range(3), LINK, 9))


def test_a_replay_that_diverges_is_refused(task: Task):
    demonstration = task.perform(*insert_from(-0.008, 0.0))
    assert demonstration.qpos is not None
    demonstration.qpos[2] = 1e12
    with pytest.raises(EventsError, match="does not stay finite"):
        extract(task.model, demonstration, task.engine)


@pytest.mark.parametrize(
    ("setting", "value"),
    [("max_gap", -1), ("min_contact_duration", float("nan")), ("min_touch_share", 0), ("target", "best")],
)
def test_settings_that_cannot_be_are_refused(setting: str, value: Any):
    with pytest.raises(EventsError, match=setting):
        StagingCfg(**{setting: value})
