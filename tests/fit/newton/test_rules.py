"""Time steps, horizons and descents in Newton against loops and formulas, without a simulation."""

from __future__ import annotations

import zipfile
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from concent_warp.errors import EngineError, ModelError, RecordingError
from concent_warp.estimation.object_tracks import BodyTarget, Segment
from concent_warp.fit.newton import horizon
from concent_warp.fit.newton.descent import (
    Descent,
    GradientCfg,
    Metric,
    chosen_iterates,
    descend,
    descent_identity,
    start_descent,
)
from concent_warp.fit.newton.horizon import HorizonCfg, _tilt, _windows_of, gradient_segments, shortened
from concent_warp.fit.newton.physics import BodyInertia, NewtonCfg, choose_physics, coupling
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry
from tests.fit.conftest import DROP, HALF, corner_spheres


def body(name: str = "a", mass: float = 0.2, seed: int = 0) -> BodyInertia:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3)) * 0.01
    return BodyInertia(name, mass, root @ root.T + 1e-5 * np.eye(3), rng.normal(0, 0.01, 3))


@pytest.mark.parametrize("count", [1, 5])
def test_contacts_act_on_a_body_through_its_inertia(count):
    one = body(seed=count)
    points = np.random.default_rng(count).normal(0, 0.05, (count, 3))
    total = np.zeros((6, 6))
    for point in points:
        # A force f at a contact moves it by J M^-1 J' f; J maps velocities of the body to that of the point.
        jacobian = np.zeros((3, 6))
        jacobian[:, :3] = np.eye(3)
        for k in range(3):
            jacobian[:, 3 + k] = np.cross(np.eye(3)[k], point - one.com)
        total += jacobian.T @ jacobian
    mass = np.zeros((6, 6))
    mass[:3, :3], mass[3:, 3:] = one.mass * np.eye(3), one.inertia
    assert coupling(one, points) == pytest.approx(np.abs(np.linalg.eigvals(np.linalg.solve(mass, total))).max())


def chosen(cfg: NewtonCfg, timestep: float, bodies: Any, couplings: Any, friction: float, gravity: float) -> Any:
    """Return substeps, stiffness, damping and slope by trying one number of substeps after the other; or why not."""
    substeps = max(1, int(np.ceil(timestep / cfg.longest_step - 1e-9)))
    last = max(int(timestep / cfg.shortest_step + 1e-9), substeps)
    reason = None
    for k in range(substeps, last + 1):
        step = timestep / k
        stiffness = [b.mass * cfg.frequency**2 / cfg.min_contacts for b in bodies]
        wanted = [2 * cfg.damping * b.mass * cfg.frequency / cfg.min_contacts for b in bodies]
        limits = [0.8 / (step * s) for s in couplings]
        slope = min(limits)
        stiff = [x * s * step**2 > 0.5 for x, s in zip(stiffness, couplings, strict=True)]
        bounce = [limit < cfg.min_damping * w for limit, w in zip(limits, wanted, strict=True)]
        creep = [
            friction * gravity * b.mass > cfg.creep * slope * max(b.mass * s, cfg.min_contacts)
            for b, s in zip(bodies, couplings, strict=True)
        ]
        if not any(stiff + bounce + creep):
            return k, stiffness, [min(w, limit) for w, limit in zip(wanted, limits, strict=True)], slope
        for bad, text in (
            (stiff, "its contacts are too stiff"),
            (bounce, "it would bounce"),
            (creep, "it would creep"),
        ):
            if any(bad):
                reason = text, bodies[bad.index(True)].name, 1e3 * step
                break
    return reason


