"""States in which policies fail in Reality, and whether the physics of the training, or the model's own, solve them.

    python -m benchmarks.train.stuck runs/a/policy runs/b/policy ...    # run folders of one stage, then the page

Each policy runs from the same initial states in the physics of its training, in the model's own (elliptic cones, its
time step), in the first with all spheres in it, and in Reality. The states in which it neither succeeds nor fails in
Reality (*stuck*) are set in the simulations, at rest, and the policy continues from them for the length of an episode.
No parameter is sampled. *turned* and *slid* are medians over the stuck states of the motion of object 1 in the hand.
What is empty was not measured. The figures do not show why a state is not solved, nor other tasks.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
import tyro

from benchmarks.pages import machine, machine_line, read_data, table, write_data, write_page
from benchmarks.train.learning import changed
from benchmarks.train.table1 import IDEAL
from concent_warp.cli.terminal import quiet_warp
from concent_warp.deploy.reality_world import reality_environment
from concent_warp.errors import ConcentError
from concent_warp.train.cfg import EnvironmentCfg, RandomisationCfg
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.policy.load import Policy
from concent_warp.train.resets.sample import ResetStates
from concent_warp.train.run import TrainingRun
from concent_warp.train.trials.episodes import Episodes, PolicyFunction

NAME = "train_stuck"
LOST = 0.05
"""Distance of a contact pair with the robot at which the block counts as lost [m]; in Reality it is grasped at other
points."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    policies: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Run folders; without any, the page is written from the stored data."""
    episodes: int = 64
    seed: int = 1
    """Of the initial states."""
    setpoint_lead_scale: float = 1.0
    """How far commands may run ahead of the joints, as of `concent evaluate`."""


def measure(folder: Path, args: Args) -> dict[str, Any]:
    """Return the successes of a policy in the three worlds, and from the states in which it fails in Reality."""
    loaded = Policy.load(folder).scaled(setpoint_lead_scale=args.setpoint_lead_scale)
    run = loaded.run
    task = run.task()
    states = run.evaluation_states(task, args.episodes, args.seed)
    trained = replace(
        run.cfg.environment, worlds=args.episodes, engine="mujoco", dropped=LOST, randomisation=RandomisationCfg()
    )
    own, whole = replace(trained, cone="auto", stride=1), replace(trained, collision="full")
    everything = run.task(whole)

    def policy(environment: Environment) -> PolicyFunction:
        torch.manual_seed(args.seed)
        return loaded.act_in(environment)

    def succeeded(cfg: EnvironmentCfg, starts: ResetStates) -> np.ndarray:
        environment = make_environment(everything if cfg is whole else task, cfg, starts, device="cpu")
        return outcomes(environment, policy(environment))[0]

    real = reality_environment(task, trained, states, IDEAL)
    success, failed = outcomes(real, policy(real))
    stuck = ~success & ~failed
    ended = {name: getattr(real.physics, name).numpy().copy() for name in ("qpos", "ctrl")}
    starts = replace(states, **ended, qvel=np.zeros_like(states.qvel))
    before, after = (held(real, qpos, states.mocap) for qpos in (states.qpos, ended["qpos"]))
    cosine = (np.einsum("nij,nij->n", before[1], after[1]) - 1) / 2
    turned, slid = np.degrees(np.arccos(cosine.clip(-1, 1))), np.linalg.norm(after[0] - before[0], axis=1)
    found = {
        "setpoint_lead_scale": args.setpoint_lead_scale,
        "turned": float(np.median(turned[stuck])) if stuck.any() else None,
        "slid": float(np.median(slid[stuck])) if stuck.any() else None,
        "episodes": args.episodes,
        "reality": int(success.sum()),
        "stuck": int(stuck.sum()),
        "settings": changed(json.loads(json.dumps(asdict(TrainingRun.load(folder).cfg)))),
        "machine": machine(),
    }
    for name, cfg in (("training", trained), ("own", own), ("all spheres", whole)):
        found[name] = int(succeeded(cfg, states).sum())
        found[f"{name}, from stuck"] = int(succeeded(cfg, starts)[stuck].sum()) if stuck.any() else 0
    return found


