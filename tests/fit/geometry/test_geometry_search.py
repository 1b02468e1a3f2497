"""What moves the estimate of a fit and what must not: grasped spheres, held-out frames, and which iterate is kept."""

from dataclasses import replace

import numpy as np
import pytest

from concent_warp.estimation.object_tracks import whole_demonstration
from concent_warp.fit.fit_geometry import FitCfg
from concent_warp.fit.geometry.evolution import EvolutionCfg
from concent_warp.fit.geometry.objective import Candidates, Objective
from concent_warp.fit.geometry.search import Search, Survey
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, PointTrack, Recording
from concent_warp.scene.scene import Scene
from concent_warp.simulate.mujoco_engine import MujocoEngine
from tests.fit.conftest import HALF, corner_spheres

CFG = FitCfg(
    evolution=EvolutionCfg(
        population=8, antithetic=False, length=0.015, neighbours=0, sigma=5e-4, flat_start=False, flattening=0.0
    ),
    generations=2,
    held_out=0.3,
    block=0.05,
    jitter=0.0,
)
HELD = f"""
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <body name="block" pos="0 0 {HALF}">
      <freejoint/>
      <geom name="block" type="box" size="{HALF} {HALF} {HALF}" mass="0.08"/>
    </body>
    <body name="finger" pos="{HALF + 0.0052} 0 {HALF}">
      <joint name="finger" type="slide" axis="1 0 0"/>
      <geom name="finger" type="box" size="0.005 {HALF} {HALF}" mass="0.1"/>
    </body>
  </worldbody>
  <actuator><position name="finger" joint="finger" kp="500" kv="20"/></actuator>
</mujoco>
"""
"""A block on the floor, and a driven finger 0.2 mm beside it."""


@pytest.fixture(scope="module")
def beside_finger() -> tuple[Model, Recording]:
    """A block that stands still beside a finger."""
    scene = Scene(HELD)
    time = np.linspace(0, 0.3, 19)
    points = np.repeat((HALF * np.sign(corner_spheres(HALF).position) + [0, 0, HALF])[None], len(time), axis=0)
    track = PointTrack(time, points, np.ones(points.shape[:2], dtype=bool))
    model = scene.model
    action = {"finger": Channel(np.zeros(1), np.zeros(1))}
    demonstration = Demonstration(
        "demo_0", qpos=model.qpos0.copy(), qvel=np.zeros(model.nv), points={"block": track}, action=action
    )
    return Model(scene, corner_spheres(HALF)), Recording(HELD, (demonstration,))


def estimate_after(model: Model, recording: Recording, cfg: FitCfg = CFG) -> np.ndarray:
    """Return the estimate of a fit after two generations, not the best one."""
    search = Search(model, [whole_demonstration(model.scene, recording[0], ("block",))], cfg, "mujoco")
    for _ in range(2):
        search.step()
    return search.evolution.mean


def moved_spheres(case: tuple[Model, Recording], freeze: bool) -> np.ndarray:
    """Return which spheres have moved, of those at the bottom: beside the finger, and away from it."""
    model, recording = case
    cfg = replace(CFG, evolution=replace(CFG.evolution, freeze_gripped=freeze))
    moved = (estimate_after(model, recording, cfg) != 0).any(axis=1)
    bottom, near = model.geometry.position[:, 2] < 0, model.geometry.position[:, 0] > 0
    assert not moved[~bottom].any()
    return np.array([moved[bottom & near].all(), moved[bottom & ~near].all()])


def test_grasped_spheres_stay_where_they_are(beside_finger):
    assert moved_spheres(beside_finger, freeze=True).tolist() == [False, True]
    assert moved_spheres(beside_finger, freeze=False).tolist() == [True, True]


def shifted(recording: Recording, model: Model, held_out: bool) -> Recording:
    """Return a recording whose points are 3 mm higher in the held-out frames, or in the others."""
    target = whole_demonstration(model.scene, recording[0], ("block",)).targets[0]
    out = target.held_out(CFG.held_out, CFG.block)
    assert 3 <= out.sum() <= len(out) - 3
    track = recording[0].points["block"]
    rows = np.isin(track.time, target.time[out if held_out else ~out]) & (track.time > 0)  # the first tells the shape
    value = track.value + np.where(rows[:, None, None], [0.0, 0.0, 0.003], 0.0)
    points = {"block": replace(track, value=value)}
    return replace(recording, demonstrations=(replace(recording[0], points=points),))


def losses_of(model: Model, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return the losses over fitted and held-out frames of two candidates."""
    segments = [whole_demonstration(model.scene, recording[0], ("block",))]
    objective = Objective(MujocoEngine(model), segments, held_out=CFG.held_out, block=CFG.block)
    found = objective(Candidates(np.stack([corner_spheres(h).position for h in (HALF, HALF + 0.002)])))
    return found.fit, found.held_out


def test_each_loss_depends_on_its_own_frames_alone(drop, swollen):
    fit, held = losses_of(swollen, drop)
    other_fit, other_held = losses_of(swollen, shifted(drop, swollen, held_out=True))
    np.testing.assert_array_equal(fit, other_fit)
    assert (np.abs(held - other_held) > 5e-4).all()
    other_fit, other_held = losses_of(swollen, shifted(drop, swollen, held_out=False))
    np.testing.assert_array_equal(held, other_held)
    assert (np.abs(fit - other_fit) > 5e-4).all()


def test_held_out_frames_do_not_move_the_estimate(drop, swollen):
    mean = estimate_after(swollen, drop)
    assert np.abs(mean).max() > 1e-4
    np.testing.assert_array_equal(estimate_after(swollen, shifted(drop, swollen, held_out=True)), mean)
    assert not np.array_equal(estimate_after(swollen, shifted(drop, swollen, held_out=False)), mean)


def test_held_out_segments_are_simulated_and_never_sampled(drop, swollen):
    segment = whole_demonstration(swollen.scene, drop[0], ("block",))
    segments = [replace(segment, held_out=False), replace(segment, held_out=True), replace(segment, held_out=False)]
    search = Search(swollen, segments, CFG, "mujoco")
    assert search.sample_segments() == [segments[0], segments[2]]
    assert search.held_out == [segments[1]]
    search = Search(swollen, segments, replace(CFG, batch=1), "mujoco")
    sampled = [search.sample_segments() for _ in range(12)]
    assert all(len(one) == 1 and one[0] is not segments[1] for one in sampled)
    assert len({id(one[0]) for one in sampled}) == 2


def test_the_estimate_with_the_lowest_held_out_loss_is_kept(drop, swollen):
    search = Search(swollen, [whole_demonstration(swollen.scene, drop[0], ("block",))], CFG, "mujoco")
    every = np.ones(len(swollen.geometry), dtype=bool)

    def note(number: float, loss: float, held_out: float) -> None:
        search.evolution.mean = np.full_like(search.evolution.mean, number)
        search.note(Survey(every, every, loss, held_out))

    note(1e-3, 0.5, 0.9)
    note(2e-3, 0.6, 0.7)
    note(3e-3, 0.1, 0.8)
    assert search.best == 0.7
    np.testing.assert_array_equal(search.best_mean, 2e-3)
    found = search.result()
    np.testing.assert_allclose(found.model.geometry.position, swollen.geometry.position + 2e-3)
    assert found.mask.all()