CASES: list[Any] = [
    (NewtonCfg(), 0.002, (60.0, 25.0), 0.4, 9.81),
    (NewtonCfg(), 0.002, (200.0, 25.0), 0.4, 9.81),
    (NewtonCfg(), 0.004, (25.0, 300.0), 0.4, 9.81),
    (NewtonCfg(frequency=20.0, damping=0.5), 0.004, (60.0, 60.0), 1.5, 9.81),
    (NewtonCfg(frequency=20.0, damping=0.5, creep=0.005), 0.004, (60.0, 600.0), 1.5, 9.81),
    (NewtonCfg(frequency=20.0, damping=0.5, creep=0.001), 0.004, (60.0, 600.0), 1.5, 9.81),
    (NewtonCfg(), 0.004, (25.0, 3000.0), 0.4, 9.81),
    (NewtonCfg(min_damping=0.01), 0.004, (25.0, 9000.0), 0.01, 9.81),
    (NewtonCfg(min_damping=0.01, frequency=900.0), 0.004, (2500.0, 25.0), 0.01, 9.81),
    (NewtonCfg(), 0.0005, (60.0, 25.0), 0.4, 0.0),
    (NewtonCfg(), 0.0004, (60.0, 25.0), 0.4, 9.81),
    (NewtonCfg(), 0.00005, (60.0, 25.0), 0.4, 9.81),
    (NewtonCfg(shortest_step=1e-3), 0.0005, (60.0, 25.0), 0.4, 9.81),
    (NewtonCfg(min_contacts=2), 0.003, (80.0, 45.0), 0.8, 9.81),
    (NewtonCfg(min_contacts=40), 0.003, (80.0, 45.0), 3.0, 9.81),
]


def test_each_outcome_of_the_rules_is_among_the_cases():
    found = [chosen(cfg, step, [body("a", 0.2), body("b", 0.1)], *rest) for cfg, step, *rest in CASES]
    assert {x[0] for x in found if isinstance(x[0], str)} == {
        "its contacts are too stiff", "it would bounce", "it would creep",
    }  # fmt: skip
    assert len({x[0] for x in found if not isinstance(x[0], str)}) > 3


@pytest.mark.parametrize(("cfg", "timestep", "couplings", "friction", "gravity"), CASES)
def test_the_longest_time_step_that_keeps_all_rules_is_taken(cfg, timestep, couplings, friction, gravity):
    bodies = [body("a", 0.2), body("b", 0.1)]
    expected = chosen(cfg, timestep, bodies, couplings, friction, gravity)
    if isinstance(expected[0], str):
        why, name, milliseconds = expected
        with pytest.raises(EngineError, match="cannot simulate this scene stably") as error:
            choose_physics(cfg, timestep, bodies, couplings, friction, gravity)
        text = str(error.value)
        assert f"that with {milliseconds:.3g} ms {why}" in text
        assert f"{1e3 * cfg.shortest_step:g} ms" in text
        assert name in text
        return
    found = choose_physics(cfg, timestep, bodies, couplings, friction, gravity)
    substeps, stiffness, damping, slope = expected
    assert found.substeps == substeps
    assert found.timestep == pytest.approx(timestep / substeps)
    np.testing.assert_allclose(found.stiffness, stiffness)
    np.testing.assert_allclose(found.damping, damping)
    assert found.friction_slope == pytest.approx(slope)
    assert found.onset == cfg.onset


def target(rotations: Any = None, frames: int = 40, name: str = "block") -> BodyTarget:
    """Return a target seen every 0.05 s, in some orientations."""
    anchor = np.random.default_rng(0).normal(0, 0.02, (5, 3))
    turns = Rotation.from_rotvec(np.zeros((frames, 3)) if rotations is None else rotations)
    points = np.stack([turn.apply(anchor) for turn in turns]) + np.array([0.1, 0.2, 0.3])
    return BodyTarget(name, anchor, 0.05 * np.arange(len(points)), points)