def held(environment: Environment, qpos: np.ndarray, mocap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where object 1 is in the frame of the tool [m] (N, 3), and its rotation there (N, 3, 3).

    Args:
        environment: Whose model the positions are of.
        qpos: Positions, shape (N, nq).
        mocap: Poses of what stands where it is put, shape (N, nmocap, 7).
    """
    m, task = environment.physics.model, environment.task
    d, site = mujoco.MjData(m), task.compiled.site(task.robot.tool).name
    places, rotations = [], []
    for row, poses in zip(qpos, mocap, strict=True):
        d.qpos[:], d.mocap_pos[:], d.mocap_quat[:] = row, poses[:, :3], poses[:, 3:]
        mujoco.mj_kinematics(m, d)
        tool = d.site(site)
        frame, body = tool.xmat.reshape(3, 3), task.objects[0]
        places.append(frame.T @ (d.xpos[body] - tool.xpos))
        rotations.append(frame.T @ d.xmat[body].reshape(3, 3))
    return np.array(places), np.array(rotations)


def outcomes(environment: Environment, policy: PolicyFunction) -> tuple[np.ndarray, np.ndarray]:
    """Run an episode in every world to the step before it would begin anew.

    Returns where object 1 is in place at that time, and where the episode had failed before, shape (N,) bool each.
    """
    episodes = Episodes(environment, policy, range(environment.num_envs))
    for _ in range(int(environment.max_episode_length) - 1):
        episodes.step()
    failed = ~episodes.running
    return environment.success.numpy() & ~failed, failed


def page(data: dict[str, dict[str, Any]]) -> str:
    """Return the page."""
    head = [
        "policy", "episodes", "in the physics of its training", "in the model's own", "with all spheres", "in Reality",
        "stuck there", "turned in the hand", "slid", "from these: in the physics of its training", "in the model's own",
        "with all spheres",
    ]  # fmt: skip
    names = ("episodes", "training", "own", "all spheres", "reality", "stuck")
    lines = [
        [
            name,
            *(str(row.get(n, "")) for n in names),
            *in_the_hand(row),
            *(str(row.get(f"{n}, from stuck", "")) for n in names[1:4]),
        ]
        for name, row in data.items()
    ]
    settings = [
        f"- {name}: {f'`{how}`' if (how := row['settings']) else 'default settings'}" for name, row in data.items()
    ]
    assert __doc__ is not None
    about = __doc__.split("\n\n")
    return "\n\n".join([
        "# What keeps policies from succeeding in Reality",
        "Written by `benchmarks/train/stuck.py`; do not edit.",
        about[0],
        about[2].strip(),
        "Episodes in which object 1 is in place at the end:",
        table(head, lines),
        *dict.fromkeys(machine_line(row["machine"]) for row in data.values()),
        "Settings of the trainings:\n\n" + "\n".join(settings),
    ])  # fmt: skip


def in_the_hand(row: dict[str, Any]) -> list[str]:
    """Return how far object 1 is turned and shifted in the hand in stuck states, empty where it was not measured."""
    if row.get("turned") is None:
        return ["", ""]
    return [f"{row['turned']:.0f} deg", f"{1e3 * row['slid']:.0f} mm"]


def main() -> None:
    """Measure policies and write the page."""
    args = tyro.cli(Args, description=__doc__)
    quiet_warp()
    torch.set_num_threads(1)
    data = read_data(NAME)
    for folder in args.policies:
        name = "/".join(part for part in folder.parts[-4:] if part not in ("runs", "policy"))
        name += f", lead scale {args.setpoint_lead_scale:g}" * (args.setpoint_lead_scale < 1)
        try:
            data[name] = measure(folder, args)
        except ConcentError as error:
            raise SystemExit(str(error)) from None
        print(name, data[name], flush=True)
    write_data(NAME, data)
    write_page(NAME, page(data))


if __name__ == "__main__":
    main()
