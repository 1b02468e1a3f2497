from dataclasses import replace

import numpy as np
import pytest

from concent_warp.errors import EventsError
from concent_warp.events.overlap import (
    contact_frames,
    debounce_frames,
    iou,
    overlap,
    resample,
    sequence_frames,
    time_grid,
)
from concent_warp.events.sequence import ContactEventSequence

GRID = time_grid(1.0, 0.1)


def frames(text: str) -> np.ndarray:
    return np.array([c == "#" for c in text])


def test_the_grid_has_the_middles_of_frames_that_cover_the_time():
    assert pytest.approx(np.arange(0.05, 1.0, 0.1)) == GRID
    assert len(time_grid(1.01, 0.1)) == 11


def test_a_frame_is_in_contact_if_any_contact_falls_in_it():
    found = contact_frames(
        [(0.0, "b", "a"), (0.09, "a", "b"), (0.35, "a", "b"), (1.0, "a", "b"), (7.0, "c", "a")], GRID
    )
    assert set(found) == {("a", "b")}
    assert found["a", "b"].tolist() == frames("#..#......").tolist()


def test_resampled_frames_agree_with_those_from_a_list():
    rng = np.random.default_rng(0)
    time = np.arange(0, 1.0, 0.002)
    touching = rng.random(len(time)) < 0.02
    listed = contact_frames([(t, "x", "y") for t in time[touching]], GRID)
    assert np.array_equal(resample({("y", "x"): touching}, time, GRID)["x", "y"], listed["x", "y"])


def test_overlap_is_intersection_over_union_by_pair_and_pooled():
    a = {("x", "y"): frames("####......"), ("x", "z"): frames("##........")}
    b = {("y", "x"): frames("..####....")}
    found = iou(a, b)
    assert found.pairs == {("x", "y"): pytest.approx(2 / 6), ("x", "z"): 0.0}
    assert found.pooled == pytest.approx(2 / 8)


def test_a_dissolved_contact_has_no_overlap_and_no_contact_in_either_full_overlap():
    assert iou({("x", "y"): frames("..##")}, {}).pooled == 0.0
    assert iou({}, {}).pooled == 1.0


def test_only_the_chosen_pairs_are_compared():
    a = {("x", "y"): frames("##.."), ("x", "z"): frames("....")}
    b = {("x", "y"): frames("##.."), ("x", "z"): frames("####")}
    assert iou(a, b, pairs=[("y", "x")]).pooled == 1.0


def test_accounts_on_different_grids_are_refused():
    with pytest.raises(EventsError, match="same time grid"):
        iou({("x", "y"): frames("##")}, {("x", "y"): frames("###")})
    with pytest.raises(EventsError, match="wrong shape"):
        resample({("x", "y"): frames("##")}, np.arange(3.0), GRID)


def test_the_chatter_rule_can_be_applied_to_measured_frames():
    found = debounce_frames({("x", "y"): frames("#.#.##......#...")}, 0.02)
    assert found["x", "y"].tolist() == frames("######..........").tolist()


def test_the_frames_of_a_sequence_are_its_contacts_of_bodies(insertion: ContactEventSequence):
    grid = time_grid(insertion.duration, insertion.timestep)
    found = sequence_frames(insertion, grid)
    spans = [c for c in insertion.body_contacts if (c.a, c.b) == ("block", "box")]
    assert found["block", "box"].sum() == round(sum(c.end - c.start for c in spans) / insertion.timestep)


def test_a_sequence_agrees_fully_with_itself(insertion: ContactEventSequence):
    found = overlap(insertion, insertion)
    assert found.frames.pooled == 1.0
    assert set(found.primitives.values()) == set(found.links.values()) == {1.0}


def test_a_missing_stage_and_missing_contacts_show(insertion: ContactEventSequence):
    less = replace(
        insertion,
        stages=insertion.stages[:2],
        body_contacts=tuple(c for c in insertion.body_contacts if (c.a, c.b) != ("block", "box")),
    )
    found = overlap(insertion, less)
    assert found.primitives == {"pick": 1.0, "align": 1.0, "insert": 0.0}
    assert found.frames.pairs["block", "box"] == 0.0
    assert found.frames.pairs["block", "left_finger"] == 1.0
    assert 0 < found.frames.pooled < 1
