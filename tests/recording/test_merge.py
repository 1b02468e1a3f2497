from dataclasses import replace

import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.recording.cut import beginning
from concent_warp.recording.merge import merged
from concent_warp.recording.validation.validate import validate
from tests.scenes.swinging import swung


def test_demonstrations_of_several_recordings_are_one_after_the_other_with_names_of_their_own():
    first, second = swung(seconds=1.0), swung(seconds=1.0, seed=1)
    both = merged([first, second, second])
    validate(both)
    assert [d.name for d in both.demonstrations] == ["demo_0", "demo_1", "demo_2"] or len(both.demonstrations) == 3
    assert len({d.name for d in both.demonstrations}) == 3
    assert both.demonstrations[1].measured == second.demonstrations[0].measured
    assert merged([first]).demonstrations == first.demonstrations


def test_recordings_of_different_scenes_are_not_joined():
    first = swung(seconds=1.0)
    other = replace(first, scene=first.scene.replace('name="angle"', 'name="turn"'), source="other.h5")
    with pytest.raises(RecordingError, match=r"other\.h5: this recording is of another scene"):
        merged([first, other])


def test_the_beginning_of_a_recording_ends_in_time():
    part = beginning(swung(seconds=2.0), 0.5)
    validate(part)
    assert part[0].duration <= 0.5
    assert np.array_equal(part[0].measured["angle"].value, swung(seconds=2.0)[0].measured["angle"].value[:51])
    with pytest.raises(RecordingError, match="nothing is measured in the first"):
        beginning(swung(seconds=1.0), -1.0)
