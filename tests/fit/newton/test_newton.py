"""Gradients through Newton: against central differences, and what the tool does with them."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.errors import EngineError, ModelError
from concent_warp.estimation.object_tracks import whole_demonstration
from concent_warp.fit.fit_geometry import FitCfg, fit_geometry
from concent_warp.fit.geometry.evolution import EvolutionCfg
from concent_warp.fit.newton.descent import GradientCfg
from concent_warp.fit.newton.horizon import HorizonCfg, _tilt, gradient_segments
from concent_warp.fit.newton.loss import NewtonLoss, recording_gradient
from concent_warp.fit.newton.physics import BodyInertia, NewtonCfg, choose_physics, coupling
from concent_warp.fit.newton.scene import newton_scene
from concent_warp.fit.newton.worlds import Parameters
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, PointTrack, Recording
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry
from tests.fit.conftest import DROP, HALF, corner_spheres
from tests.scenes.tossing import toss_scene, tosses

PUSHED = """
<mujoco>
  <option timestep="0.002" cone="elliptic"/>
  <worldbody>
    <geom name="table" type="plane" size="1 1 0.1" friction="0.4"/>
    <body name="pusher" pos="-0.045 0 0.02">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <geom name="pusher" type="box" size="0.01 0.03 0.01" mass="0.3" friction="0.4"/>
    </body>
    <body name="block" pos="0 0 0.02">
      <freejoint/>
      <geom name="block" type="box" size="0.02 0.02 0.02" mass="0.08" friction="0.4"/>
    </body>
  </worldbody>
  <actuator><position name="drive" joint="slide" kp="2000" kv="60"/></actuator>