def tumbling(angle: float, frames: int = 40) -> BodyTarget:
    turns = np.zeros((frames, 3))
    turns[frames // 2 :, 1] = angle
    turns[:, 0] = 0.3  # tilted from the start
    return target(turns, frames)


def segment(one: BodyTarget, seconds: float = 2.0, **options: Any) -> Segment:
    steps = round(seconds / 0.004)
    return Segment("demo", np.zeros(7), np.zeros(6), np.arange(float(steps))[:, None], (one,), **options)


@pytest.fixture(scope="module")
def block() -> Model:
    return Model(Scene(DROP), corner_spheres(HALF))


def test_the_tilt_is_measured_from_the_first_frame_with_three_points():
    turns = np.zeros((40, 3))
    turns[0, 0], turns[5:, 0], turns[8, 1] = 1.5, 0.2, 0.5
    one = target(turns)
    one.points[0, :3] = np.nan  # two points left
    up = Rotation.from_rotvec(turns).inv().apply([0.0, 0.0, 1.0])[1:]
    expected = np.arccos(np.clip(up @ up[0], -1, 1)).max()
    assert _tilt(one) == pytest.approx(expected, abs=1e-6)
    one.points[0, 2] = [np.nan, 0.0, 0.0]
    assert _tilt(one) == pytest.approx(expected, abs=1e-6)
    one.points[:, 2:] = np.nan
    assert _tilt(one) == 0.0
    level = np.zeros((40, 3))
    level[10:, 2] = 2.0  # turned about the vertical
    assert _tilt(target(level)) == pytest.approx(0.0, abs=1e-6)


def cut_windows_to(monkeypatch: Any, found: Any) -> list[Any]:
    calls: list[Any] = []

    def cut_windows(scene: Any, demonstration: Any, bodies: Any, length: float) -> Any:
        calls.append((scene, demonstration, bodies, length))
        if isinstance(found, Exception):
            raise found
        return found

    monkeypatch.setattr(horizon, "cut_windows", cut_windows)
    return calls


def test_a_stretch_within_the_limit_is_taken_whole_and_a_longer_one_is_cut(block, monkeypatch):
    calls = cut_windows_to(monkeypatch, [])
    cfg = HorizonCfg(tumbling_tilt=0.35, tumbling_window=0.25, calm_window=3.0)

    def lengths(one: BodyTarget, seconds: float, **options: Any) -> list[int]:
        found = gradient_segments(block, [segment(one, seconds, **options)], options.pop("shown", ()), cfg)
        return [len(s.ctrl) for s in found]

    assert lengths(tumbling(0.3), 3.596) == [899]
    assert lengths(tumbling(0.3), 3.604) == [750]
    assert lengths(tumbling(0.4), 0.296) == [74]
    assert lengths(tumbling(0.4), 0.304) == [63]
    assert calls == []
    both = replace(segment(tumbling(0.3)), targets=(tumbling(0.3), tumbling(0.4)))
    assert len(gradient_segments(block, [both], (), cfg)[0].ctrl) == 63


def test_windows_are_cut_from_the_demonstration_of_a_segment(block, monkeypatch):
    whole = segment(tumbling(0.4), 2.0)
    piece = replace(segment(target(frames=5), 0.25), name="demo@0.500")
    calls = cut_windows_to(monkeypatch, [piece, replace(piece, name="demo@0.750")])
    found = gradient_segments(block, [segment(target(), 0.1), whole], ["first", "second"], HorizonCfg())  # pyright: ignore[reportArgumentType]
    assert [s.name for s in found] == ["demo", "demo@0.500", "demo@0.750"]
    assert calls == [(block.scene, "second", ("block",), 0.25)]
    cut_windows_to(monkeypatch, RecordingError("no states"))
    found = gradient_segments(block, [whole], ["first"], HorizonCfg())  # pyright: ignore[reportArgumentType]
    assert [len(s.ctrl) for s in found] == [63]


def test_held_out_frames_and_segments_are_left_out(block):
    one = target()
    kept = gradient_segments(block, [segment(one, 2.0)], (), HorizonCfg(), held_out=0.5, block=0.2)
    out = one.held_out(0.5, 0.2)
    seen = np.isfinite(kept[0].targets[0].points).all(axis=(1, 2))
    np.testing.assert_array_equal(seen, ~out)
    assert np.isfinite(one.points).all()
    assert gradient_segments(block, [segment(one, held_out=True)], (), HorizonCfg(), held_out=0.5) == []
    used = segment(one, held_out=False)
    assert gradient_segments(block, [used], (), HorizonCfg(), held_out=0.5, block=0.2) == [used]
    pair = gradient_segments(block, [segment(one, held_out=True), used], (), HorizonCfg())
    assert pair == [used]


def test_many_stretches_are_thinned_out_evenly(block):
    segments = [replace(segment(target(frames=3), 0.1, held_out=False), name=str(k)) for k in range(11)]
    found = gradient_segments(block, segments, (), HorizonCfg(max_windows=4))
    assert [s.name for s in found] == ["0", "3", "7", "10"]
    assert gradient_segments(block, segments, (), HorizonCfg(max_windows=11)) == segments


def test_what_a_demonstration_has_not_seen_is_not_seen_in_its_windows(block, monkeypatch):
    one = target()
    one.points[[12, 13]] = np.nan  # at 0.6 and 0.65 s
    one.points[15, :2] = np.nan
    late = BodyTarget("block", one.anchor, np.array([0.0, 0.0981, 0.1018, 0.1021, 0.2]), np.ones((5, 5, 3)))
    blind = BodyTarget("block", one.anchor, np.array([0.1]), np.ones((1, 5, 3)))
    other = replace(segment(blind), name="a@b@0.5")
    windows = [replace(segment(late), name="a@b@0.5"), other, replace(other, targets=(late, blind))]
    cut_windows_to(monkeypatch, windows)
    shown: Any = "demonstration"
    found = _windows_of(block, shown, 0.25, segment(one))
    assert [len(s.targets) for s in found] == [1, 1]
    seen = np.isfinite(found[0].targets[0].points).all(axis=(1, 2))
    assert seen.tolist() == [True, False, False, True, True]
    everything = _windows_of(block, shown, 0.25, segment(target()))
    assert [len(s.targets) for s in everything] == [1, 1, 2]


def test_the_beginning_of_a_segment_ends_with_a_whole_step(block):
    m = block.scene.model
    long = segment(target(), 2.0)
    assert [len(shortened(m, long, t).ctrl) for t in (0.1, 0.101, 0.104, 5.0)] == [25, 26, 26, 500]
    np.testing.assert_allclose(shortened(m, long, 0.1).targets[0].time, [0.0, 0.05, 0.1])


GEOMETRY = corner_spheres(HALF)
BASE = GEOMETRY.position
CFG = GradientCfg(prior=3.0, plateau_iterations=2, iterations=9, smallest_step=1e-4)


def stub_metric() -> Any:
    return SimpleNamespace(direction=lambda gradient: -np.sign(np.nan_to_num(gradient)))


def told(losses: Any, gradients: Any) -> Any:
    seen: list[np.ndarray] = []

    def loss(parameters: Any) -> Any:
        seen.append(parameters.position - BASE)
        return SimpleNamespace(loss=np.array(losses, dtype=float), by={"position": np.array(gradients, dtype=float)})

    loss.seen = seen  # pyright: ignore[reportFunctionMemberAccess]
    return loss


def test_a_step_of_the_descent_start_by_start():
    rng = np.random.default_rng(0)
    state = start_descent(rng.normal(0, 1e-3, (5, 8, 3)), 2e-3)
    state.now[0, 2:] = 0.0
    state.now[1] = 0.0
    state.lowest[:] = [np.inf, 0.5, 0.1, 0.5, 0.5]
    state.step[:] = [1e-3, 2e-3, 4e-3, 1.9e-4, 3e-3]
    state.best[:] = 1.0
    state.direction[:] = 0.25
    state.losses, state.lows = [[0.0] * 5], [9.0]
    now, before = state.now.copy(), state.now.copy()
    gradients = rng.normal(0, 0.01, (5, 8, 3))
    gradients[4, 0, 0] = np.nan
    losses = [0.4, 0.3, 0.2, np.nan, 0.1]
    loss = told(losses, gradients)
    descend(state, loss, BASE, stub_metric(), CFG, lambda values: values + 7.0)
    np.testing.assert_array_equal(loss.seen[0], (BASE + before) - BASE)
    squared = (now**2).sum(axis=(1, 2))
    moving = np.array([2, 1, 8, 8, 8])
    total = np.array(losses) + 3.0 * squared / moving
    pulled = gradients + 6.0 * now / moving[:, None, None]
    better = [True, True, False, False, False]
    np.testing.assert_allclose(state.lowest, [total[0], total[1], 0.1, 0.5, 0.5])
    np.testing.assert_allclose(state.step, [1.2e-3, 2.4e-3, 2e-3, 0.95e-4, 1.5e-3])
    for p in range(5):
        np.testing.assert_array_equal(state.best[p], now[p] if better[p] else np.ones((8, 3)))
        expected = -np.sign(pulled[p]) if better[p] else np.full((8, 3), 0.25)
        np.testing.assert_array_equal(state.direction[p], expected)
    np.testing.assert_allclose(state.now, state.best + state.step[:, None, None] * state.direction + 7.0)
    assert state.losses[1] == [0.4, 0.3, 0.2, np.inf, np.inf]
    assert state.kept_start == [0, 1]
    np.testing.assert_array_equal(state.kept, now[:2])
    assert state.lows == [9.0, pytest.approx(min(total[0], total[1], 0.1))]
    assert not state.finished


def test_the_first_step_keeps_its_length():
    state = start_descent(np.zeros((2, 8, 3)), 2e-3)
    descend(state, told([1.0, np.inf], np.ones((2, 8, 3))), BASE, stub_metric(), CFG, lambda values: values)
    np.testing.assert_allclose(state.step, [2e-3, 1e-3])
    np.testing.assert_allclose(state.now[0], -2e-3)
    np.testing.assert_array_equal(state.now[1], 0.0)
    assert state.lowest.tolist() == [1.0, np.inf]
    assert state.losses == [[1.0, np.inf]]


@pytest.mark.parametrize(
    ("lows", "step", "loss", "finished"),
    [
        ([1.0, 1.0], 1.0, 0.969, False),
        ([1.0, 1.0], 1.0, 0.971, True),
        ([1.0], 1.0, 0.999, False),
        ([1.0, 0.5, 0.5], 1.0, 0.484, False),
        ([1.0, 0.5, 0.5], 1.0, 0.486, True),
        ([1.0] * 8, 1.0, 0.1, True),
        ([1.0] * 7, 1.0, 0.1, False),
        ([1.0] * 10, 1.0, 0.1, True),
        ([1.0], 8.4e-5, 0.1, False),
        ([1.0], 8.3e-5, 0.1, True),
        ([1.0], 1.0, np.nan, True),
    ],
)
def test_a_descent_ends_by_its_count_by_small_gains_or_by_small_steps(lows, step, loss, finished):
    state = start_descent(np.zeros((1, 8, 3)), step)
    state.lows, state.losses = list(lows), [[1.0]] * len(lows)
    descend(state, told([loss], np.ones((1, 8, 3))), BASE, stub_metric(), CFG, lambda values: values)
    assert state.finished is finished


def test_one_start_that_goes_on_is_enough():
    state = start_descent(np.zeros((2, 8, 3)), 1.0)
    state.lows, state.losses = [1.0], [[1.0, 1.0]]
    descend(state, told([np.nan, 0.2], np.ones((2, 8, 3))), BASE, stub_metric(), CFG, lambda values: values)
    assert not state.finished
    assert state.lows == [1.0, 0.2]


@pytest.mark.parametrize("swelling", [0.0, 1.5])
def test_the_metric_is_the_covariance_of_the_noise_by_body(swelling):
    rng = np.random.default_rng(4)
    owner = rng.integers(2, size=10)
    geometry = ContactGeometry(
        ("a", "b", "c"), owner, rng.normal(0, 0.02, (10, 3)), *(np.full(10, v) for v in (0.004, 0.1, 0.5))
    )
    mask, growth = rng.random(10) < 0.7, rng.normal(size=(10, 3))
    found = Metric(geometry, mask, growth, 0.03, swelling, 0.1)
    gradient = rng.normal(size=(4, 10, 3))
    gradient[1, 0, 2] = np.inf
    gradient[2] = 0.0
    directions = found.direction(gradient)
    for p in range(4):
        expected = np.zeros((10, 3))
        for i, j in np.ndindex(10, 10):
            if not (mask[i] and mask[j] and owner[i] == owner[j]) or p == 1:
                continue
            squared = np.sum((geometry.position[i] - geometry.position[j]) ** 2)
            expected[i] -= np.exp(-squared / (2 * 0.03**2)) * gradient[p, j]
            far = np.exp(-squared / (2 * 0.1**2))
            expected[i] -= swelling**2 * far * (gradient[p, j] @ growth[j]) * growth[i]
        longest = np.linalg.norm(expected, axis=1).max()
        np.testing.assert_allclose(directions[p], expected / longest if longest else expected, atol=1e-12)


def kept(starts: list[int], count: int = 3) -> Descent:
    state = start_descent(np.zeros((count, 2, 3)), 1.0)
    state.kept, state.kept_start = [np.full((2, 3), float(k)) for k in range(len(starts))], starts
    return state


@pytest.mark.parametrize(
    ("starts", "each", "chosen_rows"),
    [
        ([0, 0, 0, 0, 0, 0], 1, [1]),
        ([0, 0, 0, 0, 0, 0], 2, [1, 5]),
        ([0, 0, 0, 0, 0, 0], 3, [1, 3, 5]),
        ([0], 3, [0]),
        ([1, 1, 1], 2, [0, 2]),
        ([2, 0, 1, 0, 2], 4, [3, 2, 0, 4]),
        ([], 4, []),
    ],
)
def test_iterates_of_each_start_are_chosen_evenly_without_the_model_itself(starts, each, chosen_rows):
    found = chosen_iterates(kept(starts), each)
    assert found.shape == (len(chosen_rows), 2, 3)
    assert found[:, 0, 0].tolist() == chosen_rows


def test_a_state_is_written_in_one_piece_and_read_back(tmp_path):
    state, mine = kept([0, 2]), descent_identity(CFG, 3, BASE, ("a", "b"))
    state.losses, state.lows, state.finished = [[1.0, np.inf, 2.0]], [0.5], True
    path = tmp_path / "deep" / "er" / "state.npz"
    state.save(path, mine)
    assert [p.name for p in path.parent.iterdir()] == ["state.npz"]
    state.save(path, mine)
    found = Descent.load(path, mine)
    assert (found.kept_start, found.lows, found.losses, found.finished) == ([0, 2], [0.5], state.losses, True)
    np.testing.assert_array_equal(found.kept, state.kept)
    assert mine["seed"] == 3
    assert mine["segments"] == ["a", "b"]
    start_descent(np.zeros((1, 2, 3)), 1.0).save(path, mine)
    assert Descent.load(path, mine).kept == []


@pytest.mark.parametrize("kind", ["missing", "empty", "cut", "key", "json", "flipped", "squeezed"])
def test_a_state_that_is_not_whole_is_refused(kind, tmp_path):
    path = tmp_path / "state.npz"
    mine = descent_identity(CFG, 0, BASE, ["a"])
    kept([0, 1]).save(path, mine)
    content: dict[str, Any] = dict(np.load(path))
    data = bytearray(path.read_bytes())
    if kind == "missing":
        path.unlink()
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "cut":
        path.write_bytes(data[:-300])
    elif kind == "key":
        content.pop("step")
        np.savez(path, **content)
    elif kind == "json":
        content["losses"] = np.array("{")
        np.savez(path, **content)
    else:
        if kind == "squeezed":
            np.savez_compressed(path, **content)
            data = bytearray(path.read_bytes())
        with zipfile.ZipFile(path) as archive:
            at = archive.getinfo("now.npy").header_offset
        data[at + 60 : at + 100] = b"\xff" * 40
        path.write_bytes(data)
    with pytest.raises(ModelError, match="not a state of a descent") as error:
        Descent.load(path, mine)
    assert "state.npz" in str(error.value)
