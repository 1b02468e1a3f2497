"""The rules of the search between generations, on surveys and losses that are written down."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from concent_warp.errors import ModelError
from concent_warp.estimation.object_tracks import Segment, observed_states, whole_demonstration
from concent_warp.fit.fit_geometry import FitCfg
from concent_warp.fit.geometry import search as searching
from concent_warp.fit.geometry.evolution import EvolutionCfg
from concent_warp.fit.geometry.mask import robot_bodies, spheres_near
from concent_warp.fit.geometry.objective import Candidates, Losses, Objective
from concent_warp.fit.geometry.search import GeometrySearchCfg, Search, Survey, WarmStart
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, PointTrack
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry
from concent_warp.simulate.mujoco_engine import MujocoEngine
from tests.fit.conftest import HALF, corner_spheres
from tests.fit.geometry.test_geometry_search import HELD

CFG = GeometrySearchCfg(
    EvolutionCfg(population=6, length=0.015, flattening=0.0, max_sigma=1e-3), generations=3, held_out=0.2, block=0.05
)
EVERY, NONE = np.ones(8, dtype=bool), np.zeros(8, dtype=bool)


@pytest.fixture(scope="module")
def segment(drop, swollen) -> Segment:
    return whole_demonstration(swollen.scene, drop[0], ("block",))


class Written(Search):
    """A search whose surveys and losses are written down."""

    def __init__(self, model: Model, segments: list[Segment], cfg: GeometrySearchCfg, **told: Any) -> None:
        super().__init__(model, segments, cfg, "mujoco")
        self.surveys = list(told.get("surveys", ()))
        self.losses = told.get("losses", np.arange(float(cfg.evolution.population)))
        self.asked: list[Any] = []
        self.tried: list[Any] = []

    def survey(self, segments: list[Segment]) -> Survey:
        self.asked.append(list(segments))
        self.simulations += len(segments)
        loss, held_out = self.surveys.pop(0) if self.surveys else (6e-3, 5e-3)
        mask = self.model.geometry.position[:, 2] < 0  # pyright: ignore[reportOptionalMemberAccess]
        return Survey(mask, ~mask, loss, held_out)

    def prepared(self, needed: np.ndarray) -> Any:
        self.collidable = self.collidable | needed
        return "engine"

    def objective(self, engine: Any, segments: list[Segment]) -> Any:
        def losses(candidates: Candidates) -> Losses:
            self.tried.append((engine, segments, candidates))
            return Losses(np.array(self.losses), np.array(self.losses))

        return losses


def written(swollen: Model, segment: Segment, cfg: GeometrySearchCfg = CFG, **told: Any) -> Written:
    return Written(swollen, told.pop("segments", [segment]), cfg, **told)


def test_a_generation_surveys_samples_tries_and_moves_the_estimate(swollen, segment):
    search = written(swollen, segment, replace(CFG, evolution=replace(CFG.evolution, flat_start=False), jitter=0.0))
    search.step()
    assert search.asked == [[segment]]
    assert search.simulations == 1 + 6
    ((engine, segments, candidates),) = search.tried
    assert (engine, segments) == ("engine", [segment])
    assert search.evolution.sigma == pytest.approx(1e-3)
    assert search.evolution.generation == 1
    rng = np.random.default_rng(CFG.seed)
    again = written(swollen, segment, replace(CFG, evolution=replace(CFG.evolution, flat_start=False)))
    again.evolution.scale_to(6e-3)
    values = again.evolution.ask(swollen.geometry.position[:, 2] < 0, rng)
    np.testing.assert_array_equal(candidates.position, again.evolution.candidates(values).position)
    again.evolution.tell(values, np.arange(6.0), swollen.geometry.position[:, 2] < 0)
    np.testing.assert_array_equal(search.evolution.mean, again.evolution.mean)
    (entry,) = search.history
    assert entry == {
        "generation": 1, "loss": 6e-3, "held_out": 5e-3, "best": 5e-3, "candidates": 2.5, "sigma": 1e-3, "moving": 4,
        "collidable": 8, "simulations": 7, "seconds": search.seconds,
    }  # fmt: skip
    assert search.seconds > 0
    before = search.seconds
    search.step()
    assert search.seconds > before
    assert search.history[1]["sigma"] == pytest.approx(1e-3 * 0.975)
    assert search.history[1]["generation"] == 2


def test_an_entry_without_candidates_tells_the_estimate(swollen, segment):
    search = written(swollen, segment)
    search.best = 4e-3
    entry = search.entry(Survey(EVERY, NONE, 6e-3, 5e-3), 1e-3)
    assert (entry["best"], entry["candidates"], entry["moving"], entry["collidable"]) == (4e-3, 6e-3, 8, 0)
    assert search.entry(Survey(EVERY, NONE, 6e-3, 3e-3), 1e-3)["best"] == 3e-3
    assert search.entry(Survey(EVERY, NONE, 6e-3, 3e-3), 1e-3, 7.0)["best"] == 4e-3


@pytest.mark.parametrize(
    ("squared", "helped", "sigma"),
    [
        (False, None, 5e-4),
        (True, None, np.sqrt(3e-3) / 6),
        (False, False, 5e-4),
        (False, True, np.sqrt(2e-3 * 8e-3) / 6),
    ],
)
def test_the_first_step_is_as_long_as_the_distance_requires(swollen, segment, squared, helped, sigma):
    cfg = replace(CFG, squared=squared, evolution=replace(CFG.evolution, max_sigma=1.0))
    search = written(swollen, segment, cfg, surveys=[(3e-3, 3e-3)] * 3)
    if helped is not None:
        search.gradients = WarmStart(helped, search.evolution.mean, 2e-3, 8e-3, "", [])
    search.step()
    assert search.history[0]["sigma"] == pytest.approx(sigma)
    assert len(search.asked) == (1 if helped else 2)
    search.evolution.sigma = 0.5
    search.step()
    assert search.history[1]["sigma"] == pytest.approx(0.5 * 0.975)


def test_the_search_ends_after_all_generations_and_judges_the_last_estimate(swollen, segment):
    cfg = replace(CFG, evolution=replace(CFG.evolution, flat_start=False))
    search = written(swollen, segment, cfg, surveys=[(6e-3, 5e-3), (5e-3, 4e-3), (4e-3, 3e-3), (3e-3, 1e-3)])
    for _ in range(2):
        search.step()
        assert search.stopped is None
    search.step()
    assert search.stopped == "all 3 generations done"
    assert [h["best"] for h in search.history] == [5e-3, 4e-3, 1e-3]
    assert (search.best, search.lowest) == (1e-3, 3e-3)
    assert len(search.asked) == 4


def test_the_search_ends_where_nothing_is_gained_for_some_generations(swollen, segment):
    cfg = replace(CFG, generations=20, plateau_generations=2, evolution=replace(CFG.evolution, flat_start=False))
    search = written(swollen, segment, cfg)
    while search.stopped is None:
        search.step()
    assert len(search.history) == 3
    assert search.stopped == "error fell by less than 0.02 of itself in 2 generations"
    assert written(swollen, segment, replace(CFG, generations=0)).stopped == "no generations asked for"
    assert written(swollen, segment, replace(CFG, generations=1)).stopped is None


def test_a_gain_is_a_fall_below_a_share_of_either_distance_at_the_last_one(swollen, segment):
    search = written(swollen, segment, replace(CFG, min_gain=0.1))
    told = []
    for generation, (loss, held_out) in enumerate(
        [(1.0, 1.0), (0.91, 0.91), (0.89, 1.2), (0.81, 0.905), (0.9, 0.8), (0.9, 0.73), (0.7, 0.9)], start=1
    ):
        search.evolution.generation = generation
        search.evolution.mean = np.full_like(search.evolution.mean, generation)
        search.note(Survey(EVERY, EVERY, loss, held_out))
        told.append((search.last_gain, search.best_mean[0, 0], search.best, search.lowest))
    assert told == [
        (1, 1, 1.0, 1.0), (1, 2, 0.91, 0.91), (3, 2, 0.91, 0.89), (3, 4, 0.905, 0.81), (5, 5, 0.8, 0.81),
        (5, 6, 0.73, 0.81), (7, 6, 0.73, 0.7),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("loss", "held_out", "kept"),
    [(1.09, 1.09, True), (1.1, 1.1, True), (1.11, 1.0, False), (1.0, 1.11, False), (0.5, 0.5, True)],
)
def test_faces_are_flattened_unless_the_distance_rises_by_a_tenth(swollen, segment, loss, held_out, kept):
    cfg = replace(CFG, max_flattening_rise=0.10000001)
    rng = np.random.default_rng(0)
    rough = swollen.with_geometry(
        swollen.geometry.with_position(swollen.geometry.position + rng.normal(0, 1e-4, (8, 3)))
    )
    search = written(rough, segment, cfg, surveys=[(loss, held_out)])
    before = Survey(EVERY, EVERY, 1.0, 1.0)
    search.evolution.mean[:] = 1e-5
    found = search.flattened(before, [segment])
    assert search.asked == [[segment]]
    if kept:
        assert (found.loss, found.held_out) == (loss, held_out)
        assert search.evolution.faces is not None
        flat = searching.flattened(rough.geometry, search.evolution.faces)
        np.testing.assert_array_equal(search.evolution.mean[:, :3], flat.position - rough.geometry.position)
    else:
        assert found is before
        np.testing.assert_array_equal(search.evolution.mean, 1e-5)


def test_faces_stay_where_they_are_not_to_be_flattened(swollen, segment):
    before = Survey(EVERY, EVERY, 1.0, 1.0)
    for flat_start, flattening in ((False, 0.1), (False, 0.0)):
        cfg = replace(CFG, evolution=replace(CFG.evolution, flat_start=flat_start, flattening=flattening))
        search = written(swollen, segment, cfg)
        assert search.flattened(before, [segment]) is before
        assert (search.evolution.faces is None) == (flattening == 0.0)
        assert search.asked == []


def test_segments_are_sampled_without_replacement_from_those_that_are_not_held_out(swollen, segment):
    segments = [replace(segment, name=str(k), held_out=k == 2) for k in range(6)]
    search = written(swollen, segment, replace(CFG, batch=3), segments=segments)
    assert [s.name for s in search.used] == ["0", "1", "3", "4", "5"]
    assert [s.name for s in search.held_out] == ["2"]
    rng = np.random.default_rng(CFG.seed)
    for _ in range(4):
        rows = np.sort(rng.choice(5, 3, replace=False))
        assert search.sample_segments() == [search.used[k] for k in rows]
    assert written(swollen, segment, replace(CFG, batch=5), segments=segments).sample_segments() == search.used
    assert written(swollen, segment, replace(CFG, batch=4), segments=segments).sample_segments() != search.used
    assert written(swollen, segment, CFG, segments=segments).sample_segments() == search.used
    alone = written(swollen, segment, CFG, segments=[replace(segment, held_out=True)])
    assert alone.used == alone.held_out
    batch = written(
        swollen,
        segment,
        replace(CFG, batch=2, jitter=0.0, evolution=replace(CFG.evolution, flat_start=False)),
        segments=segments,
    )
    batch.step()
    assert [s.name for s in batch.asked[0]][-1] == "2"
    assert len(batch.asked[0]) == 3
    assert batch.simulations == 3 + 2 * 6


TWO = """<mujoco><worldbody>
  <body name="fixed"><joint type="slide"/><geom size="0.01"/></body>
  <body name="one" pos="0 0 0.1"><freejoint/><geom size="0.01"/></body>
  <body name="two" pos="0.1 0 0.1"><freejoint/><geom size="0.01"/></body>
