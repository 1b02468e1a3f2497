"""Does a policy gain by a hidden effect that was found and added to the model? Trials in Reality with the effect.

    python -m benchmarks.train.cases --out D --cases unaware aware randomised --hidden actuator_delay=0.2 --edges 400
    python -m benchmarks.train.learning --out D --cases unaware aware randomised --seconds None
    python -m benchmarks.train.hidden D E --hidden actuator_delay=0.2 gravity_compensation=-0.4    # and the page
    python -m benchmarks.train.hidden                                                              # the page alone

A folder holds trainings of demonstrations in a world in which one effect is hidden.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from joblib import Parallel, delayed

from benchmarks.measurements import Measurements, Row
from benchmarks.pages import machine_line, read_data, table, write_data, write_page
from benchmarks.train.cases import CASES, TASKS, demonstrate, same_world
from benchmarks.train.learning import RESULT
from benchmarks.train.table1 import Args as Table1Args
from benchmarks.train.table1 import policy_folder, trial
from benchmarks.train.trials import NAME as TRIALS
from concent_warp.cli.terminal import quiet_warp
from concent_warp.deploy.cfg import RealityWorldCfg
from concent_warp.train.resets.reset_states import ResetStates
from concent_warp.train.run import TrainingRun
from concent_warp.train.trials.evaluate import wilson

NAME = "train_hidden"
OF_A_WORLD = ("unaware", "randomised", "aware")
"""Cases that are compared, the one without any answer to the effect first."""
FRESH = 40, 49
"""Seeds of trials with nothing hidden that the cost of an effect is measured against, those that chose nothing."""
ABOUT = """\
`python -m benchmarks.train.hidden FOLDERS --hidden EFFECTS`: an effect is hidden in the Reality in which the
demonstration is recorded and the policy is tried; everything else is as in the [trials](train_trials.md) of insertion,
with unknown friction, masses and gains and noisy sensors. A seed is a demonstration, repeated until it succeeds, a
geometry fitted to it, and the policies. Policies of a seed start from the same states, displaced along the
demonstration as it truly was: the replay of a model without the effect may grasp the block elsewhere than the robot
did, under weak gravity compensation by 13 mm. All are trained by default settings.

- *unaware*: the model lacks the effect.
- *randomised*: the effect is known to be possible, not how large it is: each world of the training draws its parameter
  from a wide interval (delay 0 to 0.3 s, gravity compensation wrong by -0.6 to 0.6). Geometry as of *unaware*.
- *aware*: the effect is in the model, fitted to the same demonstration before the geometry is, and drawn from the
  interval of that fit. Which effect it is was told, not diagnosed.

*Recovered*: share of what the effect costs the unaware policy that another gets back, where policies without a hidden
effect succeed in {reference:.1%} of trials (default settings, other seeds: {first} to {last}); its interval is from
a bootstrap over seeds and episodes, which says little with so few seeds; none where there is one seed.

How large the effects are was chosen by 60 trials each of two policies of seeds 40 and 44, trained without an effect:
delays of 0.1 s, a compliance of 0.004 rad/(N m), Coulomb friction of 2 N m and pads of half the friction cost them 0 to
2 %.

Why no policy succeeds under weak gravity compensation: the arm sags by 13 mm, so that the block is grasped higher than
planned. In the hole the fingers come to rest on the box while the block is 7 mm above the bottom; the demonstration
succeeds since it lets go there. A training of insertion ends with the target event, before that, and a trial counts a
block at the bottom. *Aware* policies reach the demonstrated end, in five trials looked at. Earlier figures, 81 %
unaware against 10 % aware, were of trials that started from the grasp that a replay without the effect has, which the
robot never had; from such states these policies have 76 and 58 % unaware, 0 and 12 % aware. Two faults were found on
the way, by looking at seed 50: an arm whose weight is not borne was not held by the commands of initial states, and a
finger on the box counted as a grasp that was lost at once. The *aware* policies here are trained without them.

Begun and not tried: *aware* of seed 50 under weak gravity compensation before the second mend (35 % in training);
*aware* of seed 51 with a delay, whose model was missing; *aware* and *unaware* of seed 52 with a delay, which ended
with the machine that they ran on. One more *aware* of seed 50 with a delay, observing five steps at once, was tried
from other states alone: 200 of 200, as by default settings.
"""


@dataclass(frozen=True)
class Args:
    """Command line."""

    folders: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Folders of trainings; without any, the page is written from the stored data."""
    hidden: tuple[str, ...] = ()
    """Effect that is hidden in the world of each folder, name=value."""
    episodes: int = 200
    """Episodes of a trial."""
    processes: int = 1


def measure(args: Table1Args, name: str, seed: int) -> Row:
    """Try a policy from states along the true demonstration."""
    quiet_warp()
    return trial(args, name, seed, RealityWorldCfg(), true_states(args, seed))


def true_states(args: Table1Args, seed: int) -> ResetStates:
    """Return initial states displaced along a demonstration as it truly was, the same for all cases of a seed.

    Where a model lacks an effect its replay may grasp the object elsewhere than the robot did.
    """
    judge = TrainingRun.load(policy_folder(args, OF_A_WORLD[0], seed))
    task = judge.task()
    _, truth = demonstrate(seed, (args.hidden,), TASKS["shape_sorter"])
    times = task.replay.timestep * np.arange(len(task.replay.qpos))
    rows = np.clip(np.searchsorted(truth.time, times), 0, len(truth.time) - 1)
    true = replace(task.replay, qpos=truth.qpos[rows])
    return judge.evaluation_states(replace(task, replay=true), args.episodes, seed)


