"""The paper's Table 1 in Reality: policies of several cases and seeds, all from the same initial states.

    python -m benchmarks.train.table1 --out runs/table1 --processes 16    # what is not tried yet, then the page
    python -m benchmarks.train.table1 --out runs/table1 --table           # the page alone

The policies are those that `benchmarks/train/learning.py` trained, in simulation alone.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
import torch
import tyro
from joblib import Parallel, delayed

from benchmarks.measurements import Measurements, Row
from benchmarks.pages import machine, machine_line, read_data, table, write_data, write_page
from benchmarks.train.cases import CASES, HIDDEN, Case, same_world
from benchmarks.train.learning import POLICY, RESULT, changed
from concent_warp.cli.terminal import quiet_warp
from concent_warp.deploy.cfg import RealityWorldCfg
from concent_warp.deploy.reality_world import reality_environment
from concent_warp.reality.variation import VariationCfg
from concent_warp.reality.world import WorldCfg
from concent_warp.train.environment.environment import Environment
from concent_warp.train.observation_cfg import SensorErrorsCfg
from concent_warp.train.policy.load import Policy
from concent_warp.train.resets.reset_states import ResetStates
from concent_warp.train.run import TrainingRun
from concent_warp.train.task.held_arm import holding_leads
from concent_warp.train.task.task import Task
from concent_warp.train.trials.evaluate import run_episodes, wilson

NAME = "train_table1"
TOLERANCE, HOLD = 0.004, 2
"""Distance [m] within which all pairs of a target event are, and control steps for which, when it counts as met."""
IDEAL = RealityWorldCfg(reality=WorldCfg(), variation=VariationCfg(enabled=False), sensors=SensorErrorsCfg(exact=True))
"""Reality with the friction, masses, gains and integrator of the model, observed exactly."""
PAPER = {"ours": "80 %", "surface": "20 %", "engineered": "50 %", "unconstrained": "30 %"}
ABOUT = f"""\
Policies trained in simulation, then run without exploration in Reality as it was until 2026-11-25: exact chamfered
shapes in place of spheres, elliptic cones, shorter time steps; friction, masses, gains and integrator of the model;
the exact state observed. [Trials](train_trials.md) are without these. The settings named are those of that time. A
seed is a demonstration with its own geometry, contact events and policy. All cases of a seed start from the same
initial states, which training has not seen: displaced along the demonstration, block in the hand, and filtered for
stability in the model of *ours*, which may favour it. An episode succeeds where the block ends within 3 mm of its
place at the bottom of the hole. Shares are pooled over seeds, with Wilson's 95 % interval of these policies; the
column *seeds* shows how much trainings differ.

Used to choose settings: seeds 0 to 2; with random force perturbations seeds 0 and 3 to 5; `grasp-turn 0.6` seeds 5 to
7; the lead scale seeds 0 and 3 to 8; `turn-lead` seeds 3 to 5. Seeds 9 to 11 were used for no choice, but smaller
leads and more exploration, tried on them as well, did worse and were dropped. The hidden delay is the third effect
tried, after weaker gravity compensation and joint compliance. Under weaker gravity compensation the initial states
have grasps that the robot never had, those of a replay without the effect: its rows say nothing of what the effect in
the model is worth ([later trials](train_hidden.md)).

- *ours*: contact geometry fitted to the demonstration, contact-event reward.
- *without contact geometry optimisation*: the paper's starting geometry, spheres centred on the surface. **Not
  comparable**: the demonstration cannot be replayed into the hole, so the policy is trained on *align* and judged by
  insertion.
- *without optimisation, spheres inset*: the package's starting geometry.
- *without contact-event reward*: the engineered reward (paper, appendix G).
- *unconstrained*: the paper's starting geometry and the engineered reward; **not comparable** either.
- *an effect hidden*: in the world of the demonstration and of the trial. *added*: the model has the effect, fitted to
  that demonstration, and the training samples its parameters from the intervals of that fit.

