"""The objective against loops over frames and points, with a k-d tree for the nearest ones."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from concent_warp.estimation.object_tracks import BodyTarget, Segment
from concent_warp.fit.geometry.objective import Candidates, Objective, _transforms

TIMESTEP = 0.01


def target(body: str, frames: int, seed: int, start: float = 0.0) -> BodyTarget:
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 0.1, (frames, 7, 3))
    points[1, 2] = np.nan
    points[2, 3, 1] = np.nan
    points[4] = np.nan
    return BodyTarget(body, rng.normal(0, 0.1, (7, 3)), start + 0.0234 * np.arange(frames), points)


def segment(name: str, steps: int, targets: tuple[BodyTarget, ...], held_out: bool | None = None) -> Segment:
    rng = np.random.default_rng(steps)
    ctrl = rng.normal(size=(steps, 2))
    return Segment(name, rng.normal(size=7), rng.normal(size=6), ctrl, targets, held_out=held_out)


class Engine:
    """An engine that tells random poses."""

    timestep = TIMESTEP

    def __init__(self) -> None:
        self.calls: list[Any] = []

    def run(self, variants: Any, ctrl: np.ndarray, **options: Any) -> Any:
        self.calls.append((variants, ctrl, options))
        rng = np.random.default_rng(5)
        shape = (variants.count, len(options["record"]), len(options["bodies"]))
        quaternion = rng.normal(size=(*shape, 4))
        return SimpleNamespace(
            body_position=rng.normal(0, 0.1, (*shape, 3)),
            body_quaternion=quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True),
            diverged=np.zeros(variants.count, dtype=bool),
        )


def objective_of(*segments: Segment, held_out: float = 0.0, squared: bool = False) -> Objective:
    engine: Any = Engine()
    return Objective(engine, list(segments), held_out=held_out, block=0.05, squared=squared)


def expected_distances(objective: Objective, rollout: Any, variant: int, aim: BodyTarget, squared: bool) -> np.ndarray:
    """Return the Chamfer distance of each frame, NaN where nothing was seen."""
    body = objective.bodies.index(aim.body)
    found = []
    last = objective.ctrl.shape[1]
    for time, points in zip(aim.time, aim.points, strict=True):
        at = min(time / TIMESTEP, last)
        lower = min(int(at + 1e-9), last - 1)
        clouds = []
        for step in (lower, lower + 1):
            row = int(np.flatnonzero(objective.record == step)[0])
            turn = Rotation.from_quat(rollout.body_quaternion[variant, row, body], scalar_first=True)
            clouds.append(turn.apply(aim.anchor) + rollout.body_position[variant, row, body])
        predicted = clouds[0] + (at - lower) * (clouds[1] - clouds[0])
        seen = np.isfinite(points).all(axis=1)
        if not seen.any():
            found.append(np.nan)
            continue
        a, b = predicted[seen], points[seen]
        power = 2 if squared else 1
        found.append((KDTree(b).query(a)[0] ** power).mean() + (KDTree(a).query(b)[0] ** power).mean())
    return np.array(found)


@pytest.mark.parametrize("squared", [False, True])
@pytest.mark.parametrize("held_out", [0.0, 0.5, 0.3])
def test_losses_are_means_over_frames_and_targets(held_out, squared):
    first, second, third = target("a", 12, 0), target("b", 9, 1), target("b", 20, 2, 0.013)
    one, two = segment("one", 25, (first, second)), segment("two", 40, (third,))
    objective = objective_of(one, two, held_out=held_out, squared=squared)
    assert objective.bodies == ("a", "b")
    candidates = Candidates(np.zeros((3, 4, 3)))
    rollout = objective.simulate(candidates)
    losses = objective.losses(rollout, 3)
    for p in range(3):
        fit, held = [], []
        for s, aim in ((0, first), (0, second), (1, third)):
            distance = expected_distances(objective, rollout, 2 * p + s, aim, squared)
            seen = np.isfinite(distance)
            out = np.floor(aim.time / 0.05).astype(int) % max(round(1 / held_out), 2) == 1 if held_out else ~seen & seen
            fit.append(distance[seen & ~out].mean())
            held.append(distance[seen & out].mean() if (seen & out).any() else distance[seen & ~out].mean())
        assert losses.fit[p] == pytest.approx(np.mean(fit), rel=1e-4)
        assert losses.held_out[p] == pytest.approx(np.mean(held), rel=1e-4)
    assert objective.simulations == 6
    np.testing.assert_array_equal(objective(candidates).fit, losses.fit)


def test_whole_segments_may_be_held_out():
    used, kept = segment("one", 25, (target("a", 10, 0),), False), segment("two", 25, (target("a", 10, 1),), True)
    objective = objective_of(used, kept, held_out=0.3)
    rollout = objective.simulate(Candidates(np.zeros((1, 4, 3))))
    losses = objective.losses(rollout, 1)
    for found, s in ((losses.fit, 0), (losses.held_out, 1)):
        distance = expected_distances(objective, rollout, s, objective.segments[s].targets[0], False)
        assert found[0] == pytest.approx(np.nanmean(distance), rel=1e-4)
    for alone in (used, kept):
        only = objective_of(alone, held_out=0.3)
        losses = only(Candidates(np.zeros((1, 4, 3))))
        np.testing.assert_array_equal(losses.fit, losses.held_out)


def test_variants_are_candidates_times_segments_with_padded_commands():
    one, two = segment("one", 25, (target("a", 9, 0),)), segment("two", 40, (target("a", 9, 1),))
    objective = objective_of(one, two)
    rng = np.random.default_rng(0)
    position, radius, friction = rng.normal(size=(3, 4, 3)), rng.random((3, 4)), rng.random((3, 4))
    objective.simulate(Candidates(position, radius, friction), contacts="touched")
    engine: Any = objective.engine
    ((variants, ctrl, options),) = engine.calls
    assert variants.count == 6
    for k in range(6):
        np.testing.assert_array_equal(variants.sphere_position[k], position[k // 2])
        np.testing.assert_array_equal(variants.sphere_radius[k], radius[k // 2])
        np.testing.assert_array_equal(variants.sphere_friction[k], friction[k // 2])
        np.testing.assert_array_equal(variants.qpos[k], (one, two)[k % 2].qpos)
        np.testing.assert_array_equal(variants.qvel[k], (one, two)[k % 2].qvel)
    assert ctrl.shape == (2, 40, 2)
    np.testing.assert_array_equal(ctrl[0, :25], one.ctrl)
    np.testing.assert_array_equal(ctrl[0, 25:], np.tile(one.ctrl[-1], (15, 1)))
    np.testing.assert_array_equal(ctrl[1], two.ctrl)
    assert (options["bodies"], options["contacts"]) == (("a",), "touched")
    frames = 0.0234 * np.arange(9) / TIMESTEP
    expected = np.unique(np.concatenate([np.floor(frames), np.floor(frames) + 1]))
    np.testing.assert_array_equal(options["record"], expected)
    objective.simulate(Candidates(position))
    variants = engine.calls[1][0]
    assert variants.sphere_radius is None
    assert variants.sphere_friction is None


def test_a_candidate_that_diverges_in_one_segment_or_is_not_finite_has_an_infinite_loss():
    objective = objective_of(segment("one", 25, (target("a", 9, 0),)), segment("two", 25, (target("a", 9, 1),)))
    rollout = objective.simulate(Candidates(np.zeros((4, 2, 3))))
    rollout.diverged[3] = True
    rollout.body_position[4, 0, 0, 0] = np.nan
    losses = objective.losses(rollout, 4)
    assert np.isfinite(losses.fit[[0, 3]]).all()
    assert np.isinf(losses.fit[1])
    assert np.isinf(losses.held_out[1])
    assert losses.fit.dtype == float


def test_frames_beyond_the_end_count_at_the_end():
    objective = objective_of(segment("one", 25, (target("a", 9, 0),)))
    recorded = np.arange(26)
    time = np.array([-0.1, 0.0, 0.0999999999999, 0.104, 0.245, 0.25, 0.3])
    rows, weight = objective.rows(time, recorded, 25)
    assert rows.tolist() == [0, 0, 10, 10, 24, 24, 24]
    np.testing.assert_allclose(weight, [0.0, 0.0, 0.0, 0.4, 0.5, 1.0, 1.0], atol=1e-9)
    rows, _ = objective.rows(np.array([0.104]), np.array([3, 10, 11]), 25)
    assert rows.tolist() == [1]


def test_targets_stay_on_a_device():
    objective = objective_of(segment("one", 25, (target("a", 9, 0),)))
    device = torch.device("cpu")
    first = objective.aims(device, torch.float64)
    assert objective.aims(device, torch.float64) is first
    single = objective.aims(device, torch.float32)
    assert single is not first
    assert (first[0].anchor.dtype, single[0].anchor.dtype) == (torch.float64, torch.float32)
    np.testing.assert_array_equal(first[0].anchor[:, 3], 1.0)
    assert first[0].observed.dtype == torch.float32
    np.testing.assert_array_equal(first[0].observed[1, 2], 0.0)


def test_transforms_are_rotations_and_translations_from_the_right():
    rng = np.random.default_rng(1)
    turn = Rotation.random(6, rng=rng)
    position = rng.normal(size=(6, 3))
    found = _transforms(torch.as_tensor(position), torch.as_tensor(turn.as_quat(scalar_first=True)))
    assert found.shape == (6, 4, 3)
    np.testing.assert_allclose(found[:, :3], np.swapaxes(turn.as_matrix(), 1, 2), atol=1e-12)
    np.testing.assert_array_equal(found[:, 3], position)
