"""Descents on factors and the gradient start, on losses that are written down."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.errors import EngineError, ModelError, RecordingError
from concent_warp.fit.geometry.evolution import Evolution, EvolutionCfg
from concent_warp.fit.geometry.objective import Losses
from concent_warp.fit.geometry.perturbation import Perturbation
from concent_warp.fit.geometry.search import GeometrySearchCfg, Survey
from concent_warp.fit.newton import scale_factors, warm_start
from concent_warp.fit.newton.descent import Descent, GradientCfg, descent_identity, start_descent
from concent_warp.fit.newton.scale_factors import FactorCfg, FactorDescent, _stretches
from concent_warp.fit.newton.warm_start import GradientWarmStart
from tests.fit.conftest import HALF, corner_spheres

GEOMETRY = corner_spheres(HALF)
LIMITS = np.log([(0.2, 5.0), (0.25, 2.0), (0.7, 2.0), (0.7, 2.0)])


def descent_of(curve: Any, cfg: FactorCfg | None = None) -> Any:
    """Return a descent on four factors whose losses are curves of their logarithms."""
    found: Any = object.__new__(FactorDescent)
    found.cfg = cfg or FactorCfg()
    found._low, found._high = LIMITS.T
    found._position, found._friction = np.ones((4, 8, 3)), np.full((4, 8), 0.4)
    moving = [SimpleNamespace(name="a"), SimpleNamespace(name="b")]
    segments = [SimpleNamespace(name="one"), SimpleNamespace(name="two")]
    physics = SimpleNamespace(timestep=0.25)
    found.scene = SimpleNamespace(moving=moving, segments=segments, steps=100, physics=physics)
    found.seen = []

    class Loss:
        count, simulations, objective = 4, 0, "objective"

        def __call__(self, parameters: Any) -> Any:
            self.simulations += 8
            friction, stiffness, mass = parameters.friction_scale, parameters.stiffness_scale, parameters.mass_scale
            factor = np.array([friction[0], stiffness[1], mass[2, 0], mass[3, 1]])
            others = [*friction[1:], stiffness[0], *stiffness[2:], *np.delete(mass.ravel(), [4, 7])]
            assert all(other == 1.0 for other in others)
            np.testing.assert_array_equal(parameters.position, found._position)
            np.testing.assert_array_equal(parameters.friction, found._friction)
            loss, slope = curve(np.log(factor))
            found.seen.append(np.log(factor))
            by: dict[str, Any] = {name: np.full(4, 99.0) for name in ("friction_scale", "stiffness_scale")}
            by["mass_scale"] = np.full((4, 2), 99.0)
            by["friction_scale"][0], by["stiffness_scale"][1] = slope[:2] / factor[:2]
            by["mass_scale"][2, 0], by["mass_scale"][3, 1] = slope[2:] / factor[2:]
            return SimpleNamespace(loss=loss, by=by)

    found.loss = Loss()
    return found


def expected_run(curve: Any, cfg: FactorCfg) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Return the iterates of each factor by itself, the best of each and its loss."""
    now, best, lowest = np.zeros(4), np.zeros(4), np.full(4, np.inf)
    step, direction, seen = np.full(4, cfg.step), np.zeros(4), []
    for iteration in range(cfg.iterations):
        seen.append(now.copy())
        loss, slope = curve(now)
        for k in range(4):
            if np.isfinite(loss[k]) and np.isfinite(slope[k]) and loss[k] < lowest[k]:
                turned = slope[k] * direction[k] > 0
                step[k] *= 0.5 if turned else (1.2 if iteration > 0 else 1.0)
                best[k], lowest[k], direction[k] = now[k], loss[k], -np.sign(slope[k])
            else:
                step[k] *= 0.5
        now = np.array([np.clip(best[k] + step[k] * direction[k], *LIMITS[k]) for k in range(4)])
        if all(step[k] <= cfg.smallest_step or now[k] == best[k] for k in range(4)):
            break
    return seen, best, lowest