*Targets met*: share of the target events of all stages that a policy brings about in their order: all pairs of an
event within {1e3 * TOLERANCE:.0f} mm for {HOLD} control steps. *In simulation*: success of the same policies in the
model that they were trained in, for its last stage.
"""


@dataclass(frozen=True)
class Args:
    """Command line."""

    out: Path
    """Folder with the trainings."""
    cases: tuple[str, ...] = tuple(CASES)
    seeds: tuple[int, ...] = (0, 1, 2)
    stage: Literal["insert", "all"] = "insert"
    episodes: int = 200
    """Initial states of each seed."""
    hidden: str = HIDDEN
    """Effect that is hidden in the world of some cases."""
    setpoint_lead_scale: float = 1.0
    """How far commands may run ahead of the joints, as of `concent evaluate`."""
    processes: int = 1
    table: bool = False
    """Write the page from what is there, without runs."""


class Watcher:
    """Keeps where everything is in each episode."""

    def __init__(self, episodes: int) -> None:
        """Begin without any."""
        self.states: list[list[np.ndarray]] = [[] for _ in range(episodes)]

    def __call__(self, episodes: np.ndarray, qpos: np.ndarray) -> None:
        """Keep positions (R, nq) of the episodes (R,)."""
        for episode, state in zip(episodes, qpos, strict=True):
            self.states[episode].append(state.copy())


def policy_folder(args: Args, case: str, seed: int) -> Path:
    """Return the folder of a trained policy."""
    return args.out / "runs" / f"{case}_{args.stage}_{seed}" / POLICY


def key(args: Args, case: str, seed: int) -> str:
    """Return the name under which the trial of a policy is to be kept."""
    result = json.loads((policy_folder(args, case, seed).parent / RESULT).read_text())
    row = {
        "settings": changed(result["settings"]),
        "trained": result,
        "setpoint_lead_scale": args.setpoint_lead_scale,
        "hidden": hidden(args, case),
    }
    return named({"case": case, "seed": seed, **row}, args.stage)


def hidden(args: Args, case: str) -> list[str]:
    """Return what is hidden in the world of a case."""
    return [args.hidden] if CASES[case].world == "hidden" else []


def named(row: Row, stage: str) -> str:
    """Return the name under which a trial is kept."""
    how, seconds, lead = manner(row)
    gently = f"--setpoint-lead-scale {lead:g}" * (lead < 1)
    without = " ".join(["hiding", *row["hidden"]]) if row.get("hidden") else ""
    return " ".join(f"{row['case']} {stage} {row['seed']} {seconds} s {how} {gently} {without}".split())


def reference(case: Case) -> str:
    """Return the case whose model gives initial states and target events to all cases of a world."""
    return "ours" if case.world == "plain" else "unaware"


def trial(
    args: Args,
    name: str,
    seed: int,
    world: RealityWorldCfg = IDEAL,
    states: ResetStates | None = None,
    *,
    own: bool = False,
) -> Row:
    """Run a policy in Reality, by default in one that it knows and observes exactly.

    Args:
        args: Where the policy is, episodes and what is hidden.
        name: Case.
        seed: Seed of the policy.
        world: Reality.
        states: Initial states; by default those of the case that is the reference.
        own: Whether the reference is the case itself.
    """
    quiet_warp()
    torch.set_num_threads(1)
    case, folder = CASES[name], policy_folder(args, name, seed)
    policy = Policy.load(folder).scaled(setpoint_lead_scale=args.setpoint_lead_scale)
    run = policy.run
    judge = run if own else TrainingRun.load(policy_folder(args, reference(case), seed))
    task, shown = run.task(), judge.task()
    states = judge.evaluation_states(shown, args.episodes, seed) if states is None else states
    # A model in which the demonstration does not get as far has fewer stages.
    starts = replace(states, stage=np.clip(states.stage, task.first, task.stage), ctrl=states.ctrl.copy())
    # The robot is held in them by the commands that the policy's own model takes for right.
    arm = task.robot.actuator
    starts.ctrl[:, arm] += leads(task, states.qpos) - leads(shown, states.qpos)
    torch.manual_seed(seed)
    hide = hidden(args, name)
    # Each model has contact points of its own to tell a lost block by; here its place at the end tells.
    cfg = replace(run.cfg.environment, worlds=min(args.episodes, 32), engine="mujoco", dropped=0.05)
    environment = reality_environment(task, cfg, starts, replace(world, hide=tuple(hide)), seed=seed)
    watcher = Watcher(args.episodes)
    found = run_episodes(environment, policy.act_in(environment), starts, watch=watcher)
    met = [
        targets_met(shown, environment, np.array(qpos), mocap)
        for qpos, mocap in zip(watcher.states, states.mocap, strict=True)
    ]
    stages = len(shown.events.stages)
    result = json.loads((folder.parent / RESULT).read_text())
    return {
        "case": name, "seed": seed, "episodes": args.episodes, "successes": int(found.success.sum()),
        "outcomes": found.counts(), "stages": stages, "met": met, "hidden": hide,
        "simulation": result["simulation"], "stress": result.get("stress"),
        "trained": {k: result[k] for k in ("stage", "steps", "seconds", "worlds")},
        "machine": machine(), "trained_on": result["machine"], "settings": changed(result["settings"]),
        "setpoint_lead_scale": args.setpoint_lead_scale,
    }  # fmt: skip


def leads(task: Task, qpos: np.ndarray) -> np.ndarray:
    """Return by how much a task's model has commands lead the arm's joints to hold it at positions (R, nq)."""
    return holding_leads(task.compiled, mujoco.MjData(task.compiled), task.robot.actuator, qpos)


def targets_met(task: Task, environment: Environment, qpos: np.ndarray, mocap: np.ndarray) -> int:
    """Return how many target events of a demonstration an episode brings about in their order.

    Args:
        task: Its contact pairs are those of the demonstration.
        environment: Whose model the positions are of.
        qpos: Positions at each control step, shape (T, nq).
        mocap: Poses of what stands where it is put, shape (nmocap, 7).
    """
    m = environment.physics.model
    d = mujoco.MjData(m)
    d.mocap_pos[:], d.mocap_quat[:] = mocap[:, :3], mocap[:, 3:]
    met = held = 0
    for state in qpos:
        if met == len(task.events.stages):
            break
        d.qpos[:] = state
        mujoco.mj_kinematics(m, d)
        held = held + 1 if apart(task, met, d) < TOLERANCE else 0
        if held == HOLD:
            met, held = met + 1, 0
    return met


def apart(task: Task, stage: int, d: mujoco.MjData) -> float:
    """Return the largest distance of the contact pairs of a stage's target event [m], infinite where it has none."""
    pairs, used = task.table, task.table.used[stage]
    if not used.any():
        return np.inf
    sides = []
    for body, point in ((pairs.body_a, pairs.point_a), (pairs.body_b, pairs.point_b)):
        bodies = body[stage][used]
        sides.append(d.xpos[bodies] + np.einsum("nij,nj->ni", d.xmat[bodies].reshape(-1, 3, 3), point[stage][used]))
    return float(np.linalg.norm(sides[0] - sides[1], axis=1).max())