</mujoco>
"""
SMALL = GradientCfg(starts=2, iterations=8)


@pytest.fixture(scope="module")
def pushed() -> Recording:
    """A plate pushes an exact box over a table for 0.4 s."""
    m = mujoco.MjModel.from_xml_string(PUSHED)
    d = mujoco.MjData(m)
    local = np.random.default_rng(0).uniform(-HALF, HALF, (12, 3))
    times, points = np.arange(25) / 60, []
    while len(points) < 25:
        d.ctrl[0] = 0.06 * d.time
        mujoco.mj_forward(m, d)
        if d.time >= times[len(points)] - 1e-9:
            points.append(d.body("block").xpos + local @ d.body("block").xmat.reshape(3, 3).T)
        mujoco.mj_step(m, d)
    clock = np.arange(41) / 100
    track = PointTrack(times, np.array(points), np.ones((25, 12), dtype=bool))
    start = Demonstration("demo_0", qpos=m.qpos0.copy(), qvel=np.zeros(m.nv), points={"block": track})
    return Recording(PUSHED, (replace(start, action={"drive": Channel(clock, 0.06 * clock)}),))


@pytest.fixture(scope="module")
def thick() -> Model:
    """A model of the block whose spheres stand out by 1.5 mm."""
    return Model(Scene(PUSHED), corner_spheres(HALF + 0.0015))


def test_gradient_of_pushing_is_that_of_central_differences(pushed, thick):
    found = recording_gradient(thick, pushed)
    loss = NewtonLoss(found.scene, 2)
    position = thick.geometry.position
    towards = np.where(position < 0, 1.0, -1.0) / np.sqrt(position.size)

    def slope(**change):
        def at(sign):
            return {name: base + sign * step for name, (base, step) in change.items()}

        given = [at(1), at(-1)]
        stacked = {name: np.stack([g[name] for g in given]) for name in given[0]}
        stacked.setdefault("position", np.stack([position, position]))
        up, down = loss.losses(Parameters(**stacked))
        return (up - down) / 2

    for direction in (towards, np.where(position[:, :1] < 0, [1.0, 0.0, 0.0], 0.0)):
        step = 5e-5 * direction
        assert float((found.position * step).sum()) == pytest.approx(slope(position=(position, step)), rel=0.06)
    assert found.mass_scale["block"] * 0.02 == pytest.approx(slope(mass_scale=(np.ones(1), np.full(1, 0.02))), rel=0.2)
    assert found.friction_scale * 0.02 == pytest.approx(slope(friction_scale=(np.array(1.0), np.array(0.02))), rel=0.2)


def test_newton_follows_mujoco(pushed, thick):
    found = recording_gradient(thick, pushed)
    assert found.loss == pytest.approx(found.mujoco_loss, rel=0.15)
    assert found.scene.bodies == ("block", "world", "pusher")


def test_gradients_mend_the_block_and_the_strategy_begins_where_they_end(pushed, thick):
    cfg = FitCfg(EvolutionCfg(population=8, freeze_gripped=False), gradient=SMALL, generations=1)
    found = fit_geometry(thick, pushed, cfg, method="gradient", engine="mujoco")
    assert found.gradients.helped
    assert found.gradients.after < 0.65 * found.gradients.before
    assert found.stopped == "gradient descent done"
    assert found.history[1]["loss"] < 0.65 * found.history[0]["loss"]
    both = fit_geometry(thick, pushed, cfg, method="gradient+es", engine="mujoco")
    assert both.history[0]["loss"] == found.history[1]["loss"]
    assert "generation" in both.stopped


def test_an_interrupted_descent_resumes_to_the_same_result(pushed, thick, tmp_path):
    cfg = FitCfg(gradient=SMALL)

    def kill(progress):
        if progress.generation == 4:
            raise KeyboardInterrupt

    whole_run = fit_geometry(thick, pushed, cfg, method="gradient", engine="mujoco")
    file = tmp_path / "checkpoint.npz"
    with pytest.raises(KeyboardInterrupt):
        fit_geometry(thick, pushed, cfg, method="gradient", engine="mujoco", out=file.parent, progress=kill)
    resumed = fit_geometry(thick, pushed, cfg, method="gradient", engine="mujoco", out=file.parent, resume=True)
    np.testing.assert_array_equal(resumed.model.geometry.position, whole_run.model.geometry.position)
    other = replace(cfg, gradient=replace(SMALL, prior=1.0))
    with pytest.raises(ModelError, match="other settings"):
        fit_geometry(thick, pushed, other, method="gradient", engine="mujoco", out=file.parent, resume=True)


def test_without_help_from_gradients_the_strategy_goes_on_alone(pushed, thick):
    cfg = FitCfg(gradient=replace(SMALL, min_gain=0.999), generations=2)
    alone = fit_geometry(thick, pushed, cfg, engine="mujoco")
    found = fit_geometry(thick, pushed, cfg, method="gradient", engine="mujoco")
    assert not found.gradients.helped
    assert "do not help" in found.gradients.remark
    np.testing.assert_array_equal(found.model.geometry.position, alone.model.geometry.position)
    assert found.history[-1]["simulations"] > alone.history[-1]["simulations"]


def test_another_motion_in_newton_ends_the_descent_at_once(pushed, thick):
    cfg = FitCfg(gradient=replace(SMALL, max_engine_ratio=0.1), generations=1)
    found = fit_geometry(thick, pushed, cfg, method="gradient", engine="mujoco")
    assert "another motion" in found.gradients.remark
    assert len(found.gradients.losses) == 1


def test_what_newton_cannot_do_is_left_to_the_strategy(drop, swollen):
    cfg = FitCfg(gradient=replace(SMALL, newton=NewtonCfg(shortest_step=1e-3)), generations=1)
    found = fit_geometry(swollen, drop, cfg, method="gradient+es", engine="mujoco")
    assert not found.gradients.helped
    assert "cannot simulate this scene stably" in found.gradients.remark


def test_a_mesh_that_comes_near_is_refused(swollen, drop):
    text = DROP.replace('<geom name="floor" type="plane" size="1 1 0.1"/>', '<geom type="ellipsoid" size="1 1 0.001"/>')
    model = replace(swollen, scene=Scene(text))
    with pytest.raises(ModelError, match="ELLIPSOID"):
        recording_gradient(model, replace(drop, scene=text))


def test_a_fixture_alone_has_nothing_to_differentiate(drop):
    fixed = Model(Scene(DROP.replace("<freejoint/>", "")), corner_spheres(HALF))
    with pytest.raises(ModelError, match="free joint"):
        newton_scene(fixed, [whole_demonstration(Scene(DROP), drop[0], ("block",))])


def test_tumbling_is_cut_into_windows_and_pushing_is_not(pushed, thick):
    calm = [whole_demonstration(thick.scene, pushed[0], ("block",))]
    assert _tilt(calm[0].targets[0]) < 0.05
    (kept,) = gradient_segments(thick, calm, [pushed[0]], HorizonCfg())
    assert kept.name == calm[0].name
    assert len(kept.ctrl) == len(calm[0].ctrl)
    thrown = tosses(1)
    scene = Scene(toss_scene(0.06))
    spheres = ContactGeometry(("cube",), np.zeros(1, int), np.zeros((1, 3)), *(np.full(1, v) for v in (0.03, 0.2, 0.3)))
    segment = whole_demonstration(scene, thrown[0], ("cube",))
    assert _tilt(segment.targets[0]) > 0.35
    cut = gradient_segments(Model(scene, spheres), [segment], [thrown[0]], HorizonCfg(), held_out=0.2)
    length = max(float(t.time[-1]) for s in cut for t in s.targets)
    assert length <= 0.25 + 1e-9
    held = segment.targets[0].time[segment.targets[0].held_out(0.2, 0.2)]
    seen = [
        float(s.name.split("@")[1]) + t.time[np.isfinite(t.points).any(axis=(1, 2))] for s in cut for t in s.targets
    ]
    assert np.abs(np.concatenate(seen)[:, None] - held).min() > 2e-3


@pytest.mark.gpu
def test_gradients_on_cuda_are_those_on_the_cpu(pushed, thick):
    here, there = (recording_gradient(thick, pushed, device=device) for device in ("cpu", "cuda:0"))
    assert there.loss == pytest.approx(here.loss, rel=1e-3)
    np.testing.assert_allclose(there.position, here.position, rtol=0.02, atol=0.02 * np.abs(here.position).max())


def test_numbers_keep_the_rules_of_stability():
    body = BodyInertia("block", 0.08, np.diag([2.1e-5] * 3), np.zeros(3))
    corners = np.array(np.meshgrid([-0.02, 0.02], [-0.02, 0.02], [-0.02])).reshape(3, -1).T
    strength = coupling(body, corners)
    assert strength > 4 / 0.08
    found = choose_physics(NewtonCfg(), 0.004, [body], [strength], 0.5, 9.81)
    assert found.timestep * found.substeps == pytest.approx(0.004)
    assert found.timestep**2 * found.stiffness[0] * strength <= 0.5
    assert found.timestep * max(found.damping[0], found.friction_slope) * strength <= 0.8 * (1 + 1e-9)
    with pytest.raises(EngineError, match="block"):
        choose_physics(NewtonCfg(), 0.004, [body], [100 * strength], 0.5, 9.81)
