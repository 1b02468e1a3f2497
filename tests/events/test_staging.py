"""End to end on a gripper, a block and a box with a hole, all of spheres and simulated."""

from dataclasses import replace

import numpy as np
import pytest
from gripper_task import HIGH, HOLE, LOW, OPEN, PICK, SHUT, Task, insert_from

from concent_warp.events.cfg import StagingCfg
from concent_warp.events.extract import extract
from concent_warp.events.overlap import overlap
from concent_warp.events.sequence import ContactEventSequence, Stage
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.simulate.mujoco_engine import MujocoEngine

FINGERS = ("left_finger", "right_finger")
X, Y = HOLE


def names(sequence: ContactEventSequence) -> list[str]:
    return [stage.name for stage in sequence.stages]


def test_pick_align_and_insert_are_found_in_this_order(insertion: ContactEventSequence):
    assert names(insertion) == ["pick", "align", "insert"]
    assert [stage.bodies for stage in insertion.stages] == [("robot", "block"), ("block", "box"), ("block", "box")]


def test_stages_are_contiguous_and_end_with_the_demonstration(insertion: ContactEventSequence):
    first, second, third = insertion.stages
    assert first.end == second.start
    assert second.end == third.start
    assert third.end == pytest.approx(insertion.duration)


def test_stages_begin_with_the_first_contact_of_their_pair(insertion: ContactEventSequence):
    pick, align, insert = insertion.stages
    touched = [(c.start, c.a, c.b) for c in insertion.body_contacts]
    assert pick.start == min(start for start, a, b in touched if a in FINGERS and b == "block")
    assert align.start == min(start for start, a, b in touched if (a, b) == ("block", "box"))
    assert insert.start > align.start


@pytest.mark.parametrize(("x", "y"), [(0.008, 0.0), (-0.003, -0.006), (0.004, 0.009), (-0.011, 0.002)])
def test_three_stages_are_found_from_any_side_of_the_hole(task: Task, x: float, y: float):
    assert names(task.events(*insert_from(x, y))) == ["pick", "align", "insert"]


def test_stages_do_not_depend_on_the_axes_of_the_box(turned_task: Task, insertion: ContactEventSequence):
    turned = turned_task.events(*insert_from(-0.008, 0.002))
    assert names(turned) == names(insertion)
    assert [s.start for s in turned.stages] == pytest.approx([s.start for s in insertion.stages], abs=0.02)


def test_an_oblique_approach_is_no_other_stage(task: Task):
    path = insert_from(-0.008, 0.0)
    path[3] = (0.5, X - 0.03, Y, HIGH, SHUT)
    assert names(task.events(*path)) == ["pick", "align", "insert"]


@pytest.mark.parametrize("x", [0.0, 0.002])
def test_going_straight_in_gives_no_align(task: Task, x: float):
    sequence = task.events(*PICK, (0.5, X + x, Y, HIGH, SHUT), (0.6, X + x, Y, LOW, SHUT), (0.2, X, Y, LOW, SHUT))
    assert names(sequence) == ["pick", "insert"]


def test_resting_on_the_rim_is_never_insertion(task: Task):
    x, rim = X - 0.01, LOW + 0.02
    down_and_up = (0.4, x, Y, rim, SHUT), (0.5, x, Y, rim, SHUT), (0.4, x, Y, HIGH, SHUT)
    assert names(task.events(*PICK, (0.5, x, Y, HIGH, SHUT), *down_and_up)) == ["pick", "align"]


def test_spheres_centred_on_the_surface_close_the_hole_and_never_insert(task: Task):
    geometry = ContactGeometryCfg(count=400, placement="surface").build(task.model.scene)
    model = task.model.with_geometry(geometry)
    sequence = extract(model, task.perform(*insert_from(-0.008, 0.002)), MujocoEngine(model, threads=1))
    assert names(sequence)[:2] == ["pick", "align"]
    assert "insert" not in names(sequence)


def test_exact_boxes_without_spheres_give_the_same_stages(task: Task, insertion: ContactEventSequence):
    model = task.model.with_geometry(None)
    exact = extract(model, task.perform(*insert_from(-0.008, 0.002)), MujocoEngine(model, threads=1))
    assert names(exact) == names(insertion)
    assert "block" not in exact.entity
    assert all(entity.sphere is None for entity in exact.entities)


