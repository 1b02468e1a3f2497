import json
from dataclasses import replace
from pathlib import Path

import pytest
from gripper_task import Task, insert_from

from concent_warp.errors import EventsError
from concent_warp.events.extract import extract
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.simulate.mujoco_engine import MujocoEngine


@pytest.fixture
def saved(insertion: ContactEventSequence, tmp_path: Path) -> Path:
    path = tmp_path / "events.json"
    insertion.save(path)
    return path


def test_save_and_load_give_back_the_same_sequence_and_bytes(insertion: ContactEventSequence, saved: Path):
    loaded = ContactEventSequence.load(saved)
    assert loaded == insertion
    assert loaded.to_json() == saved.read_text()
    assert [p.name for p in saved.parent.iterdir()] == ["events.json"]


def test_the_same_demonstration_gives_the_same_bytes(task: Task, insertion: ContactEventSequence):
    demonstration = task.perform(*insert_from(-0.008, 0.002))
    for _ in range(3):
        assert extract(task.model, demonstration, task.engine).to_json() == insertion.to_json()
    fresh = MujocoEngine(task.model, threads=2)
    assert extract(task.model, demonstration, fresh).to_json() == insertion.to_json()


def test_the_file_says_what_it_is_and_has_no_negative_zero(saved: Path):
    document = json.loads(saved.read_text())
    assert (document["format"], document["version"]) == ("concent-events", 1)
    assert "-0.0," not in saved.read_text()
    assert "-0.0]" not in saved.read_text()


def test_entities_are_those_in_contact(insertion: ContactEventSequence):
    named = {name for c in insertion.contacts for name in (c.a, c.b)}
    assert named == {entity.name for entity in insertion.entities}
    assert {e.role for e in insertion.entities} == {"robot", "object", "world"}
    assert all((e.sphere is not None) == (e.role == "object") for e in insertion.entities)


def test_contacts_lie_within_the_contacts_of_their_bodies(insertion: ContactEventSequence):
    spans: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for c in insertion.body_contacts:
        spans.setdefault((c.a, c.b), []).append((c.start, c.end))
    for c in insertion.contacts:
        bodies = insertion.entity[c.a].body, insertion.entity[c.b].body
        assert any(start <= c.start and c.end <= end for start, end in spans[bodies])


BROKEN = {
    "truncated": (lambda t: t[: len(t) // 2], "not a JSON file"),
    "not JSON": (lambda _: "hello", "not a JSON file"),
    "a list": (lambda _: "[]", "not a contact event sequence"),
    "another format": (lambda t: t.replace("concent-events", "other"), "not a contact event sequence"),
    "another version": (lambda t: t.replace('"version": 1', '"version": 2'), "unknown version.*expected 1, found 2"),
    "misnamed entry": (lambda t: t.replace('"timestep"', '"step"'), "unknown entries.*'step'"),
    "missing entry": (lambda t: t.replace(' "timestep": 0.005,\n', ""), "missing entries.*'timestep'"),
    "no steps": (lambda t: t.replace('"timestep": 0.005', '"timestep": 0'), "time step or number of steps"),
    "NaN": (lambda t: t.replace('"timestep": 0.005', '"timestep": NaN'), "timestep.*finite number, found nan"),
    "text for a number": (lambda t: t.replace('"timestep": 0.005', '"timestep": "x"'), "timestep.*finite number"),
    "half a step": (lambda t: t.replace('"steps": ', '"steps": 0.'), "steps: wrong type.*a whole number"),
    "unknown role": (lambda t: t.replace('"role": "robot"', '"role": "ghost"', 1), "role.*'robot'.*found 'ghost'"),
    "unknown entity": (lambda t: t.replace('"name": "left_finger"', '"name": "nobody"', 1), "left_finger"),
    "short vector": (
        lambda t: t.replace('"normal": [', '"normal": [[], ', 1),
        "normal: wrong length.*expected 3, found 4",
    ),
    "settings": (
        lambda t: t.replace('"min_touch_share": 0.5', '"min_touch_share": 7'),
        "min_touch_share is out of bounds; expected above 0 and at most 1, found 7",
    ),
    "beyond the end": (lambda t: t.replace('"steps": 7', '"steps": 1', 1), "times that cannot be"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_gives_one_clear_sentence(saved: Path, case: str):
    spoil, message = BROKEN[case]
    before = saved.read_text()
    saved.write_text(spoil(before))
    assert saved.read_text() != before
    with pytest.raises(EventsError, match=message) as caught:
        ContactEventSequence.load(saved)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path):
    with pytest.raises(EventsError, match=r"nowhere\.json"):
        ContactEventSequence.load(tmp_path / "nowhere.json")


def test_stages_that_do_not_join_are_refused(insertion: ContactEventSequence, tmp_path: Path):
    first, *rest = insertion.stages
    replace(insertion, stages=(replace(first, end=first.end - 0.1), *rest)).save(tmp_path / "gap.json")
    with pytest.raises(EventsError, match="'pick' does not end where the next one starts"):
        ContactEventSequence.load(tmp_path / "gap.json")
