"""Phases of a free body by what it touches, its forces together, and the picture, on made-up windows."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from concent_warp.comparison.phases import FREE, GRASPED, IMPACT, REST, SLIDE, STICK
from concent_warp.diagnosis.forces.body_forces import BodyRecord, _body_phase, _body_phases
from concent_warp.diagnosis.forces.cfg import ContactStateCfg, LocateForcesCfg
from concent_warp.diagnosis.forces.contact_state import BETWEEN, PUSHED, BodyWindows, body_windows
from concent_warp.diagnosis.forces.plot import _draw_body, _draw_joint, _geom_mesh, plot_location
from concent_warp.diagnosis.forces.result import UnexplainedForces
from concent_warp.diagnosis.forces.window_forces import INSTANT_WEIGHTS, INSTANTS, Windows
from concent_warp.diagnosis.forces.wrench import steady_force, wrenches
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.simulate.engine import ContactLog
from tests.diagnosis.forces.test_describe import PLACE, body, joint, phase

XML = """<mujoco><option timestep=".01"/><worldbody><geom name="floor" type="plane" size="1 1 .1"/>
  <body name="arm"><joint name="j"/><geom size=".1"/></body><body name="hand"><joint name="k"/><geom size=".1"/></body>
  <body name="block"><freejoint/><geom type="box" size=".1 .1 .05" mass=".4"/></body></worldbody></mujoco>"""
STEPS = 10
FLOOR, ARM, HAND, BLOCK = range(4)


def contacts(rows: list[tuple[int, int, int, tuple, tuple, tuple]]) -> ContactLog:
    """Return a log of (window, step, other geom, point, normal towards the block, force on it)."""
    variant, step, other, point, normal, force = zip(*rows, strict=True) if rows else ((),) * 6
    geom = np.array([(o, BLOCK) for o in other], int).reshape(-1, 2)
    vectors = [np.array(v, float).reshape(-1, 3) for v in (point, normal, force)]
    return ContactLog(
        np.array(variant, int), np.array(step, int), geom, vectors[0], vectors[1], np.zeros(len(rows)), vectors[2]
    )


def observed(
    log: ContactLog, velocity: np.ndarray, turn: Rotation, *, edges: np.ndarray | None = None, std: float = 1e-3
) -> BodyWindows:
    """Return the windows of a block that moves with velocities (K, 6), spin in the frame of the block."""
    m, count = mujoco.MjModel.from_xml_string(XML), len(velocity)
    qpos, qvel = np.zeros((count, m.nq)), np.zeros((count, m.nv))
    qpos[:, 5:9], qvel[:, 2:] = turn.as_quat(scalar_first=True), velocity
    path = np.repeat(qpos[:, None], STEPS + 1, axis=1)
    edge = np.repeat(qvel[None], 2, axis=0)
    if edges is not None:
        edge[:, :, 2:] = edges
    found = Windows(
        "d",
        0.05 * np.arange(count),
        0.1,
        qpos,
        qvel,
        edge,
        np.zeros((count, m.nv)),
        np.zeros((count, m.nv, m.nv)),
        log,
        path,
    )
    rows = np.repeat(qvel, len(INSTANTS), axis=0)
    motion: Any = SimpleNamespace(compiled=m, states=lambda _time: SimpleNamespace(qvel=rows))
    position = SimpleNamespace(covariance=lambda t: np.tile(np.diag([9.0, std**2, 9.0]), (len(t), 1, 1)))
    measured: Any = SimpleNamespace(body=m.body("block").id, qpos=2, dof=2, position=position)
    return body_windows(motion, found, measured, ContactStateCfg())


def standing(
    other: int = FLOOR, window: int = 0, steps: range | list[int] = range(STEPS), normal=(0, 0, 1), point=(0, 0, -0.05)
):
    """Return contacts in some steps at one point."""
    return [(window, k, other, point, normal, (0.0, 0, 4)) for k in steps]


STILL, ALONG = np.zeros((1, 6)), np.array([[0.5, 0, 0, 0, 0, 0.0]])
UPRIGHT = Rotation.from_rotvec(np.zeros((1, 3)))


@pytest.mark.parametrize(
    ("log", "velocity", "expected"),
    [
        ([], ALONG, FREE),
        (standing(), STILL, REST),
        (standing(), ALONG, SLIDE),
        (standing(), np.array([[0.5, 0, 0, 0, 10.0, 0]]), STICK),
        (standing(), np.array([[0.5, 0, 0, 0, 10 * 0.74, 0]]), SLIDE),
        (standing(), np.array([[0.5, 0, 0, 0, 10 * 0.76, 0]]), STICK),
        (standing(), np.array([[0, 0, 0, 0, 0, 1.0]]), SLIDE),
        (standing(steps=range(8)), ALONG, SLIDE),
        (standing(steps=range(7)), ALONG, IMPACT),
        (standing(steps=[0, 1, 4, 5, 8, 9]), STILL, REST),
        (standing(steps=[0, 1, 5, 6, 9]), STILL, IMPACT),
        ([*standing(), *standing(ARM, normal=(1, 0, 0))], ALONG, PUSHED),
        ([*standing(ARM, normal=(1, 0, 0)), *standing(HAND, normal=(-1, 0, 0))], ALONG, GRASPED),
    ],
)
def test_phases_follow_from_lasting_contacts_and_the_slip_there(log, velocity, expected):
    found = observed(contacts(log), velocity, UPRIGHT)
    assert found.phase.tolist() == [expected]
    assert found.size == pytest.approx(0.25 / 3)


def test_a_window_in_which_a_block_starts_or_stops_is_between():
    moving, still = np.array([0.5, 0, 0, 0, 0, 0]), np.zeros(6)
    for middle, first, last, expected in (
        (moving, moving, still, BETWEEN), (moving, still, moving, BETWEEN), (still, moving, still, BETWEEN),
        (moving, moving, moving, SLIDE), (still, still, still, REST),
    ):  # fmt: skip
        edges = np.array([[first], [last]])
        assert observed(contacts(standing()), middle[None], UPRIGHT, edges=edges).phase[0] == expected
    slow = np.array([[0.004, 0, 0, 0, 0, 0]])
    assert observed(contacts(standing()), slow, UPRIGHT).phase[0] == REST
    assert observed(contacts(standing()), 1.3 * slow, UPRIGHT).phase[0] == SLIDE
    assert observed(contacts(standing()), 10 * slow, UPRIGHT, std=0.0134).phase[0] == REST
    assert observed(contacts(standing()), 10 * slow, UPRIGHT, std=0.0132).phase[0] == SLIDE


def test_touches_are_weighted_by_force_in_the_frame_of_the_block():
    turn = Rotation.from_rotvec([[0, 0, np.pi / 2]])
    rows = [
        (0, 0, FLOOR, (0.1, 0, -0.05), (0, 0, 1), (0, 0, 3.0)),
        (0, 1, FLOOR, (-0.1, 0, -0.05), (0, 0, 1), (0, 0, 1.0)),
        (0, 1, ARM, (0, 0.1, 0), (0, -1, 0), (0, -2.0, 0)),
    ]
    found = observed(contacts(rows), ALONG, turn)
    touches = found.touches[0]
    assert set(touches) == {"world", "arm"}
    np.testing.assert_allclose(touches["world"].point, turn.inv().apply([0.05, 0, -0.05])[0], atol=1e-9)
    np.testing.assert_allclose(touches["world"].normal, [0, 0, 1], atol=1e-9)
    assert touches["world"].share == pytest.approx(0.2)
    np.testing.assert_allclose(touches["arm"].point, turn.inv().apply([0, 0.1, 0])[0], atol=1e-9)
    np.testing.assert_allclose(touches["arm"].normal, turn.inv().apply([0, -1, 0])[0], atol=1e-9)
    assert touches["arm"].share == pytest.approx(0.1)
    # The slip is at the floor, the robot's contact aside.
    centre = np.array([0.05, 0, -0.05])
    spinning = observed(contacts(rows), np.array([[0.5, 0, 0.2, 0, 0, 2.0]]), turn)
    slip = np.array([0.5, 0, 0.2]) + np.cross([0, 0, 2.0], centre)
    np.testing.assert_allclose(spinning.sliding[0], slip * [1, 1, 0], atol=1e-9)
    np.testing.assert_allclose(spinning.spin[0], [0, 0, 2.0], atol=1e-9)
    np.testing.assert_allclose(spinning.velocity[0], [0.5, 0, 0.2])
    blur = np.hypot(np.linalg.norm(slip * [1, 1, 0]), 2e-3)
    share = 1.0 - 0.8  # gaps of eight steps are longer than two
    np.testing.assert_allclose(spinning.heading[0], share * INSTANT_WEIGHTS.sum() * slip * [1, 1, 0] / blur, atol=1e-9)
    np.testing.assert_allclose(spinning.rotation[0], turn.as_matrix()[0])
    assert (spinning.free[0] == np.eye(6)).all()


def test_lasting_contacts_hide_what_they_push_against():
    turn = Rotation.from_rotvec([[0, 0, 0.3]] * 2)
    corners = [(x, y, -0.05) for x in (-0.1, 0.1) for y in (-0.1, 0.1)]
    rows = [(0, k, FLOOR, c, (0, 0, 1), (0, 0, 1.0)) for k in range(STEPS) for c in corners]
    rows += standing(ARM, window=1, normal=(1, 0, 0), point=(-0.1, 0, 0))
    found = observed(contacts(rows), np.zeros((2, 6)), turn)
    np.testing.assert_allclose(found.free[0], np.diag([1, 1, 0, 0, 0, 1]), atol=1e-9)
    np.testing.assert_allclose(found.free[1], np.diag([0, 1, 1, 1, 1, 1]), atol=1e-9)


def test_the_other_side_of_a_contact_pushes_the_other_way():
    log = contacts(standing())
    turned = ContactLog(log.variant, log.step, log.geom[:, ::-1], log.position, -log.normal, log.distance, -log.force)
    one, other = (observed(each, ALONG, UPRIGHT) for each in (log, turned))
    np.testing.assert_allclose(one.touches[0]["world"].normal, other.touches[0]["world"].normal)
    assert one.phase.tolist() == other.phase.tolist()


def records(seed: int = 0) -> list[Any]:
    """Return a block in two demonstrations that flies, slides and rests, pushed by a force of the world."""
    made = []
    m = mujoco.MjModel.from_xml_string(XML)
    rng = np.random.default_rng(seed)
    for k in range(2):
        count = 12
        phases = np.array([FREE] * 6 + [SLIDE] * 4 + [REST] * 2, dtype=object)
        state = BodyWindows(
            phases, tuple({} for _ in range(count)), np.tile(np.eye(6), (count, 1, 1)), 0.1,
            np.tile([1.0, 0, 0], (count, 1)), np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 3)),
            Rotation.random(count, rng).as_matrix(),
        )  # fmt: skip
        force = np.zeros((count, 6))
        force[:, :3] = rng.normal([0.3, -0.2, 0.1], 0.01, (count, 3))
        valid = np.ones(count, bool)
        valid[2] = False
        seen = wrenches(
            force,
            np.tile(1e-4 * np.eye(6), (count, 1, 1)),
            state,
            np.arange(count),
            valid,
            turned=True,
            min_visible=0.3,
        )
        windows = SimpleNamespace(start=0.05 * np.arange(count), length=0.1, demonstration=f"d{k}")
        measured = SimpleNamespace(body=m.body("block").id, name="block")
        motion = SimpleNamespace(compiled=m)
        made.append(BodyRecord(motion, windows, measured, state, valid, seen))  # pyright: ignore[reportArgumentType]
    return made


def test_each_phase_but_rest_has_its_steady_force():
    parts, model, cfg = records(), Model(Scene(XML)), LocateForcesCfg()
    found = _body_phases(model, parts, cfg)
    assert [p.phase for p in found] == [FREE, SLIDE]
    free = found[0]
    assert free.spans == (
        ("d0", 0.0, pytest.approx(0.15)), ("d0", pytest.approx(0.15), pytest.approx(0.35)),
        ("d1", 0.0, pytest.approx(0.15)), ("d1", pytest.approx(0.15), pytest.approx(0.35)),
    )  # fmt: skip
    assert free.frame == "world"
    np.testing.assert_allclose(free.vector, [0.3, -0.2, 0.1], atol=0.02)
    forces = np.concatenate([p.seen.force[p.phase == FREE] for p in parts])
    turns = np.concatenate([p.seen.rotation[p.phase == FREE] for p in parts])
    np.testing.assert_allclose(free.impulse, forces.sum(axis=0) * 0.05 / 4)
    np.testing.assert_allclose(free.arrow, np.mean([t.T @ free.vector for t in turns], axis=0))
    np.testing.assert_allclose(free.torque, np.zeros(3), atol=1e-12)
    assert (free.test, free.significant, free.smallest_p) == ("known noise", False, 0.0)  # four blocks
    assert free.p < 1e-9
    assert _body_phase(model, parts, "stick", cfg) is None
    few = LocateForcesCfg(min_phase_windows=9)
    assert _body_phase(model, parts, SLIDE, few) is None
    assert _body_phase(model, parts, SLIDE, LocateForcesCfg(min_phase_windows=8)) is not None
    assert steady_force(parts[0].seen, cfg) is not None


SHAPES = """<mujoco><asset><mesh name="wedge" vertex="-.03 -.02 -.02 .03 -.02 -.02 0 .03 -.02 0 0 .03"/></asset>
  <worldbody><geom type="plane" size="1 1 .1"/><body name="thing"><freejoint/>
  <geom type="box" size=".1 .2 .3" pos=".1 0 0" euler="0 0 90"/><geom type="sphere" size=".1" pos="0 .2 0"/>
  <geom type="ellipsoid" size=".1 .2 .3"/><geom type="cylinder" size=".1 .2" euler="90 0 0"/>
  <geom type="capsule" size=".1 .2" pos="0 0 .3"/><geom type="mesh" mesh="wedge"/></body></worldbody></mujoco>"""


def test_shapes_are_drawn_as_they_are():
    m = mujoco.MjModel.from_xml_string(SHAPES)
    assert _geom_mesh(m, 0) is None
    expected = {
        1: ([-0.1, -0.1, -0.3], [0.3, 0.1, 0.3]),
        2: ([-0.1, 0.1, -0.1], [0.1, 0.3, 0.1]),
        3: ([-0.1, -0.2, -0.3], [0.1, 0.2, 0.3]),
        4: ([-0.1, -0.2, -0.1], [0.1, 0.2, 0.1]),
        5: ([-0.1, -0.1, 0.0], [0.1, 0.1, 0.6]),
        6: ([-0.03, -0.02, -0.02], [0.03, 0.03, 0.03]),
    }
    counts = {}
    for g, corners in expected.items():
        mesh = _geom_mesh(m, g)
        assert mesh is not None
        np.testing.assert_allclose(mesh.bounds, corners, atol=3e-3)
        counts[g] = len(mesh.faces)
    assert counts == {1: 12, 2: 320, 3: 320, 4: counts[4], 5: counts[5], 6: 4}
    assert counts[4] == 96


@pytest.fixture
def figures(monkeypatch):
    """Return the figures that are closed, and leave them open."""
    import matplotlib as mpl

    mpl.use("agg")
    import matplotlib.pyplot as plt

    kept: list[Any] = []
    close = plt.close
    monkeypatch.setattr(plt, "close", kept.append)
    yield kept
    for figure in kept:
        close(figure)


def location(*arrows: Any, joints: int = 0) -> Any:
    """Return forces with arrows on a block and some joints."""
    return SimpleNamespace(
        arrows=lambda: list(arrows),
        bodies=[body()],
        joints=[joint(joint=f"j{k}", significant=k == 0) for k in range(joints)],
    )


def arrow(point: tuple, vector: tuple, label: str = "1 N") -> dict[str, Any]:
    """Return an arrow on the block."""
    return {"body": "block", "point": point, "vector": vector, "label": label}


def test_arrows_end_where_forces_act_and_the_picture_holds_them(figures):
    import matplotlib.pyplot as plt

    m = mujoco.MjModel.from_xml_string(XML)
    figure = plt.figure()
    axes: Any = figure.add_subplot(projection="3d")
    _draw_body(axes, m, "block", [arrow((0.1, 0, 0), (-2.0, 0, 0), "2 N"), arrow((0, 0.1, 0), (0, 1.0, 0), "1 N")])
    texts = {t.get_text(): np.array(t.get_position_3d()) for t in axes.texts}
    np.testing.assert_allclose(texts[" 2 N"], [100 + 0.7 * 200, 0, 0])
    np.testing.assert_allclose(texts[" 1 N"], [0, 100 - 0.7 * 200 / 2, 0])
    low, high = np.array([-100, -100, -50.0]), np.array([240, 100, 50.0])
    middle, half = (low + high) / 2, 0.55 * 340
    for (a, b), centre in zip((axes.get_xlim(), axes.get_ylim(), axes.get_zlim()), middle, strict=True):
        assert (a, b) == pytest.approx((centre - half, centre + half))
    assert (axes.elev, axes.azim) == (25, -40)
    assert axes.get_title() == "block"
    assert axes.get_xlabel() == "x [mm]"
    assert len(axes.lines) == 12
    edges = np.abs([line.get_data_3d() for line in axes.lines])
    np.testing.assert_allclose(edges.max(axis=(0, 2)), [100, 100, 50])
    bare: Any = plt.figure().add_subplot(projection="3d")
    _draw_body(bare, m, "block", [])
    assert bare.get_title() == "block: no unexplained force with a place"
    assert bare.get_xlim() == pytest.approx((-110, 110))
    figures += [figure, bare.figure]


def test_forces_of_joints_are_drawn_one_demonstration_after_the_other(figures):
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots()
    _draw_joint(axes, joint(), last=True)
    curves: Any = axes.lines
    np.testing.assert_allclose(curves[0].get_xdata(), [0.1, 0.2])
    np.testing.assert_allclose(curves[1].get_xdata(), [0.7, 0.85])
    band: Any = axes.collections[0]
    heights = band.get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == pytest.approx((-0.2, 0.2))
    assert axes.get_title(loc="left") == "hinge (band: 2 standard deviations of the noise)"
    assert (axes.get_ylabel(), axes.get_xlabel()) == ("force [N m]", "time [s]")
    from tests.diagnosis.forces.test_describe import pattern

    _, other = plt.subplots()
    _draw_joint(other, joint(pattern("velocity", 1.0)), last=False)
    assert other.get_title(loc="left").startswith("hinge: goes with velocity (band")
    assert other.get_xlabel() == ""
    figures += [figure, other.figure]


@pytest.mark.parametrize(
    ("found", "size", "shown"),
    [
        (location(arrow((0.1, 0, 0), (-1.0, 0, 0)), joints=0), (4.6, 3.6), ["block"]),
        (location(joints=6), (4.6, 3.6 + 6.0), ["block: no unexplained force with a place", "", "", "", ""]),
    ],
)
def test_a_picture_has_a_row_of_objects_and_one_for_each_of_a_few_joints(found, size, shown, figures, tmp_path):
    plot_location(found, Model(Scene(XML)), tmp_path / "a.png")
    (figure,) = figures
    assert tuple(figure.get_size_inches()) == pytest.approx(size)
    assert [a.get_title() for a in figure.axes] == shown
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
    if len(shown) > 1:
        assert [a.get_xlabel() for a in figure.axes[1:]] == ["", "", "", "time [s]"]
        assert [a.get_title(loc="left").split()[0] for a in figure.axes[1:]] == ["j0", "j1", "j2", "j3"]


def test_a_picture_of_joints_alone_is_wider(figures, tmp_path):
    found: Any = UnexplainedForces(0.1, (joint(),), (), 0.05)
    plot_location(found, Model(Scene(XML)), tmp_path / "a.png")
    assert tuple(figures[0].get_size_inches()) == pytest.approx((7.5, 1.5))
    placed = UnexplainedForces(0.1, (), (body(phase(place=PLACE)),), 0.05)
    plot_location(placed, Model(Scene(XML)), tmp_path / "b.png")
    assert [a.get_title() for a in figures[1].axes] == ["block"]