def page(rows: Sequence[Row], stage: str) -> str:
    """Return the page."""
    title = "# Table 1 in Reality" + (": all stages chained" if stage == "all" else "")
    parts = [title, "Written by `benchmarks/train/table1.py`; do not edit.", ABOUT]
    groups: dict[tuple[str, int, float], list[Row]] = {}
    for row in rows:
        groups.setdefault(manner(row), []).append(row)
    ordered = sorted(groups.items(), key=lambda one: (-len(one[1]), one[0]))
    parts += ["## Ours at a glance", overview(ordered)]
    if any(row.get("hidden") for row in rows):
        parts += ["## With an effect hidden, at a glance", overview_of_hidden(ordered)]
    compared = [one for one in ordered if len({row["case"] for row in one[1]}) > 1]
    for what, name in (("Trials", "machine"), ("Policies", "trained_on")):
        parts += [f"{what}: {line}" for line in dict.fromkeys(machine_line(row[name]) for row in rows)]
    parts += ["## Several cases"] * bool(compared)
    for (how, seconds, lead), group in compared:
        gently = "" if lead == 1 else f", run with `--setpoint-lead-scale {lead:g}`"
        parts.append(f"### {seconds} s of training with " + (f"`{how}`" if how else "the default settings") + gently)
        parts += section(group)
    return "\n\n".join(parts)


def overview(groups: Sequence[tuple[tuple[str, int, float], Sequence[Row]]]) -> str:
    """Return a table of the case that all is about, by the ways in which it was trained and run.

    Those of three seeds and more come first, then the better ones.
    """
    lines = []
    for (how, seconds, lead), group in groups:
        of = sorted((row for row in group if row["case"] == "ours"), key=lambda row: row["seed"])
        if of:
            share, shown = pooled(of)
            name = f"`{how}`" if how else "default settings"
            lines.append(((len(of) < 3, -share), [name, f"{seconds}", f"{lead:g}", *shown, f"{targets(of):.0%}"]))
    head = ["trained with", "seconds", "lead scale", "succeed", "95 % interval", "episodes", "seeds", "targets met"]
    return table(head, [line for _, line in sorted(lines)])


def overview_of_hidden(groups: Sequence[tuple[tuple[str, int, float], Sequence[Row]]]) -> str:
    """Return a table of the cases with an effect hidden, by the effect and by the ways of training and running."""
    lines = []
    for (how, seconds, lead), group in groups:
        for title, of in by_title(row for row in group if row.get("hidden")).items():
            name = f"`{how}`" if how else "default settings"
            order = (of[0]["hidden"], how, seconds, lead, list(CASES).index(of[0]["case"]))
            lines.append((order, [title, name, f"{seconds}", f"{lead:g}", *pooled(of)[1]]))
    head = ["case", "trained with", "seconds", "lead scale", "succeed", "95 % interval", "episodes", "seeds"]
    return table(head, [line for _, line in sorted(lines)])


