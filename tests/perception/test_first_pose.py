from __future__ import annotations

import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.perception.tracking.first_pose import read_first_poses


def test_toml_and_json_give_the_same_poses(tmp_path):
    (tmp_path / "a.toml").write_text("[block]\nposition = [0.4, 0, 0.02]\nquaternion = [0, 0, 0, 1]\n")
    (tmp_path / "a.json").write_text('{"block": {"position": [0.4, 0, 0.02], "quaternion": [0, 0, 0, 1]}}')
    first, second = (read_first_poses(tmp_path / name)["block"] for name in ("a.toml", "a.json"))
    np.testing.assert_array_equal(first, second)
    np.testing.assert_allclose(first[:3, :3], np.diag([-1, -1, 1]), atol=1e-12)
    np.testing.assert_allclose(first[:3, 3], [0.4, 0, 0.02])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "names no body"),
        ("[block]\nposition = [0, 0, 0]\n", "quaternion is not right"),
        ("[block]\nposition = [0, 0, 'x']\nquaternion = [1, 0, 0, 0]\n", "position is not right"),
        ("[block]\nposition = [0, 0, 0]\nquaternion = [2, 0, 0, 0]\n", "not of unit length"),
        ("block = 3\n", "position is not right"),
    ],
)
def test_what_is_no_pose_is_refused(tmp_path, text, message):
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(RecordingError, match=message):
        read_first_poses(tmp_path / "a.toml")
