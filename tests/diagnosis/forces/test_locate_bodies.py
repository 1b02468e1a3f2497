import numpy as np
import pytest

from concent_warp.comparison.phases import FREE, REST, SLIDE
from concent_warp.diagnosis.forces.body_forces import _body_records
from concent_warp.diagnosis.forces.cfg import LocateForcesCfg
from concent_warp.diagnosis.forces.contact_state import _free_motions, _lasting_share
from concent_warp.diagnosis.forces.describe import _direction_words
from concent_warp.diagnosis.forces.point_of_action import _face_words, _lever
from concent_warp.diagnosis.forces.window_forces import window_forces
from concent_warp.estimation.state_estimator import StateEstimator, StateEstimatorCfg
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.simulate.mujoco_engine import MujocoEngine
from tests.diagnosis.forces.locate_scenes import throw


def parts(recording):
    model = Model(Scene(recording.scene))
    engine = MujocoEngine(model, threads=1)
    motions = [
        StateEstimator.of(model, d, StateEstimatorCfg("smoothing_spline"), engine=engine)
        for d in recording.demonstrations
    ]
    pairs = zip(recording.demonstrations, motions, strict=True)
    windows = [window_forces(d.name, engine, motion, LocateForcesCfg(extra_starts=0)) for d, motion in pairs]
    return _body_records("block", motions, windows, LocateForcesCfg())


def test_a_thrown_block_slides_and_then_rests_on_the_table():
    part = parts(throw(count=1, duration=0.7))[0]
    assert set(part.phase) <= {SLIDE, REST, "impact"}
    slides = np.flatnonzero(part.state.phase == SLIDE)
    rests = np.flatnonzero(part.state.phase == REST)
    assert len(slides)
    assert len(rests)
    assert slides.max() < rests.min()
    heading = part.state.heading[slides]
    assert heading[:, 0] == pytest.approx(np.ones(len(slides)), abs=0.2)
    assert part.state.touches[rests[0]]["world"].normal == pytest.approx([0, 0, 1], abs=0.02)
    assert part.state.touches[rests[0]]["world"].point[2] == pytest.approx(-0.02, abs=1e-3)


def test_a_block_on_a_table_may_slide_and_turn_but_not_tilt_or_sink():
    part = parts(throw(count=1, duration=0.7))[0]
    k = int(np.flatnonzero(part.state.phase == REST)[0])
    assert np.trace(part.state.free[k]) == pytest.approx(3)
    assert np.diag(part.state.free[k]) == pytest.approx([1, 1, 0, 0, 0, 1], abs=0.02)


def test_a_flying_block_is_free():
    part = parts(throw(fly=True, count=1))[0]
    assert set(part.state.phase) == {FREE}
    assert part.state.free == pytest.approx(np.tile(np.eye(6), (len(part.state.free), 1, 1)))


def test_motions_along_a_contact_normal_are_not_free():
    push = np.array([[0, 0, 1.0, 0, 0, 0]])
    assert np.diag(_free_motions(push, 1, 0.05)) == pytest.approx([1, 1, 0, 1, 1, 1])


def test_short_interruptions_count_as_contact():
    assert _lasting_share(np.array([0, 1, 2, 6, 7, 8, 9]), 10, longest_gap=3) == 1
    assert _lasting_share(np.array([0, 1, 2, 6, 7, 8, 9]), 10, longest_gap=2) == pytest.approx(0.7)


def test_a_force_turns_about_the_origin_by_its_lever():
    rng = np.random.default_rng(0)
    force, point = rng.standard_normal(3), rng.standard_normal(3)
    assert _lever(force, np.eye(3)) @ point == pytest.approx(np.cross(point, force))


@pytest.mark.parametrize(
    ("place", "normal", "hidden", "words"),
    [
        ((1, 0.1, -0.9), (1, 0, 0), (), "+x face, near its -z edge"),
        ((1, 0.1, -0.9), (1, 0, 0), ("z",), "+x face"),
        ((0.8, -0.9, 1), (0, 0.1, 1), (), "+z face, near its +x -y corner"),
        ((0.5, 0.5, 0.5), (1, 1, 1), (), "its surface"),
    ],
)
def test_places_on_faces_are_named(place, normal, hidden, words):
    assert _face_words(np.array(place, float), np.array(normal, float), hidden, 0.75) == words


def test_directions_are_named_by_their_axes():
    assert _direction_words(np.array([-2.0, 0.1, 0]), "world") == "along -x"
    assert _direction_words(np.array([0.5, 0, -1.0]), "block") == "along -z +x of block"
    assert _direction_words(np.array([-1.0, 0, 0]), "sliding") == "against its sliding"
