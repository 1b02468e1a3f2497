from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.perception.tracking.prompts import given_prompts, written_prompts
from tests.perception.drawn_blocks import camera, drawn


@pytest.fixture(scope="module")
def film():
    return drawn(2)


def pixel(places, name: str) -> tuple[float, float]:
    """Return the column and row at which a block's middle is seen in the first frame [px]."""
    column, row = camera().project(places[name][0])[0]
    return float(column), float(row)


def off(found: cw.Tracked, body: str, place: np.ndarray) -> float:
    """Return how far a track begins from a place [m]."""
    return float(np.linalg.norm(found.track(body).pose[0, :3, 3] - place[0]))


def test_without_a_prompt_one_of_two_equal_blocks_is_refused_as_ambiguous(film):
    with pytest.raises(cw.RecordingError, match="two poses"):
        cw.track(film[0], bodies=["left"], pose="none")


@pytest.mark.parametrize("which", ["left", "right"])
def test_a_click_decides_which_of_two_equal_blocks_it_is(film, which):
    recording, places = film
    found = cw.track(recording, bodies=["left"], prompts={"left": {"click": pixel(places, which)}})
    assert off(found, "left", places[which]) < 1e-3


def test_a_box_decides_and_the_other_block_is_what_remains(film):
    recording, places = film
    column, row = pixel(places, "right")
    found = cw.track(recording, prompts={"left": {"box": (column - 25, row - 25, column + 25, row + 25)}})
    assert off(found, "left", places["right"]) < 1e-3
    assert off(found, "right", places["left"]) < 1e-3


def test_a_click_beside_all_blocks_finds_nothing_and_says_where(film):
    with pytest.raises(cw.RecordingError, match="nothing unknown of its size is seen at the click at 80, 10"):
        cw.track(film[0], bodies=["left"], prompts={"left": {"click": (80, 10)}})


def test_a_file_has_prompts_for_all_or_single_demonstrations(film, tmp_path):
    recording, places = film
    left, right = pixel(places, "left"), pixel(places, "right")
    path = tmp_path / "prompts.toml"
    path.write_text(f"[left]\nclick = {list(left)}\n[demo_0.left]\nclick = {list(right)}\ncamera = 'camera'\n")
    found = cw.track(recording, bodies=["left"], prompts=path)
    assert off(found, "left", places["right"]) < 1e-3


def test_prompts_are_written_on_the_command_line():
    found = written_prompts(["block=312,240@front", "lid=1.5,2"], ["cup=1,2,30,40"])
    assert found == {
        "block": {"click": [312, 240], "camera": "front"},
        "lid": {"click": [1.5, 2]},
        "cup": {"box": [1, 2, 30, 40]},
    }


@pytest.mark.parametrize("text", ["block", "block=", "block=1", "block=1,2,3", "=1,2", "block=a,b", "block=1,2@"])
def test_what_is_no_click_is_refused(text):
    with pytest.raises(cw.RecordingError, match=r"--click is not right.*BODY=COLUMN,ROW"):
        written_prompts([text], [])


def test_a_body_has_one_prompt():
    with pytest.raises(cw.RecordingError, match="two prompts"):
        written_prompts(["block=1,2"], ["block=1,2,3,4"])


@pytest.mark.parametrize(
    ("prompts", "options", "message"),
    [
        ({"left": {"click": (160, 10)}}, {}, r"outside the image.*columns 0 to 159, rows 0 to 119.*160, 10"),
        ({"left": {"box": (30, 20, 20, 40)}}, {}, "without area"),
        ({"left": {"click": (1, 2, 3)}}, {}, "click is not right"),
        ({"left": {"click": (1, 2), "box": (1, 2, 3, 4)}}, {}, "a prompt is not right"),
        ({"left": {"click": (1, 2), "eye": "camera"}}, {}, "a prompt is not right.*eye"),
        ({"left": {"click": (1, 2), "camera": "front"}}, {}, r"no camera of the video.*camera.*front"),
        ({"lid": {"click": (1, 2)}}, {}, "not tracked"),
        ({"demo_7": {"left": {"click": (1, 2)}}}, {}, r"nothing that is tracked.*demo_7"),
        ({"left": {"click": (1, 2)}}, {"pose": {"left": np.eye(4)}}, "a first pose and a prompt"),
        ("gone.toml", {}, "gone.toml"),
    ],
)
def test_wrong_prompts_are_refused_in_one_sentence(film, prompts, options, message):
    with pytest.raises(cw.RecordingError, match=message):
        cw.track(film[0], prompts=prompts, **options)


def test_a_prompt_names_its_camera_where_there_are_several(film):
    recording, _ = film
    stream = recording[0].image["camera"]
    several = replace(recording[0], image={"camera": stream, "second": stream})
    with pytest.raises(cw.RecordingError, match="no camera of several"):
        cw.track(replace(recording, demonstrations=(several,)), prompts={"left": {"click": (1, 2)}})


def test_a_file_without_tables_is_refused(tmp_path):
    path = tmp_path / "prompts.toml"
    path.write_text("click = [1, 2]\n")
    with pytest.raises(cw.RecordingError, match="prompts are not right"):
        given_prompts(path)
