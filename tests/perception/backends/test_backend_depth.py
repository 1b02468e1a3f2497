from __future__ import annotations

import numpy as np
import pytest

import concent_warp as cw

SIZE = (96, 128)
TABLE = np.full(SIZE, 1.0)


def scene(count: int = 8, *, hand: range = range(0)) -> cw.CameraFrames:
    """Return frames of a block of 20 x 20 px that moves to the right in front of a table, and of a hand before it."""
    depth = np.full((count, *SIZE), 1.0, np.float32)
    for k in range(count):
        depth[k, 40:60, 30 + 3 * k : 50 + 3 * k] = 0.9
        if k in hand:
            depth[k, 20:80, 42 + 3 * k : 80 + 3 * k] = 0.7
    return cw.CameraFrames(np.zeros((count, *SIZE, 3), np.uint8), depth, lambda _: TABLE)


def block(frame: int) -> np.ndarray:
    mask = np.zeros(SIZE, dtype=bool)
    mask[40:60, 30 + 3 * frame : 50 + 3 * frame] = True
    return mask


def overlap(found: np.ndarray, true: np.ndarray) -> float:
    return (found & true).sum() / max((found | true).sum(), 1)


@pytest.mark.parametrize("frame", [0, 4, 7])
def test_an_object_is_followed_both_ways_from_its_prompt(frame):
    prompt = cw.MaskPrompt(frame, points=np.array([[40.0 + 3 * frame, 50.0]]))
    masks = cw.DepthMasker().masks(scene(), {"block": prompt})["block"]
    for k in range(8):
        assert overlap(masks[k], block(k)) > 0.9


def test_a_box_prompts_what_lies_mostly_in_it():
    masks = cw.DepthMasker().masks(scene(), {"block": cw.MaskPrompt(0, box=np.array([28.0, 38.0, 52.0, 62.0]))})[
        "block"
    ]
    assert overlap(masks[5], block(5)) > 0.9


def test_what_covers_an_object_is_not_in_its_mask_and_the_whole_returns():
    frames = scene(hand=range(3, 6))
    masks = cw.DepthMasker().masks(frames, {"block": cw.MaskPrompt(0, points=np.array([[40.0, 50.0]]))})["block"]
    for k in range(3, 6):
        uncovered = block(k) & (frames.depth[k] > 0.8)
        assert overlap(masks[k], uncovered) > 0.85
        assert not masks[k][frames.depth[k] < 0.8].any()
    assert overlap(masks[6], block(6)) > 0.9


def test_an_object_that_is_not_seen_has_an_empty_mask_and_is_found_again():
    frames = scene()
    frames.depth[3, 40:60] = 1.0
    masks = cw.DepthMasker().masks(frames, {"block": cw.MaskPrompt(0, points=np.array([[40.0, 50.0]]))})["block"]
    assert not masks[3].any()
    assert overlap(masks[4], block(4)) > 0.9


def test_a_prompt_on_the_table_or_with_a_pixel_outside_selects_nothing():
    outside = cw.MaskPrompt(0, np.array([[40.0, 50.0]]), outside=np.array([[45.0, 55.0]]))
    masks = cw.DepthMasker().masks(scene(), {"table": cw.MaskPrompt(0, np.array([[10.0, 10.0]])), "none": outside})
    assert not masks["table"].any()
    assert not masks["none"].any()