def by_title(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Return the rows of each case and of what is hidden in it, in the order of cases and seeds."""
    found: dict[str, list[Row]] = {}
    for row in sorted(rows, key=lambda row: (list(CASES).index(row["case"]), row.get("hidden", []), row["seed"])):
        found.setdefault(titled(row), []).append(row)
    return found


def pooled(of: Sequence[Row]) -> tuple[float, list[str]]:
    """Return the success of all policies of a case, and as a table shows it: with interval, counts and seeds."""
    successes, episodes = sum(r["successes"] for r in of), sum(r["episodes"] for r in of)
    low, high = wilson(successes, episodes)
    each = ", ".join(f"{r['seed']}: {r['successes'] / r['episodes']:.0%}" for r in of)
    share = successes / episodes
    return share, [f"{share:.1%}", f"{low:.1%} to {high:.1%}", f"{successes} of {episodes}", each]


def targets(of: Sequence[Row]) -> float:
    """Return the share of target events that the policies of a case bring about in their order."""
    return float(np.mean([np.mean(row["met"]) / row["stages"] for row in of]))


def manner(row: Row) -> tuple[str, int, float]:
    """Return the settings of a training, its length to 5 s, and the lead scale with which the policy was run."""
    return row.get("settings", ""), 5 * round(row["trained"]["seconds"] / 5), row.get("setpoint_lead_scale", 1.0)


def titled(row: Row) -> str:
    """Return what a case is called, with what is hidden."""
    hidden = row.get("hidden", [])
    return CASES[row["case"]].title + f" ({', '.join(hidden)})" * bool(hidden)


def section(rows: Sequence[Row]) -> list[str]:
    """Return what there is to say of policies that were trained in one way."""
    groups, lines = by_title(rows), []
    for title, of in groups.items():
        simulation = np.mean([r["simulation"]["rate"] for r in of])
        lines.append([title, *pooled(of)[1], PAPER.get(of[0]["case"], ""), f"{targets(of):.0%}", f"{simulation:.1%}"])
    head = ["case", "succeed", "95 % interval", "episodes", "seeds", "paper", "targets met", "in simulation"]
    parts = [table(head, lines)]
    tried = {row["case"] for row in rows}
    absent = [case.title for name, case in CASES.items() if name not in tried]
    for what in sorted({tuple(row.get("hidden", ())) for row in rows}):
        ordered = order([of for of in groups.values() if tuple(of[0].get("hidden", ())) == what])
        parts += [ordered] if ordered else []
    if absent:
        parts.append(f"Not tried: {'; '.join(absent)}.")
    parts.append("How the episodes ended, and what the policies were trained for:")
    parts.append(
        table(["case, seed", "outcomes", "stage", "steps", "seconds"], [ended(r) for of in groups.values() for r in of])
    )
    return parts


def order(groups: Sequence[Sequence[Row]]) -> str:
    """Return a sentence on the order of cases of a world, by the seeds that all of them have; empty without such."""
    seeds = set.intersection(*({row["seed"] for row in of} for of in groups)) if len(groups) > 1 else set()
    if not seeds:
        return ""
    found = {titled(of[0]): pooled([row for row in of if row["seed"] in seeds])[0] for of in groups}
    text = " > ".join(f"{case}, {found[case]:.1%}" for case in sorted(found, key=lambda case: -found[case]))
    return f"In the order found, on the seeds that all have ({', '.join(map(str, sorted(seeds)))}): {text}."


def ended(row: Row) -> list[str]:
    """Return how the episodes of a policy ended."""
    outcomes = ", ".join(f"{count} {name}" for name, count in row["outcomes"].items())
    trained: dict[str, Any] = row["trained"]
    name = f"{titled(row)}, {row['seed']}"
    return [name, outcomes, trained["stage"], f"{trained['steps']:,}", f"{trained['seconds']:.0f}"]


def main() -> None:
    """Try what is not tried, and write the page."""
    args = tyro.cli(Args, description=__doc__)
    same_world(args.out, args.cases, args.seeds, args.hidden)
    name = NAME if args.stage == "insert" else f"{NAME}_chain"
    kept = Measurements(args.out / f"{name}.jsonl")
    jobs = []
    for case in () if args.table else args.cases:
        for seed in args.seeds:
            needed = [policy_folder(args, one, seed) for one in (case, reference(CASES[case]))]
            if missing := [folder for folder in needed if not folder.is_dir()]:
                print(f"not trained yet: {missing[0]}", flush=True)
            elif kept.wanted(key(args, case, seed)):
                jobs.append((case, seed))
    found = Parallel(n_jobs=args.processes, return_as="generator")(delayed(trial)(args, *job) for job in jobs)
    for (case, seed), row in zip(jobs, found, strict=True):
        if row is not None:
            kept.add(key(args, case, seed), row)
    rows = [*read_data(name).values(), *kept.rows.values()]
    data = {named(row, args.stage): row for row in rows}
    write_data(name, data)
    write_page(name, page(list(data.values()), args.stage))


if __name__ == "__main__":
    main()