def test_the_outside_of_the_box_is_no_inner_wall(task: Task):
    x, low = X - 0.058, LOW + 0.003
    aside = (0.4, x, Y, low, SHUT), (0.3, x + 0.008, Y, low, SHUT), (0.4, x, Y, low, SHUT)
    assert names(task.events(*PICK, (0.5, x, Y, HIGH, SHUT), *aside)) == ["pick", "contact block-box"]


def test_pushing_is_no_grasp(task: Task):
    low = LOW - 0.005
    sequence = task.events((0.4, -0.06, 0, HIGH, SHUT), (0.4, -0.06, 0, low, SHUT), (0.5, 0, 0, low, SHUT))
    assert names(sequence) == ["contact robot-block"]


def test_nothing_happens_without_contact_with_the_robot(task: Task):
    sequence = task.events((0.5, 0, 0, HIGH, OPEN))
    assert sequence.stages == ()
    assert [(c.a, c.b) for c in sequence.body_contacts] == [("block", "world")]


def test_picking_again_is_no_new_stage(task: Task):
    again = (0.3, 0, 0, LOW, SHUT), (0.3, 0, 0, LOW, OPEN), (0.3, 0, 0, LOW, SHUT)
    assert names(task.events(*PICK, *again)) == ["pick"]


def by_pair(stage: Stage) -> dict[tuple[str, str], list]:
    groups: dict[tuple[str, str], list] = {}
    for pair in stage.event.pairs:
        groups.setdefault((pair.a.split("_sphere")[0], pair.b.split("_sphere")[0]), []).append(pair)
    return groups


def test_target_events_hold_the_grasp_and_what_the_stage_adds(insertion: ContactEventSequence):
    grasp = {(finger, "block") for finger in FINGERS}
    pick, align, insert = (set(by_pair(stage)) for stage in insertion.stages)
    assert pick == grasp
    assert align == insert == grasp | {("block", "box")}
    assert all(stage.event.links == FINGERS for stage in insertion.stages)
    assert all(stage.start <= stage.event.time <= stage.end for stage in insertion.stages)


def test_target_points_lie_on_the_surfaces_of_both_bodies(insertion: ContactEventSequence):
    pick, align, insert = (by_pair(stage) for stage in insertion.stages)
    for pair in pick["left_finger", "block"]:
        assert pair.point_b[1] == pytest.approx(0.02, abs=1e-3)
        assert pair.normal[1] > 0.6
    for pair in align["block", "box"]:
        assert pair.point_a[2] == pytest.approx(-0.02, abs=3e-3)
        assert pair.point_b[2] == pytest.approx(0.025, abs=3e-3)
        assert pair.normal[2] > 0.7
    assert min(pair.point_b[2] for pair in insert["block", "box"]) < 0.022
    assert all(np.linalg.norm(pair.normal) == pytest.approx(1, abs=1e-4) for pairs in insert.values() for pair in pairs)


def test_the_literal_target_is_read_at_the_transition(task: Task, insertion: ContactEventSequence):
    cfg = StagingCfg(target="transition")
    literal = extract(task.model, task.perform(*insert_from(-0.008, 0.002)), task.engine, cfg)
    assert names(literal) == names(insertion)
    for stage in literal.stages:
        assert stage.event.time == pytest.approx(stage.start + cfg.window / 2, abs=0.006)


def test_a_finer_step_gives_the_same_stages(task: Task, insertion: ContactEventSequence):
    scene = replace(task.model.scene, xml=task.model.scene.xml.replace('timestep="0.005"', 'timestep="0.002"'))
    model = replace(task.model, scene=scene)
    finer = extract(model, task.perform(*insert_from(-0.008, 0.002)), MujocoEngine(model, threads=1))
    assert finer.timestep == 0.002
    assert names(finer) == names(insertion)
    for a, b in zip(finer.stages[:2], insertion.stages[:2], strict=True):
        assert a.start == pytest.approx(b.start, abs=0.02)


@pytest.mark.slow
def test_the_two_engines_give_the_same_stages_and_pairs(task: Task, insertion: ContactEventSequence):
    from concent_warp.simulate.warp_engine import WarpEngine

    warp = extract(task.model, task.perform(*insert_from(-0.008, 0.002)), WarpEngine(task.model))
    assert names(warp) == names(insertion)
    assert [s.start for s in warp.stages] == pytest.approx([s.start for s in insertion.stages], abs=0.02)
    assert {(c.a, c.b) for c in warp.body_contacts} == {(c.a, c.b) for c in insertion.body_contacts}
    found = overlap(warp, insertion)
    assert found.frames.pooled > 0.95
    assert min(found.primitives.values()) > 0.7
    assert set(found.links.values()) == {1.0}
