"""A policy in one world, shown live in the browser."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import mujoco
import torch

from concent_warp.checks import check_device, check_seed, check_settings
from concent_warp.deploy.cfg import PlayCfg, WorldName
from concent_warp.deploy.reality_world import reality_environment
from concent_warp.errors import TrainError
from concent_warp.reality.hidden.in_task import parse_effects
from concent_warp.report.live import LiveView
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.policy.load import Policy
from concent_warp.train.policy.play import PlayedState, Player


def play(
    policy: Policy,
    cfg: PlayCfg | None = None,
    *,
    world: WorldName = "simulation",
    episodes: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    serving: Callable[[str], None] | None = None,
) -> list[str]:
    """Serve a page that shows a policy, until a number of episodes have ended or the call is interrupted.

    Args:
        policy: The policy.
        cfg: Settings.
        world: "simulation" or "reality".
        episodes: Number of episodes; None continues until interrupted.
        seed: Seed of the initial states.
        device: Warp's name of the device; one world is fastest on the CPU.
        serving: Called with the address of the page when it is served.

    Returns:
        The outcomes of the episodes.

    Raises:
        TrainError: A setting is out of bounds.
        ConcentError: The address is not available.

    Example:
        >>> import concent_warp as cw
        >>> cfg = cw.PlayCfg(port=8790, states=1, speed=4.0)
        >>> outcomes = cw.play(cw.load_policy("shape_sorter"), cfg, episodes=1)
        >>> len(outcomes)
        1
    """
    check_seed(seed, TrainError)
    check_device(device)
    cfg = cfg or PlayCfg()
    check_settings(cfg, TrainError)
    player, shown = _make_player(policy, cfg, world=world, seed=seed, device=device)
    task = player.environment.task
    assert task.model.geometry is not None
    view = LiveView(shown, task.model.geometry, task.collidable, host=cfg.host, port=cfg.port, speed=cfg.speed)
    try:
        objects = player.state().position[list(task.objects)]
        view.look_at(objects.mean(axis=0), cfg.eye)
        if serving is not None:
            serving(view.address)
        _watch(player, view, episodes, cfg)
    except KeyboardInterrupt:
        return player.ended
    finally:
        view.stop()
    return player.ended


def _make_player(
    policy: Policy, cfg: PlayCfg, *, world: WorldName, seed: int = 0, device: str = "cpu"
) -> tuple[Player, mujoco.MjModel]:
    """Return the policy in its world, and the model to show.

    Raises:
        TrainError: A setting is out of bounds.
    """
    if parse_effects(cfg.hide) and world == "simulation":
        raise TrainError("hidden effects exist only in Reality", fix="add --world reality")
    policy = policy.scaled(cfg.action_scale, cfg.setpoint_lead_scale)
    run = policy.run
    task = run.task()
    states = run.evaluation_states(task, cfg.states, seed)
    torch.manual_seed(seed)
    settings = replace(run.cfg.environment, worlds=1)
    if world == "reality":
        environment = reality_environment(task, settings, states, cfg, seed=seed)
        shown = environment.physics.model
    else:
        environment = make_environment(task, settings, states, device=device)
        shown = task.model.scene.model
    return Player(environment, policy.act_in(environment), cfg.states, cfg.touch_gap), shown


def _watch(player: Player, view: LiveView, episodes: int | None, cfg: PlayCfg) -> None:
    """Run and show the policy under the page's controls, until a number of episodes have ended."""
    controls, period = view.controls, player.environment.control_step
    due = time.monotonic()
    _show(player, view, player.state())
    while episodes is None or len(player.ended) < episodes:
        if controls.reset:
            controls.reset = False
            player.begin()
            _show(player, view, player.state())
        if not (controls.running or controls.step):
            view.changed.wait(cfg.poll)
            view.changed.clear()
            due = time.monotonic()
            continue
        controls.step = False
        outcome = player.step()
        if outcome is not None:
            view.set_message(f"**{outcome}**  \n{outcome_counts_text(player.ended)}")
            due += cfg.pause / controls.speed
        due = max(due + period / controls.speed, time.monotonic())
        _wait_until(due, view)
        _show(player, view, player.state())


def _wait_until(due: float, view: LiveView) -> None:
    """Wait until a time, or until a control is used."""
    while (left := due - time.monotonic()) > 0:
        if view.changed.wait(left):
            view.changed.clear()
            return


def _show(player: Player, view: LiveView, state: PlayedState) -> None:
    """Show a state with its stage, time and contacts."""
    view.show(state.position, state.quaternion, state.touching, state.pairs)
    touching = int(state.touching.sum())
    view.set_message(
        f"**Stage {state.stage}**, {state.time:.2f} s  \n"
        f"{touching} of {len(state.touching)} spheres touch  \n"
        f"{outcome_counts_text(player.ended)}"
    )


def outcome_counts_text(outcomes: list[str]) -> str:
    """Return the number of ended episodes and of each outcome, in words."""
    each = ", ".join(f"{count} {name}" for name, count in Counter(outcomes).most_common())
    return f"{len(outcomes)} episode{'s' * (len(outcomes) != 1)}{': ' * bool(outcomes)}{each}"
