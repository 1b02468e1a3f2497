import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from concent_warp.errors import ModelError, RecordingError
from concent_warp.fit.fit_geometry import FitCfg, cut_segments, fit_geometry
from concent_warp.fit.geometry.checkpoint import Checkpoint
from concent_warp.fit.geometry.evolution import EvolutionCfg
from concent_warp.fit.geometry.search import FitResult, Progress, Search, Survey
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.scene.spheres.disturb import disturb
from tests.fit.conftest import DROP, HALF, RADIUS, corner_spheres, dropped

CFG = FitCfg(
    evolution=EvolutionCfg(population=12, length=0.015, neighbours=2), generations=14, held_out=0.2, block=0.05
)


@pytest.fixture(scope="module")
def fitted(drop, swollen) -> FitResult:
    return fit_geometry(swollen, drop, CFG, engine="mujoco")


def test_a_swollen_block_shrinks_to_the_size_that_explains_its_rest_height(fitted):
    bottom = fitted.model.geometry.position[:, 2] < 0
    depth = fitted.model.geometry.position[bottom, 2].mean() - RADIUS
    assert depth == pytest.approx(-HALF, abs=7e-4)
    assert fitted.history[-1]["best"] < 0.4 * fitted.history[0]["held_out"]


def test_without_neighbours_only_touched_spheres_move(drop, swollen):
    cfg = replace(CFG, evolution=replace(CFG.evolution, neighbours=0), generations=4)
    result = fit_geometry(swollen, drop, cfg, engine="mujoco")
    np.testing.assert_array_equal(result.mask, swollen.geometry.position[:, 2] < 0)


def test_the_estimate_of_the_last_generation_counts(drop, swollen):
    result = fit_geometry(swollen, drop, replace(CFG, generations=1), engine="mujoco")
    assert result.mask.any()
    assert result.history[-1]["best"] < result.history[-1]["held_out"]


@pytest.fixture(scope="module")
def rough() -> Model:
    """A model of the block whose spheres are off by 1 mm each."""
    scene = Scene(DROP)
    geometry = ContactGeometryCfg(count=80).build(scene)
    return Model(scene, disturb(geometry, position_std=1e-3, rng=np.random.default_rng(2)))


def bottom_roughness(model: Model) -> float:
    lowest = model.geometry.position[:, 2] < -0.0135
    return float(model.geometry.position[lowest, 2].std())


def test_rough_faces_are_flat_before_the_first_generation(drop, rough):
    cfg = replace(CFG, evolution=replace(CFG.evolution, sigma=1e-9), generations=1)
    result = fit_geometry(rough, drop, cfg, engine="mujoco")
    assert bottom_roughness(result.model) < 0.6 * bottom_roughness(rough)
    as_is = replace(cfg, evolution=replace(cfg.evolution, flat_start=False, flattening=0.0))
    kept = fit_geometry(rough, drop, as_is, engine="mujoco")
    np.testing.assert_allclose(kept.model.geometry.position, rough.geometry.position, atol=1e-7)


def test_faces_that_were_observed_to_be_rough_stay_rough(rough):
    seen = dropped(rough.spec().compile())
    cfg = replace(CFG, evolution=replace(CFG.evolution, sigma=1e-9, flattening=0.0), generations=1)
    result = fit_geometry(rough, seen, cfg, engine="mujoco")
    assert bottom_roughness(result.model) == pytest.approx(bottom_roughness(rough), rel=1e-6)


def test_an_interrupted_fit_resumes_to_the_same_result(drop, swollen, fitted, tmp_path):
    def kill(progress: Progress) -> None:
        if progress.generation == 5:
            raise KeyboardInterrupt

    file = tmp_path / "checkpoint.npz"
    with pytest.raises(KeyboardInterrupt):
        fit_geometry(swollen, drop, CFG, engine="mujoco", out=file.parent, progress=kill)
    resumed = fit_geometry(swollen, drop, CFG, engine="mujoco", out=file.parent, resume=True)
    np.testing.assert_array_equal(resumed.model.geometry.position, fitted.model.geometry.position)
    assert [h["loss"] for h in resumed.history] == [h["loss"] for h in fitted.history]


def test_the_seed_decides_the_result(drop, swollen, fitted):
    again = fit_geometry(swollen, drop, CFG, engine="mujoco")
    other = fit_geometry(swollen, drop, replace(CFG, seed=1), engine="mujoco")
    np.testing.assert_array_equal(again.model.geometry.position, fitted.model.geometry.position)
    assert not np.array_equal(other.model.geometry.position, fitted.model.geometry.position)