def bowls(goal: Any, *, noise: float = 0.0) -> Any:
    """Return squared distances from a goal, level where it is NaN."""
    goal = np.array(goal)

    def curve(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        away = x - goal
        loss = 1e-3 + np.nan_to_num(away**2) * 1e-3 + noise * np.sin(40 * x)
        return loss, np.nan_to_num(2e-3 * away)

    return curve


def broken(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return losses that are not finite beyond some values, and slopes that are not for the last factor."""
    loss, slope = bowls([0.9, -0.6, 0.5, 0.2])(x)
    loss = np.where(x > 0.7, np.inf, loss)
    slope[3] = np.nan
    return loss, slope


CURVES = {
    "bowls": (bowls([0.9, -0.6, 0.5, -0.2]), FactorCfg()),
    "many steps": (bowls([1.2, -1.0, 0.5, -0.3]), FactorCfg(iterations=30, smallest_step=1e-3)),
    "beyond the limits": (bowls([3.0, -3.0, 3.0, -3.0]), FactorCfg(iterations=20)),
    "level": (bowls([np.nan] * 4), FactorCfg()),
    "rough": (bowls([0.9, -0.6, 0.5, -0.2], noise=3e-4), FactorCfg(iterations=20)),
    "broken": (broken, FactorCfg(iterations=12)),
    "one step": (bowls([0.9, -0.6, 0.5, -0.2]), FactorCfg(iterations=1)),
    "short steps": (bowls([0.9, -0.6, 0.5, -0.2]), FactorCfg(step=0.025)),
}


@pytest.mark.parametrize("name", CURVES)
def test_each_factor_descends_by_itself(name, monkeypatch):
    curve, cfg = CURVES[name]
    monkeypatch.setattr(scale_factors, "mujoco_loss", lambda *_: 5e-3)
    descent = descent_of(curve, cfg)
    found = descent.run()
    seen, best, lowest = expected_run(curve, cfg)
    assert len(descent.seen) == len(seen)
    np.testing.assert_allclose(descent.seen, seen, atol=1e-12)
    before = curve(np.zeros(4))[0][0]
    factor = np.where(lowest < 0.95 * before, np.exp(best), 1.0)
    assert [found.friction, found.stiffness, found.mass["a"], found.mass["b"]] == pytest.approx(list(factor))
    assert list(found.after) == ["friction", "stiffness", "a", "b"]
    np.testing.assert_allclose(list(found.after.values()), lowest)
    assert (found.before, found.mujoco) == (before, 5e-3)
    assert found.simulations == 8 * len(seen)
    assert found.simulated == pytest.approx(8 * len(seen) * 100 * 0.25)


@pytest.mark.parametrize(("newton", "agrees"), [(4.9e-3, True), (5.1e-3, False), (np.nan, False), (np.inf, False)])
def test_both_simulators_have_to_tell_of_the_same_motion(newton, agrees):
    descent = descent_of(None)
    if agrees:
        descent._agree(newton, 1.0101e-3)
        return
    with pytest.raises(EngineError, match="another motion than MuJoCo") as error:
        descent._agree(newton, 1.0101e-3)
    text = str(error.value)
    assert "at most 5.1 mm" in text
    assert f"{1e3 * newton:.2g} mm" in text
    assert "one, two" in text


def test_slopes_are_against_the_logarithm_of_a_factor():
    descent = descent_of(bowls([0.9, -0.6, 0.5, -0.2]))
    factor = np.exp([0.1, -0.2, 0.3, 0.05])
    loss, slope = descent.slopes(factor)
    expected = bowls([0.9, -0.6, 0.5, -0.2])(np.log(factor))
    np.testing.assert_allclose(loss, expected[0])
    np.testing.assert_allclose(slope, expected[1])


def test_stretches_are_those_of_demonstrations_that_show_an_object(monkeypatch):
    calls: list[Any] = []

    def whole(scene: Any, demonstration: Any, bodies: Any) -> Any:
        del scene
        if demonstration.startswith("blind"):
            raise RecordingError(f"nothing in {demonstration}")
        return f"{demonstration} of {bodies}"

    def cut(model: Any, segments: Any, shown: Any, cfg: Any) -> Any:
        del model
        calls.append((segments, shown, cfg))
        return "cut"

    monkeypatch.setattr(scale_factors, "whole_demonstration", whole)
    monkeypatch.setattr(scale_factors, "gradient_segments", cut)
    model: Any = SimpleNamespace(geometry=GEOMETRY, scene=SimpleNamespace(source="here.xml"))
    recording: Any = SimpleNamespace(demonstrations=("a", "blind 1", "b", "blind 2"))
    cfg: Any = "cfg"
    assert _stretches(model, recording, cfg) == "cut"
    assert calls == [(["a of ('block',)", "b of ('block',)"], ["a", "b"], "cfg")]
    recording.demonstrations = ("blind 1", "blind 2")
    with pytest.raises(RecordingError, match="nothing in blind 2"):
        _stretches(model, recording, cfg)
    model.geometry = None
    with pytest.raises(ModelError, match="need contact geometry of spheres"):
        _stretches(model, recording, cfg)


class Searched:
    """What a gradient start asks of a search."""

    def __init__(self, squared: bool = False, **options: Any) -> None:
        strategy = EvolutionCfg(max_displacement=2e-3, max_sigma=1e-3, **options)
        self.cfg = GeometrySearchCfg(strategy, squared=squared, held_out=0.3, block=0.1, seed=5)
        self.evolution = Evolution(GEOMETRY, np.sign(GEOMETRY.position), strategy)
        self.used, self.held_out = ["one", "two"], ["two", "three"]
        self.model = SimpleNamespace(with_geometry=lambda geometry: ("model", geometry))
        self.full, self.simulations, self.seconds = "full", 100, 10.0
        self.surveyed: list[Any] = []
        self.best_in_mujoco: list[Any] = []
        self.losses: Any = lambda position: np.abs(position - GEOMETRY.position).sum(axis=(1, 2))

    def survey(self, segments: Any) -> Survey:
        self.surveyed.append(segments)
        return Survey(GEOMETRY.position[:, 2] < 0, np.ones(8, bool), 6e-3, 3e-3)

    def flattened(self, survey: Survey, segments: Any) -> Survey:
        self.surveyed.append(segments)
        self.evolution.mean[:, :3] = 1e-4
        return replace(survey, loss=5e-3)

    def objective(self, engine: Any, segments: Any) -> Any:
        def losses(candidates: Any) -> Losses:
            self.best_in_mujoco.append((engine, segments, candidates.position))
            value = self.losses(candidates.position)
            return Losses(value, 3 * value)

        return losses


def warm(searched: Any = None, cfg: GradientCfg | None = None) -> Any:
    return GradientWarmStart(searched or Searched(), ["demonstration"], cfg or GradientCfg())  # pyright: ignore[reportArgumentType]


def test_a_gradient_start_begins_from_the_flattened_geometry():
    searched = Searched()
    found = warm(searched)
    assert found.segments == ["one", "two", "three"]
    assert searched.surveyed == [["one", "two", "three"]] * 2
    assert (found.survey.loss, found.before) == (5e-3, 4e-3)
    assert searched.evolution.sigma == pytest.approx(5e-3 / 6)
    np.testing.assert_allclose(found.start, 1e-4)
    np.testing.assert_allclose(found.base, GEOMETRY.position + 1e-4)
    assert found.start is not searched.evolution.mean
    squared = Searched(squared=True)
    warm(squared)
    assert squared.evolution.sigma == pytest.approx(min(np.sqrt(5e-3) / 6, 1e-3))


def test_distances_are_roots_of_squared_losses():
    assert warm().metres(0.04) == 0.04
    assert warm(Searched(squared=True)).metres(0.04) == pytest.approx(0.2)


def test_the_first_step_is_a_third_of_the_distance():
    assert warm().first_step() == pytest.approx(4e-3 / 3)
    assert warm(cfg=GradientCfg(largest_step=1e-3)).first_step() == 1e-3
    assert warm(cfg=GradientCfg(step=7e-3)).first_step() == 7e-3


def test_displacements_stay_within_the_bounds_of_the_strategy():
    found = warm()
    moved = found.bounded(np.full((2, 8, 3), 1.0))
    np.testing.assert_allclose(np.linalg.norm(moved + 1e-4, axis=2), 2e-3)
    np.testing.assert_allclose(found.bounded(np.full((1, 8, 3), 1e-5)), 1e-5)


def test_starts_are_the_geometry_and_disturbed_ones():
    searched = Searched()
    found = warm(searched, GradientCfg(starts=3))
    starts = found.starts()
    assert starts.shape == (3, 8, 3)
    np.testing.assert_allclose(starts[0], 0.0, atol=1e-18)
    cfg = searched.evolution.cfg
    noise = Perturbation(
        GEOMETRY.with_position(GEOMETRY.position + 1e-4), found.survey.mask, cfg.noise, cfg.length,
        growth=searched.evolution.growth, swelling=cfg.swelling, swelling_length=cfg.swelling_length,
    ).sample(3, 3, np.random.default_rng([5, 1])) * searched.evolution.sigma  # fmt: skip
    np.testing.assert_allclose(starts[1:], found.bounded(noise)[1:], atol=1e-15)
    assert np.abs(starts[1:]).max() > 1e-4


def test_iterates_are_judged_by_the_mean_over_all_frames():
    searched = Searched(fit_radius=True)
    found = warm(searched)
    found.start[:, 3] = 0.5
    state = start_descent(np.zeros((2, 8, 3)), 1e-3)
    assert found.best_in_mujoco(state) == (None, np.inf)
    assert searched.simulations == 100
    state.kept = [np.full((8, 3), v) for v in (3e-4, 1e-4, 2e-4)]
    state.kept_start = [1, 1, 1]
    values, after = found.best_in_mujoco(state)
    np.testing.assert_allclose(values[:, :3], 2e-4)
    np.testing.assert_array_equal(values[:, 3], 0.5)
    assert after == pytest.approx(2 * 24 * 2e-4)
    ((engine, segments, position),) = searched.best_in_mujoco
    assert (engine, segments) == ("full", found.segments)
    np.testing.assert_allclose(position, GEOMETRY.position + np.array([4e-4, 2e-4, 3e-4])[:, None, None])
    assert searched.simulations == 100 + 3 * 3


@pytest.fixture
def gradients(monkeypatch) -> dict[str, Any]:
    """Gradients through a Newton that is written down: every step lowers the loss of the first start by a tenth."""
    told: dict[str, Any] = {"mujoco": 1e-3, "count": 0, "calls": [], "refuse": None, "loss": 4e-3}

    def descend(state: Descent, loss: Any, base: Any, metric: Any, cfg: GradientCfg, bounded: Any) -> None:
        told["calls"].append((loss, base, metric, bounded))
        told["count"] += 1
        state.losses.append([told["loss"] * 0.9 ** told["count"]] * cfg.starts)
        state.lowest[:] = told["loss"] * 0.9 ** told["count"]
        state.kept.append(np.full((8, 3), 1e-4 if told["count"] < 9 else -1e-4))
        state.kept_start.append(1)
        state.finished = len(state.losses) >= cfg.iterations

    def scene(model: Any, segments: Any, cfg: Any) -> Any:
        told["scene"] = (model, segments, cfg)
        if told["refuse"]:
            raise told["refuse"]
        return "scene"

    def loss(scene: Any, count: int, **options: Any) -> Any:
        told["made"] = (scene, count, options)
        return SimpleNamespace(objective="objective", scene=scene, simulations=50)

    def segments(model: Any, used: Any, shown: Any, cfg: Any, **options: Any) -> Any:
        told["segments"] = (model, used, shown, cfg, options)
        return [SimpleNamespace(name="s1")]

    monkeypatch.setattr(warm_start, "descend", descend)
    monkeypatch.setattr(warm_start, "newton_scene", scene)
    monkeypatch.setattr(warm_start, "NewtonLoss", loss)
    monkeypatch.setattr(warm_start, "gradient_segments", segments)
    monkeypatch.setattr(warm_start, "mujoco_loss", lambda objective, scene: told["mujoco"])  # noqa: ARG005
    return told


def test_gradients_help_where_the_best_iterate_is_clearly_better(gradients, tmp_path):
    searched = Searched(swelling=0.7, swelling_length=0.05)
    searched.losses = lambda position: np.full(len(position), 1.8e-3)
    cfg = GradientCfg(iterations=4, starts=2, device="cpu")
    shown: list[Any] = []
    found = warm(searched, cfg)
    result = found.run(tmp_path / "d.npz", False, lambda *given: shown.append(given))
    assert result.helped
    assert (result.before, result.after) == (4e-3, pytest.approx(3.6e-3))
    assert result.remark == "gradients helped: best iterate 3.60 mm in MuJoCo, start 4.00 mm"
    np.testing.assert_allclose(result.mean, 2e-4)
    assert len(result.losses) == 4
    assert searched.seconds > 10.0
    assert searched.simulations == 100 + 50 + 3 * 4
    assert [count for count, *_ in shown] == [1, 2, 3, 4]
    np.testing.assert_allclose([low for _, low, _ in shown], 4e-3 * 0.9 ** np.arange(1, 5))
    assert shown[0][2] > 0
    assert shown[3][2] == 0.0
    assert gradients["segments"][1:3] == (["one", "two"], ["demonstration"])
    assert gradients["segments"][4] == {"held_out": 0.3, "block": 0.1}
    assert gradients["made"] == ("scene", 2, {"squared": False, "device": "cpu"})
    _, base, metric, bounded = gradients["calls"][0]
    assert base is found.base
    assert (metric.swelling, bounded) == (0.7, found.bounded)
    np.testing.assert_allclose(gradients["scene"][0][1].position, found.base)
    mine = descent_identity(cfg, 5, found.base, ["s1"])
    assert len(Descent.load(tmp_path / "d.npz", mine).losses) == 4


@pytest.mark.parametrize(("after", "helped"), [(1.89e-3, True), (1.91e-3, False)])
def test_gradients_have_to_gain_a_twentieth(gradients, after, helped):
    searched = Searched()
    searched.losses = lambda position: np.full(len(position), after)
    found = warm(searched, GradientCfg(iterations=2))
    result = found.run(None, False, None)
    assert result.helped is helped
    if not helped:
        assert result.after == result.before == 4e-3
        np.testing.assert_array_equal(result.mean, found.start)
        text = f"(best iterate {2e3 * after:.2f} mm in MuJoCo, start 4.00 mm)"
        assert result.remark == f"gradients do not help here {text}; the evolution strategy goes on without them"
        assert searched.seconds > 10.0
    del gradients


def test_distances_and_seconds_are_reported_as_they_are(gradients):
    searched = Searched()
    found = warm(searched, GradientCfg(iterations=2))
    found.before, found.begun = 4.0, found.begun - 7.0
    searched.losses = lambda position: np.full(len(position), 1.9)
    result = found.run(None, False, None)
    assert "best iterate 3800.00 mm in MuJoCo, start 4000.00 mm" in result.remark
    assert result.helped
    assert 17.0 < searched.seconds < 27.0
    found.without_help("", [])
    assert 24.0 < searched.seconds < 34.0
    del gradients


def test_a_motion_that_newton_simulates_otherwise_ends_the_descent_at_its_first_step(gradients):
    gradients["mujoco"] = 4e-3 * 0.9 / 5.01
    result = warm(cfg=GradientCfg(iterations=6)).run(None, False, None)
    assert not result.helped
    assert len(result.losses) == 1
    assert "Newton simulates another motion" in result.remark
    gradients["mujoco"], gradients["count"] = 4e-3 * 0.9 / 4.99, 0
    searched = Searched()
    searched.losses = lambda position: np.full(len(position), 1e-3)
    assert len(warm(searched, GradientCfg(iterations=6)).run(None, False, None).losses) == 6


@pytest.mark.parametrize(("loss", "steps"), [(2.0e-3, 3), (1.99e-3, 6)])
def test_a_descent_ends_early_where_its_first_iterates_are_no_better(gradients, loss, steps):
    searched = Searched()
    searched.losses = lambda position: np.full(len(position), loss)
    result = warm(searched, GradientCfg(iterations=6, first_rescoring=3)).run(None, False, None)
    assert len(result.losses) == steps
    assert len(searched.best_in_mujoco) == 2
    del gradients
    last = warm(searched, GradientCfg(iterations=3, first_rescoring=3)).run(None, False, None)
    assert len(last.losses) == 3


def test_what_newton_cannot_simulate_is_reported_once(gradients):
    for error in (EngineError("too stiff.", where="block"), ModelError("a mesh")):
        gradients["refuse"] = error
        result = warm().run(None, False, None)
        text = str(error).rstrip(".")
        expected = f"gradients are not to be had here: {text}; the evolution strategy goes on without them"
        assert (result.helped, result.losses, result.remark) == (False, [], expected)


def test_a_descent_goes_on_from_its_file(gradients, tmp_path):
    path = tmp_path / "d.npz"
    searched = Searched()
    searched.losses = lambda position: np.full(len(position), 1e-3)
    cfg = GradientCfg(iterations=4)
    warm(searched, cfg).run(path, False, None)
    gradients["count"] = 0
    again = warm(searched, cfg).run(path, True, None)
    assert (gradients["count"], len(again.losses)) == (0, 4)
    fresh = warm(searched, cfg).run(path, False, None)
    assert (gradients["count"], len(fresh.losses)) == (4, 4)
    with pytest.raises(ModelError, match="other settings"):
        warm(searched, replace(cfg, prior=1.0)).run(path, True, None)
    missing = warm(searched, cfg).run(tmp_path / "none.npz", True, None)
    assert len(missing.losses) == 4