</worldbody></mujoco>"""


def test_free_bodies_start_a_little_elsewhere():
    spheres = ContactGeometry(("one",), np.zeros(1, int), np.zeros((1, 3)), *(np.full(1, v) for v in (0.01, 0.1, 0.5)))
    model = Model(Scene(TWO), spheres)
    rng = np.random.default_rng(2)
    qpos = np.concatenate(
        [[0.3], *(np.append(rng.normal(size=3), Rotation.random(rng=rng).as_quat()) for _ in range(2))]
    )
    segments = [Segment(name, qpos.copy(), np.zeros(13), np.zeros((3, 0)), ()) for name in "ab"]
    cfg = replace(CFG, jitter=2e-3, jitter_turn=30.0, seed=4)
    search: Any = object.__new__(Search)
    search.cfg, search.model, search.rng = cfg, model, np.random.default_rng(4)
    found = search.jittered(segments)
    rng = np.random.default_rng(4)
    for before, after in zip(segments, found, strict=True):
        np.testing.assert_array_equal(before.qpos, qpos)
        assert (after.name, after.qpos[0]) == (before.name, 0.3)
        for address in (1, 8):
            step, turn = rng.normal(0, 2e-3, 2), rng.normal(0, 2e-3) * 30.0
            expected = qpos[address : address + 7].copy()
            expected[:2] += step
            np.testing.assert_allclose(after.qpos[address : address + 3], expected[:3], rtol=1e-12)
            turned = Rotation.from_rotvec([0, 0, turn]) * Rotation.from_quat(expected[3:], scalar_first=True)
            seen = Rotation.from_quat(after.qpos[address + 3 : address + 7], scalar_first=True)
            assert (turned.inv() * seen).magnitude() < 1e-7
    search.cfg = replace(cfg, jitter=0.0)
    assert search.jittered(segments) is segments


def test_progress_reports_the_time_left(swollen, segment):
    search = written(swollen, segment, replace(CFG, generations=10))
    search.history = [{"loss": 5.0}, {"loss": 2.0}]
    search.seconds, search.evolution.generation, search.best, search.simulations = 6.0, 4, 0.5, 77
    found = search.progress()
    assert (found.generation, found.generations, found.loss, found.best, found.simulations) == (4, 10, 2.0, 0.5, 77)
    assert found.seconds_left == pytest.approx(9.0)
    assert found.what == "generation"
    search.evolution.generation = 0
    assert search.progress().seconds_left == pytest.approx(60.0)


def test_the_result_is_the_best_estimate_and_what_has_moved(swollen, segment):
    search = written(swollen, segment)
    assert search.result().stopped == "interrupted"
    assert not search.result().mask.any()
    search.best_mean[3, 1] = 1e-3
    search.evolution.mean[5] = 2e-3
    search.stopped = "done"
    found = search.result()
    assert np.flatnonzero(found.mask).tolist() == [3]
    np.testing.assert_allclose(found.model.geometry.position - swollen.geometry.position, search.best_mean, atol=1e-15)
    assert (found.start, found.stopped, found.gradients) == (swollen, "done", None)


def test_a_search_goes_on_from_its_checkpoint(swollen, segment, tmp_path):
    from concent_warp.fit.geometry.checkpoint import Checkpoint

    first = written(swollen, segment, losses=np.array([3.0, 1.0, 2.0, 5.0, 4.0, 6.0]))
    first.step()
    first.frozen[2] = True
    first.checkpoint().save(tmp_path / "c.npz")
    other = written(swollen, segment, losses=first.losses)
    other.restore(Checkpoint.load(tmp_path / "c.npz"))
    for name in ("collidable", "frozen", "best_mean"):
        np.testing.assert_array_equal(getattr(other, name), getattr(first, name))
    for name in ("best", "lowest", "last_gain", "progress_from", "simulations", "seconds", "history", "stopped"):
        assert getattr(other, name) == getattr(first, name)
    assert (other.evolution.generation, other.evolution.sigma) == (1, first.evolution.sigma)
    first.step()
    other.step()
    np.testing.assert_array_equal(first.evolution.mean, other.evolution.mean)
    assert first.tried[-1][2].position.tolist() == other.tried[-1][2].position.tolist()
    with pytest.raises(ModelError, match="other settings"):
        written(swollen, segment, replace(CFG, generations=4)).restore(Checkpoint.load(tmp_path / "c.npz"))
    assert first.checkpoint().cfg == asdict(CFG)


def test_an_engine_is_made_anew_where_a_sphere_is_missing(swollen, segment, monkeypatch):
    made: list[Any] = []

    def make_engine(name: str, model: Model, *, collidable: np.ndarray) -> Any:
        assert model is swollen
        made.append((name, collidable.copy()))
        return object()

    monkeypatch.setattr(searching, "make_engine", make_engine)
    search = Search(swollen, [segment], CFG, "mujoco")
    needed = np.arange(8) < 3
    first = search.prepared(needed)
    assert search.prepared(np.arange(8) < 2) is first
    assert search.prepared(NONE) is first
    second = search.prepared(np.arange(8) == 6)
    assert second is not first
    assert [(name, np.flatnonzero(c).tolist()) for name, c in made] == [("mujoco", [0, 1, 2]), ("mujoco", [0, 1, 2, 6])]


@pytest.fixture(scope="module")
def pinched() -> tuple[Model, Segment]:
    """A block on the floor between a finger 0.2 mm beside it and a wall 3 mm away."""
    text = HELD.replace(
        "<worldbody>", f'<worldbody><geom name="wall" type="box" size="0.01 1 1" pos="{-HALF - 0.013} 0 0"/>'
    )
    scene = Scene(text)
    time = np.linspace(0, 0.1, 7)
    points = np.repeat((HALF * np.sign(corner_spheres(HALF).position) + [0, 0, HALF])[None], len(time), axis=0)
    track = PointTrack(time, points, np.ones(points.shape[:2], dtype=bool))
    m = scene.model
    demonstration = Demonstration(
        "demo_0", qpos=m.qpos0.copy(), qvel=np.zeros(m.nv), points={"block": track},
        action={"finger": Channel(np.zeros(1), np.zeros(1))},
    )  # fmt: skip
    return Model(scene, corner_spheres(HALF)), whole_demonstration(scene, demonstration, ("block",))


@pytest.mark.parametrize("freeze", [True, False])
def test_a_survey_tells_what_moves_what_is_near_and_what_is_grasped(pinched, freeze):
    model, segment = pinched
    cfg = replace(CFG, evolution=replace(CFG.evolution, neighbours=0, freeze_gripped=freeze), jitter=0.0)
    search = Search(model, [segment], cfg, "mujoco")
    found = search.survey([segment, segment])
    bottom, beside = model.geometry.position[:, 2] < 0, model.geometry.position[:, 0] > 0
    np.testing.assert_array_equal(found.mask, bottom & ~(beside & freeze))
    np.testing.assert_array_equal(search.frozen, beside & freeze)
    # Corners at the top are near the wall or the finger; all are within reach of something.
    assert found.reachable.all()
    assert search.simulations == 2
    objective = Objective(MujocoEngine(model), [segment] * 2, held_out=0.2, block=0.05)
    losses = objective(Candidates(model.geometry.position[None]))
    assert (found.loss, found.held_out) == (losses.fit[0], losses.held_out[0])
    far = Search(model, [segment], replace(cfg, reach=1e-3), "mujoco").survey([segment])
    np.testing.assert_array_equal(far.reachable, bottom | beside)


def test_states_that_a_survey_looks_at_are_simulated_and_observed(pinched, monkeypatch):
    model, segment = pinched
    seen: list[Any] = []

    def near(current: Model, states: np.ndarray, reach: float) -> np.ndarray:
        seen.append((states, reach))
        return spheres_near(current, states, reach)

    monkeypatch.setattr(searching, "spheres_near", near)
    search = Search(model, [segment], replace(CFG, jitter=0.0, reach=0.005, grip_distance=2e-3), "mujoco")
    search.survey([segment])
    (grip, grip_distance), (both, reach) = seen
    assert (grip_distance, reach) == (2e-3, 0.005)
    assert len(both) == 2 * len(grip)
    np.testing.assert_array_equal(both[len(grip) :], grip)
    objective = Objective(MujocoEngine(model), [segment], held_out=0.2, block=0.05)
    rollout = objective.simulate(Candidates(model.geometry.position[None])).numpy()
    np.testing.assert_array_equal(both[: len(grip)], rollout.qpos[0, ::2])
    expected = observed_states(model.scene.model, segment, rollout.time[::2], rollout.qpos[0, ::2])
    np.testing.assert_array_equal(grip, expected)


def test_the_robot_and_what_is_welded_to_the_world_are_known(pinched):
    model, segment = pinched
    search = Search(model, [segment], CFG, "mujoco")
    np.testing.assert_array_equal(search.robot, robot_bodies(model.scene.model))
    assert search.robot.tolist() == [False, False, True]
    assert search.movable.all()
    fixed = Scene(HELD.replace("<freejoint/>", ""))
    welded = Search(Model(fixed, corner_spheres(HALF)), [segment], CFG, "mujoco")
    assert not welded.movable.any()
    assert np.isinf([search.best, search.lowest, *search.progress_from]).all()
    assert (search.last_gain, search.simulations, search.seconds) == (0, 0, 0.0)
    assert isinstance(FitCfg(), GeometrySearchCfg)


DRIVEN = """<mujoco><worldbody>
  <body name="a"><joint name="a" type="slide"/><geom size=".1"/>
    <body name="a2"><geom size=".1"/></body></body>
  <body name="b"><joint name="b" type="slide"/><joint name="b2" type="hinge"/><geom size=".1"/></body>
  <body name="c"><joint name="c" type="slide"/><geom size=".1"/></body>
  <body name="d"><joint name="d" type="slide"/><geom size=".1"/></body>
  <body name="e"><joint name="e" type="slide"/><geom size=".1"/></body>
  <body name="f"><joint name="f" type="slide"/><geom size=".1"/><site name="spot"/></body>
  <body name="g"><joint name="g" type="slide"/><geom size=".1"/></body>
  </worldbody>
  <tendon><fixed name="first"><joint joint="d" coef="1"/></fixed>
    <fixed name="pull"><joint joint="b2" coef="1"/><joint joint="c" coef="1"/></fixed></tendon>
  <equality><joint joint1="e"/><joint joint1="g" joint2="a"/><weld body1="f" body2="d"/></equality>
  <actuator><position joint="a"/><position tendon="pull"/><motor site="spot"/></actuator></mujoco>"""


def test_bodies_are_driven_by_joints_tendons_and_equalities_and_carry_others():
    m = mujoco.MjModel.from_xml_string(DRIVEN)
    driven = {m.body(k).name for k in np.flatnonzero(robot_bodies(m))}
    assert driven == {"a", "a2", "b", "c", "g"}
    parent = mujoco.MjModel.from_xml_string(DRIVEN.replace('<position joint="a"/>', '<motor jointinparent="e"/>'))
    assert {parent.body(k).name for k in np.flatnonzero(robot_bodies(parent))} == {"b", "c", "e"}
