from __future__ import annotations

import mujoco
import numpy as np
import pytest

from concent_warp.reality.run import WorldLog, simulate, simulate_to_rest
from concent_warp.reality.sensors.sensing import SensingCfg
from concent_warp.reality.world import HiddenEffect, WorldCfg
from concent_warp.scene.shape_sorter import ShapeSorterCfg, home

SCENE = ShapeSorterCfg().build()
SENSING = SensingCfg(point_count=8, point_rate=5.0, tracking_std=0.0)


def run(*effects: HiddenEffect, step: float = 0.0, duration: float = 0.4) -> tuple[mujoco.MjModel, WorldLog]:
    """Hold the arm still, then command joint 1 `step` [rad] further from 0.1 s on, and return what happened."""
    model = WorldCfg().build(SCENE, effects).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = home(model)
    time = np.arange(0, duration + 1e-9, 0.1)
    hold = np.array([*data.qpos[:7], 0.0])
    action = np.repeat(hold[None], len(time), axis=0)
    action[1:, 0] += step
    simulate_to_rest(model, data, hold)
    log = simulate(SENSING, SCENE, model, data, time, action, effects, np.random.default_rng(0), None)
    return model, log


def block(model: mujoco.MjModel, log: WorldLog) -> np.ndarray:
    address = model.joint("block_joint").qposadr[0]
    return np.array(log.qpos)[:, address : address + 3]


def push(newton: float) -> HiddenEffect:
    def force(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        data.xfrc_applied[model.body("block").id, 0] += newton

    return HiddenEffect("push", force=force)


def slippery(spec: mujoco.MjSpec) -> None:
    spec.geom("block").friction[0] = 0.05
    spec.geom("table").friction[0] = 0.05


def test_nothing_moves_a_block_that_nothing_pushes():
    model, log = run()
    assert np.ptp(block(model, log), axis=0).max() < 1e-4


def test_force_hook_pushes_the_block_with_the_force_it_adds():
    model, log = run(HiddenEffect("slippery", edit=slippery), push(0.2))
    # 0.2 N on 80 g against friction 0.05: a = F/m - mu g.
    travel = 0.5 * (0.2 / 0.08 - 0.05 * 9.81) * log.time[-1] ** 2
    assert block(model, log)[-1, 0] - block(model, log)[0, 0] == pytest.approx(travel, rel=0.05)


def test_forces_do_not_pile_up_over_the_steps_and_add_over_effects():
    model, once = run(HiddenEffect("slippery", edit=slippery), push(0.2))
    _, twice = run(HiddenEffect("slippery", edit=slippery), push(0.1), push(0.1))
    np.testing.assert_allclose(block(model, once), block(model, twice), atol=1e-9)


def test_edit_hook_changes_friction_so_that_the_same_push_now_moves_the_block():
    model, rough = run(push(0.2))
    slick_model, slick = run(HiddenEffect("slippery", edit=slippery), push(0.2))
    assert slick_model.geom("block").friction[0] == 0.05
    assert model.geom("block").friction[0] == pytest.approx(ShapeSorterCfg().friction)
    assert np.ptp(block(model, rough)[:, 0]) < 1e-3 < np.ptp(block(slick_model, slick)[:, 0])


def test_command_hook_delays_the_arm_by_what_it_delays_the_command():
    delay = 0.05

    def late(now: float, ctrl: np.ndarray) -> np.ndarray:
        held = ctrl.copy()
        held[0] = 0.0 if now < 0.1 + delay - 1e-9 else 0.2
        return held

    _, prompt = run(step=0.2)
    _, delayed = run(HiddenEffect("delay", command=late), step=0.2)
    angle, late_angle = np.array(prompt.qpos)[:, 0], np.array(delayed.qpos)[:, 0]
    lag = round(delay / prompt.time[1])
    assert angle[-1] > 0.05
    np.testing.assert_allclose(late_angle[lag:], angle[:-lag], atol=1e-3)
    assert np.abs(late_angle - angle).max() > 0.02


def test_world_keeps_mass_and_inertia_when_it_chamfers_the_block():
    model, drawn = WorldCfg().build(SCENE).compile(), SCENE.model
    for field in ("body_mass", "body_inertia", "body_ipos"):
        np.testing.assert_allclose(getattr(model, field), getattr(drawn, field), atol=1e-12)
    block_geom = model.geom("block")
    assert block_geom.type[0] == mujoco.mjtGeom.mjGEOM_MESH
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert model.opt.timestep < drawn.opt.timestep