def trainings(args: Table1Args) -> list[tuple[str, int]]:
    """Return case and seed of the trainings of a folder that have ended.

    Raises:
        SystemExit: There is none, or the world of one hides something else.
    """
    ended = [
        (name, int(path.parent.name.rsplit("_", 1)[1]))
        for name in OF_A_WORLD
        for path in sorted((args.out / "runs").glob(f"{name}_{args.stage}_*/{RESULT}"))
    ]
    if not ended:
        raise SystemExit(
            f"{args.out}: no ended training of {', '.join(OF_A_WORLD)}; make them by benchmarks.train.learning"
        )
    for name, seed in ended:
        same_world(args.out, [name], [seed], args.hidden)
    return ended


def page(rows: Sequence[Row], reference: float) -> str:
    """Return the page.

    Args:
        rows: Trials with an effect hidden.
        reference: Success of policies where nothing is hidden.
    """
    about = ABOUT.format(reference=reference, first=FRESH[0], last=FRESH[1])
    parts = ["# Policies and hidden effects", "Written by `benchmarks/train/hidden.py`; do not edit.", about]
    for effect in dict.fromkeys(row["hidden"][0] for row in rows):
        of = [row for row in rows if row["hidden"] == [effect]]
        parts += [f"## `{effect}`", effect_table(of, reference)]
    for what, name in (("Trials", "machine"), ("Policies", "trained_on")):
        parts += [f"{what}: {line}" for line in dict.fromkeys(machine_line(row[name]) for row in rows)]
    return "\n\n".join(parts)


def effect_table(rows: Sequence[Row], reference: float) -> str:
    """Return a table of the cases with one effect hidden."""
    unaware = {row["seed"]: row for row in rows if row["case"] == OF_A_WORLD[0] and not row["settings"]}
    groups: dict[tuple[int, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((OF_A_WORLD.index(row["case"]), row["settings"]), []).append(row)
    lines = []
    for (number, settings), of in sorted(groups.items()):
        of.sort(key=lambda row: row["seed"])
        count, episodes = sum(row["successes"] for row in of), sum(row["episodes"] for row in of)
        low, high = wilson(count, episodes)
        each = ", ".join(f"{row['seed']}: {rate(row):.1%}" for row in of)
        pairs = [(unaware[row["seed"]], row) for row in of if row["seed"] in unaware]
        gained = recovered(pairs, reference) if number and pairs else ""
        name = CASES[OF_A_WORLD[number]].title + (f", `{settings}`" if settings else "")
        simulated = f"{np.mean([row['simulation']['rate'] for row in of]):.1%}"
        lines.append([name, f"{count / episodes:.1%}", f"{low:.1%} to {high:.1%}", each, gained, simulated])
    return table(["case", "succeed", "95 %", "seeds", "recovered", "in simulation"], lines)


def rate(row: Row) -> float:
    """Return the share of successful episodes."""
    return row["successes"] / row["episodes"]


def recovered(pairs: Sequence[tuple[Row, Row]], reference: float) -> str:
    """Return the share of an effect's cost that a second policy gets back, over seeds, with its 95 % interval.

    Args:
        pairs: Trials of the unaware and of the other policy of each seed.
        reference: Success where nothing is hidden.
    """
    rng = np.random.default_rng(0)
    found = np.array([[rate(one) for one in pair] for pair in pairs])
    episodes = np.array([[one["episodes"] for one in pair] for pair in pairs])
    seeds = rng.integers(len(pairs), size=(4000, len(pairs)))
    before, after = (rng.binomial(episodes[seeds], found[seeds]) / episodes[seeds]).mean(axis=1).T
    drawn = (after - before) / np.maximum(reference - before, 1e-3)
    before, after = found.mean(axis=0)
    if before >= reference:
        return "no cost"
    low, high = np.percentile(drawn, [2.5, 97.5])
    interval = f" [{low:.0%}, {high:.0%}]" if len(pairs) > 1 else ""
    return f"{(after - before) / (reference - before):.0%}{interval}"


def without_effect() -> float:
    """Return the success of our policies by default settings in trials of insertion with nothing hidden."""
    of = [
        row for row in read_data(TRIALS).values()
        if row["case"] == "ours" and FRESH[0] <= row["seed"] <= FRESH[1] and not row["settings"]
        and (row.get("task", "shape_sorter"), row.get("stage", "insert")) == ("shape_sorter", "insert")
    ]  # fmt: skip
    return float(np.mean([rate(row) for row in of]))


def main() -> None:
    """Try what is not tried yet, and write the page."""
    args = tyro.cli(Args, description=__doc__)
    if len(args.hidden) != len(args.folders):
        raise SystemExit("--hidden names the effect of each folder, in their order")
    data = read_data(NAME)
    for folder, effect in zip(args.folders, args.hidden, strict=True):
        kept = Measurements(folder / f"{NAME}.jsonl")
        given = Table1Args(out=folder, episodes=args.episodes, hidden=effect)
        ended = trainings(given)
        left = [one for one in ended if kept.wanted(f"{folder.name} {effect} {one[0]} {one[1]}")]
        jobs = (delayed(measure)(given, *one) for one in left)
        found = Parallel(n_jobs=args.processes, return_as="generator")(jobs)
        for (name, seed), row in zip(left, found, strict=True):
            assert row is not None
            kept.add(f"{folder.name} {effect} {name} {seed}", row)
        data |= kept.rows
    write_data(NAME, data)
    write_page(NAME, page(list(data.values()), without_effect()))


if __name__ == "__main__":
    main()
