from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from concent_warp.events.schedule import _label_levels, plot_schedule, schedule_rows
from concent_warp.events.sequence import ContactEventSequence


def test_rows_are_pairs_by_kind_then_by_time(insertion: ContactEventSequence):
    assert schedule_rows(insertion) == [
        ("left_finger", "block"),
        ("right_finger", "block"),
        ("block", "box"),
        ("block", "world"),
    ]


def test_the_plot_shows_bars_stages_and_target_events(insertion: ContactEventSequence):
    axes = plot_schedule(insertion, title="one").axes[0]
    labels = [tick.get_text() for tick in axes.get_yticklabels()]
    assert labels == ["left_finger · block", "right_finger · block", "block · box", "block · table"]
    texts = [text.get_text() for text in axes.texts]
    for stage in insertion.stages:
        assert stage.name in texts
        assert f"{stage.start:.2f} s" in texts
    diamonds = [np.asarray(line.get_xdata()) for line in axes.lines if line.get_marker() == "D"]
    assert [len(times) for times in diamonds] == [2, 3, 3]
    assert [times[0] for times in diamonds] == [stage.event.time for stage in insertion.stages]
    assert axes.get_title(loc="left") == "one"


@pytest.mark.parametrize(("suffix", "magic"), [("png", b"\x89PNG"), ("svg", b"<?xml")])
def test_pictures_are_written_in_one_piece(insertion: ContactEventSequence, tmp_path: Path, suffix: str, magic: bytes):
    path = tmp_path / f"schedule.{suffix}"
    plot_schedule(insertion, path)
    assert path.read_bytes().startswith(magic)
    assert list(tmp_path.iterdir()) == [path]


def test_a_sequence_without_contact_can_be_drawn(insertion: ContactEventSequence, tmp_path: Path):
    empty = replace(insertion, entities=(), body_contacts=(), contacts=(), stages=())
    plot_schedule(empty, tmp_path / "empty.png")
    assert (tmp_path / "empty.png").stat().st_size > 0


def test_labels_of_stages_close_in_time_are_set_above_one_another():
    assert _label_levels([0.0, 0.1, 0.2, 5.0], room=0.5) == [0, 1, 2, 0]