def test_a_checkpoint_of_other_settings_is_refused(drop, swollen, tmp_path):
    file = tmp_path / "checkpoint.npz"
    fit_geometry(swollen, drop, replace(CFG, generations=1), engine="mujoco", out=file.parent)
    with pytest.raises(ModelError, match="other settings"):
        fit_geometry(swollen, drop, CFG, engine="mujoco", out=file.parent, resume=True)


def test_a_file_that_is_no_checkpoint_is_refused(tmp_path):
    file = tmp_path / "checkpoint.npz"
    file.write_bytes(b"not a zip")
    with pytest.raises(ModelError, match="not a checkpoint"):
        Checkpoint.load(file)


def test_settings_survive_the_checkpoint_as_json():
    assert json.loads(json.dumps(asdict(CFG)))["evolution"]["population"] == 12


def test_the_fit_ends_when_nothing_gets_better(drop, swollen):
    cfg = replace(CFG, evolution=replace(CFG.evolution, sigma=1e-9), plateau_generations=2)
    result = fit_geometry(swollen, drop, cfg, engine="mujoco")
    assert result.stopped == "error fell by less than 0.02 of itself in 2 generations"
    assert len(result.history) == 3


def test_small_gains_add_up_before_the_fit_ends(drop, swollen):
    search = Search(
        swollen, cut_segments(swollen, [drop[0]], CFG), replace(CFG, plateau_generations=3, min_gain=0.05), "mujoco"
    )

    def seen(generation: int, loss: float, held_out: float) -> int:
        search.evolution.generation = generation
        search.note(Survey(np.ones(1, bool), np.ones(1, bool), loss, held_out))
        return search.last_gain

    assert seen(1, 1.0, 1.0) == 1
    assert seen(2, 0.97, 1.0) == 1
    assert seen(3, 0.94, 1.0) == 3
    assert seen(4, 0.94, 0.96) == 3
    assert seen(5, 1.2, 0.949) == 5
    assert (search.best, search.lowest) == (0.949, 0.94)


def test_radii_move_when_asked(drop, swollen):
    cfg = replace(CFG, evolution=replace(CFG.evolution, fit_radius=True, radius_sigma=0.2), generations=4)
    result = fit_geometry(swollen, drop, cfg, engine="mujoco")
    assert not np.array_equal(result.model.geometry.radius, swollen.geometry.radius)
    assert np.array_equal(result.model.geometry.friction, swollen.geometry.friction)


def test_a_recording_that_observes_nothing_is_refused(drop, swollen):
    blind = Recording(drop.scene, (replace(drop[0], points={}),))
    with pytest.raises(RecordingError, match="the demonstration is empty"):
        fit_geometry(swollen, blind, CFG)


def test_spheres_are_placed_on_the_objects_of_a_model_without_any(drop, swollen):
    bare = swollen.with_geometry(None)
    start = ContactGeometryCfg(count=24, candidates=500)
    found = fit_geometry(bare, drop, replace(CFG, generations=1), start=start, engine="mujoco")
    assert found.start.geometry is not None
    np.testing.assert_array_equal(found.start.geometry.position, start.build(bare.scene).position)


def test_the_true_geometry_scores_best(drop, swollen):
    from concent_warp.estimation.object_tracks import whole_demonstration
    from concent_warp.fit.geometry.objective import Candidates, Objective
    from concent_warp.simulate.mujoco_engine import MujocoEngine

    halves = HALF + np.array([-0.002, 0.0, 0.002])
    segments = [whole_demonstration(swollen.scene, drop[0], ("block",))]
    objective = Objective(MujocoEngine(swollen), segments, held_out=0.0, block=0.2)
    losses = objective(Candidates(np.stack([corner_spheres(h).position for h in halves])))
    assert losses.fit[1] < 0.2 * min(losses.fit[0], losses.fit[2])


def test_a_fit_that_is_not_resumed_begins_anew_beside_a_checkpoint(drop, swollen, tmp_path):
    cfg = replace(CFG, generations=1)
    found = [fit_geometry(swollen, drop, cfg, engine="mujoco", out=tmp_path) for _ in range(2)][-1]
    assert len(found.history) == 1
    seconds = found.history[0]["seconds"]
    again = fit_geometry(swollen, drop, cfg, engine="mujoco", out=tmp_path)
    assert again.history[0]["seconds"] != seconds
    assert fit_geometry(swollen, drop, cfg, engine="mujoco", out=tmp_path, resume=True).history == again.history
