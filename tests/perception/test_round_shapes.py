"""What is done about turns that a shape's symmetry makes alike, where the texture does not confirm them."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.perception.tracking.alignment.search import _Search
from concent_warp.perception.tracking.body_tracker import BodyTracker
from concent_warp.perception.tracking.cfg import TrackCfg
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.symmetry import symmetry_of
from concent_warp.scene.scene import Scene

SCENE = """<mujoco><worldbody>
  <body name="cylinder"><freejoint/><geom type="cylinder" size=".03 .05"/></body>
  <body name="box"><freejoint/><geom type="box" size=".03 .03 .03"/></body>
</worldbody></mujoco>"""


def tracker_of(body: str) -> BodyTracker:
    cfg = TrackCfg()
    shape = TrackedShape.of_body(Scene(SCENE), body, 0)
    return BodyTracker(shape, symmetry_of(shape, cfg.symmetry_tolerance), cfg)


@pytest.mark.parametrize(("body", "kept"), [("cylinder", True), ("box", False)])
def test_an_unconfirmed_turn_is_kept_of_a_round_shape_and_refused_of_others(monkeypatch, body, kept):
    tracker = tracker_of(body)
    turned: Any = SimpleNamespace(pose=np.eye(4))
    turned.pose[:2, :2] = [[0, -1], [1, 0]]
    monkeypatch.setattr(tracker, "accepted", lambda *_, **__: None)
    renderer: Any = None
    found = tracker.same_representative(renderer, [], turned, np.eye(4))
    assert (found is turned) == kept
    assert (found is None) != kept


def test_a_search_of_whose_poses_none_settles_says_why(monkeypatch):
    agreed = SimpleNamespace(text=lambda: "nothing agrees")
    tried: Any = SimpleNamespace(fit=SimpleNamespace(pose=np.eye(4)), agreed=agreed, score=0.1)
    empty: Any = SimpleNamespace(clusters=[])
    nothing: Any = None
    tracker = tracker_of("box")
    rng, points = np.random.default_rng(0), np.zeros((0, 3))
    search = _Search(nothing, nothing, tracker.shape, tracker.symmetry, TrackCfg(), rng, None, empty, [], points)
    for name, result in (("_refined", [tried]), ("_settled", []), ("_accepted", []), ("_best", [])):
        monkeypatch.setattr(_Search, name, lambda *_, result=result: result)
    monkeypatch.setattr(_Search, "_rivals", lambda *_: ([], []))
    monkeypatch.setattr(_Search, "_distinct", lambda *_: [])
    found = search.outcome()
    assert found.fit is None
    assert "nothing agrees" in found.reason
