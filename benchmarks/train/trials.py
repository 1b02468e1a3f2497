"""Trials of policies in a Reality whose friction, masses and gains nobody knows, seen through sensors; and a page.

    python -m benchmarks.train.cases --out runs/a --cases ours --seeds 12 13
    python -m benchmarks.train.learning --out runs/a --cases ours --seeds 12 13 --train.ppo.iterations 100
    python -m benchmarks.train.trials runs/a runs/b --processes 8     # policies of these folders, then the page
    python -m benchmarks.train.trials runs/c --case inset             # those of another case, from its own states
    python -m benchmarks.train.trials                                 # the page alone

A folder holds trainings with one set of settings, as `benchmarks/train/learning.py` makes them. The stress test is
repeated here for all policies, on a CPU, from other initial states than those by which a policy was chosen.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from joblib import Parallel, delayed
from scipy.stats import rankdata, ttest_rel

from benchmarks.measurements import Measurements, Row
from benchmarks.pages import machine_line, read_data, table, write_data, write_page
from benchmarks.train.cases import CASES
from benchmarks.train.learning import RESULT, changed
from benchmarks.train.table1 import Args as Table1Args
from benchmarks.train.table1 import policy_folder, trial
from concent_warp.deploy.cfg import RealityWorldCfg
from concent_warp.train.policy.load import Policy
from concent_warp.train.trials.evaluate import wilson

NAME = "train_trials"
TITLES = {
    ("shape_sorter", "insert"): "Insertion",
    ("shape_sorter", "all"): "The whole task",
    ("round_peg", "insert"): "A round peg",
    ("stacking", "insert"): "Stacking",
}
"""Titles of the sections by task and stage; *insert* is a task's last stage."""
FRESH = 30
"""First seed that was trained after the stress test was made."""
ABOUT = """\
`python -m benchmarks.train.trials FOLDERS`: insertion by policies trained in simulation, in a Reality that neither
the model nor the policy knows. In each episode the objects' friction is 0.2 to 0.5 (0.3 in the model), that of the
fingers 0.8 to 1.2 times, masses 0.9 to 1.1 times, gains 0.95 to 1.05 times the model's; shapes are exact, with
chamfered edges, steps 0.5 ms, the integrator Euler's. The demonstration that the geometry was fitted to was recorded
in such a world. The policy sees encoder readings (0.2 mrad of noise, steps of 0.1 mrad), velocities as their
differences, and object poses at 30 Hz with 1 mm and 1 degree of noise per axis, a quarter of the variance constant
over an episode, 5 % of frames lost, one to two frames late. An episode succeeds where the block ends within 3 mm of
its place at the bottom of the hole after 3 s. A seed is a demonstration, a fitted geometry and a policy; intervals
are Wilson's, of these policies.

*In simulation*: success in the training's own worlds. *Stress test*: the same policy in the model with the shapes of
the scene in place of spheres, stiff contacts, short steps, and friction factors of 0.6 or 1.7 (`StressCfg`). With all
spheres in its physics the test does not predict success: fitted geometries differ in how hard they are. The shapes of
the scene are those of Reality but for the chamfers of its edges; where a scene's shapes are wrong, the test is too.
Shapes and starting grasps, now as demonstrated, were chosen by looking at the policies of seeds 12 to 21: from turned
grasps, as in training, their correlation is 0.51 [-0.02, 0.90].

What the figures do not show: tasks without a section of their own; policies trained for longer; how far one or two
seeds speak for settings. Seeds 12 to 15 were used to choose; so was the seed of the whole task whose policy is shipped,
by the stress test. The trainings of seeds 12, 13, 20 and 21 kept their last policy, the others that of the best stress
test.

Trainings that ended early with the machine that they ran on, and were not tried: `--environment.action.turn-lead
0.015` with seeds 12 and 13; without edges seeds 20 to 25; insertion with seed 15; the whole task with seed 15 after
240 s (52 % in training) and, with `turn 0.006`, seed 14 after 230 s (0 %). Ten with geometry fitted with edge
spheres, seeds 30 to 39, ended so after 160 of 300 iterations; their stress tests after 50, 100 and 150 were alike, so
that 100 iterations were made the second time, of seeds 30 to 37; 38 and 39 found no time. Of the first time two
policies were kept, seed 33, which succeeds in 191 of 200 trials, and one of a round peg, seed 30 after 90 iterations,
in 187 of 200 (`concent evaluate --checkpoint POLICY --world reality --episodes 200`; they are not in the repository).
Trainings of seeds 30 to 37 shared a GPU by twos.

Two more tasks, a round peg and stacking, seeds 60 to 62, which were used for nothing before (`python -m
benchmarks.train.cases --task round_peg --cases ours --seeds 60 61 62 --edges 400`, then `benchmarks.train.learning
--seconds 800`, 2026-11-28), were begun twice. Six trainings that shared two H200s by threes ended with the machine: of
the peg 90 to 97 of 100 iterations were made, and the policies of their only stress test, after 50, succeed in 192, 190
and 175 of 200 trials, 93 % (`concent evaluate --checkpoint RUN --world reality --episodes 200 --seed 7`, AMD EPYC, 2
cores); of stacking 38 to 41 iterations were made, and none was tried. The second time one task had a GPU to itself,
beside diagnoses on all processors: the peg's seeds 60 and 61 and stacking's seed 60 came to their end, and have the
sections below; the peg's seed 62 and stacking's seed 61 ended with the machine, twice each, and were not tried;
stacking's seed 62 was not begun. A third time, later that day, one task had a GPU to itself beside 30 diagnoses: the
peg's seed 62 and stacking's seeds 61 to 63 came to their end (268, 458, 465 and 474 s of learning; 98.8, 99.9, 100 and
100 % in simulation), but their weights were left behind on the machine by mistake: none of the four was tried.
The fourth time, the same day, the peg's seed 62 and stacking's seeds 61 and 62 were trained once more, one after
another on one GPU beside 15 diagnoses (263, 482 and 489 s of learning), and are in the sections below.

Without a fit of the contact geometry (`--cases inset --edges 400`, default settings; trials with `--case inset`) seeds
40 to 44 were trained on 2026-11-29. The policies of 43 and 44 (100 and 99.8 % in simulation) were left behind on the
machine, and a second training of each was cut off. The third one of each, on 2026-11-30, is in the table. The settings
were chosen with fitted geometry. From other initial states the policies of 40 to 42 succeed in 198, 200 and 198 of 200
trials (`concent evaluate --checkpoint POLICY --world reality --episodes 200`).

With the engineered reward in place of the contact events (`--cases engineered --edges 400`, default settings; trials
with `--case engineered`) seeds 40 to 49 were trained on 2026-11-29, each on one H200, 40 to 44 beside 14 diagnoses and
45 to 49 beside 28 and another training on a second GPU, in the contact geometries that ours have; learning took 137 to
154 s. The settings were chosen with the reward of contact events.

From the paper's starting geometry, spheres centred on the surface, with the reward of contact events (`--cases surface
--edges 400`) and with the engineered one (`--cases unconstrained --edges 400`), seeds 40 to 42 were trained on
2026-11-30 with default settings, one after another on one H200 beside 15 diagnoses; learning took 120 to 145 s.
Spheres that stand out of the surface by their radius fill the hole: in such a model the demonstration does not get
into it, so that insertion is no stage, and policies learn the last stage that there is, *align*. Their success in
simulation and in the stress test is that of this stage; with the engineered reward there is none in simulation. In the
trial they are judged by insertion, as all others: in Reality, where the block fits, those of the engineered reward,
which pays for a block that is nearer to its place, mostly get it in; those of the contact events hold it where it is
aligned. Five trainings of `surface` that were begun the day before, seeds 40 to 44, ended at once with an error of the
benchmark, which is mended since.

Until 2026-11-27 trainings had no finish (`--finish.share 0`). Its physics, all spheres or the shapes of the scene, was
chosen with the geometry of seeds 34 and 37, after a look at the states in which policies without it get stuck ([what
keeps policies from succeeding](train_stuck.md)). Three trainings ended with the machine that they ran on, and were not
tried: of seed 31 with either physics, after 71 and 74 of 100 iterations, of seed 37 with all spheres from the start,
after 45. Seeds 40 to 49 were used for nothing before, each trained once with the finish and once without.

Policies of the whole task with `reward.stage 5` learned under the former reward, 5 in every step for each completed
stage; of its seeds 30 to 35 three never inserted. The cause was looked for with seeds 32, 33 and 35, the present reward
was first trained in forms without an own section: paid as soon as the target is met (revision `3f091a39`: seed 32, up
to 76 % while exploring and down to 20 %, seed 33 97 %, another of seed 32 lost with its machine), and paid once the
block has come to rest, the value function going on beyond (`8cecbcc0`: seeds 32, 33, 35 and 36, 54 to 86 % by 110
iterations); their weights are lost, none was tried in Reality. Seeds 37 and 38 were used for nothing. The trainings of
the present reward are [on their page](train_learning.md#all-stages-chained-objects-anywhere).
"""


@dataclass(frozen=True)
class Args:
    """Command line."""

    folders: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Folders of trainings; without any, the page is written from the stored data."""
    episodes: int = 200
    """Episodes of a trial."""
    stress_episodes: int = 100
    """Episodes of a stress test."""
    stage: Literal["insert", "all"] = "insert"
    """The last stage alone, or all stages chained."""
    case: str = "ours"
    """Which trainings of the folders, by `benchmarks.train.cases.CASES`."""
    processes: int = 1


def measure(folder: Path, seed: int, args: Args) -> Row:
    """Try a policy, and repeat its stress test."""
    torch.set_num_threads(1)
    given = Table1Args(out=folder, episodes=args.episodes, stage=args.stage)
    row = trial(given, args.case, seed, RealityWorldCfg(), own=True)
    policy = Policy.load(policy_folder(given, args.case, seed))
    test = policy.run.stress_test(device="cpu", episodes=args.stress_episodes, seed=seed)
    found = test(policy.act_in(test.environment))
    geometry = policy.run.model.geometry
    assert geometry is not None
    row["stress"] = {"successes": int(found.success.sum()), "episodes": args.stress_episodes}
    row["task"], row["stage"] = policy.run.model.scene.spec().modelname, args.stage
    row["spheres"] = len(geometry)
    row["settings"] = changed({**json.loads(json.dumps(asdict(policy.run.cfg))), "stress": {}})
    return row


def page(rows: Sequence[Row]) -> str:
    """Return the page."""
    parts = ["# Trials of policies", "Written by `benchmarks/train/trials.py`; do not edit.", ABOUT]
    for (task, stage), title in TITLES.items():
        of = [row for row in rows if (row.get("task", "shape_sorter"), row.get("stage", "insert")) == (task, stage)]
        if of:
            parts += [f"## {title}", settings_table(of), *beside_ours(of)]
            if task == "shape_sorter":
                parts += ["### Does the stress test predict success?", prediction(of)]
    for what, name in (("Trials", "machine"), ("Policies", "trained_on")):
        parts += [f"{what}: {line}" for line in dict.fromkeys(machine_line(row[name]) for row in rows)]
    return "\n\n".join(parts)


def settings_table(rows: Sequence[Row]) -> str:
    """Return a table of the success of policies, by case, settings, spheres and length of the training."""
    groups = alike(rows)

    def successes(of: Sequence[Row]) -> tuple[int, int]:
        return sum(row["successes"] for row in of), sum(row["episodes"] for row in of)

    lines = []
    for (case, settings, spheres, steps), of in sorted(groups.items(), key=lambda one: -np.divide(*successes(one[1]))):
        count, episodes = successes(of)
        low, high = wilson(count, episodes)
        each = ", ".join(
            f"{row['seed']}: {row['successes'] / row['episodes']:.1%}" for row in sorted(of, key=lambda r: r["seed"])
        )
        simulated = np.mean([row["simulation"]["rate"] for row in of])
        stressed = np.mean([row["stress"]["successes"] / row["stress"]["episodes"] for row in of])
        name = f"`{settings}`" if settings else "default"
        name += f", {CASES[case].title}" * (case != "ours")
        lines.append([
            name, f"{spheres}", f"{steps / 1e6:.1f} M", f"{count / episodes:.1%}", f"{low:.1%} to {high:.1%}", each,
            f"{simulated:.1%}", f"{stressed:.1%}",
        ])  # fmt: skip
    head = ["settings", "spheres", "steps", "succeed", "95 %", "seeds", "in simulation", "stress test"]
    return table(head, lines)


def alike(rows: Sequence[Row]) -> dict[tuple[str, str, int, int], list[Row]]:
    """Return the policies by case, settings, spheres and steps of the training."""
    groups: dict[tuple[str, str, int, int], list[Row]] = {}
    for row in rows:
        steps = round(row["trained"]["steps"], -5)
        groups.setdefault((row["case"], row["settings"], row["spheres"], steps), []).append(row)
    return groups


def beside_ours(rows: Sequence[Row]) -> list[str]:
    """Return a sentence for each other case and its settings: its success beside ours, on the seeds that both have."""
    groups, said = alike(rows), []
    for (case, settings, spheres, steps), of in groups.items():
        ours = {
            row["seed"]: row
            for (other, given, count, length), mine in groups.items()
            if (other, given, length) == ("ours", settings, steps) and (count == spheres or on_surface(case))
            for row in mine
        }
        pairs = [(row, ours[row["seed"]]) for row in of if row["seed"] in ours]
        if case == "ours" or len(pairs) < 2:
            continue
        other, mine = np.array([[one["successes"] / one["episodes"] for one in pair] for pair in pairs]).T
        low, high = ttest_rel(mine, other).confidence_interval()
        seeds = ", ".join(str(row["seed"]) for row, _ in pairs)
        title = CASES[case].title
        said.append(
            f"{title[0].upper()}{title[1:]}: {other.mean():.1%}, ours {mine.mean():.1%} with the same settings on the "
            f"seeds that both have ({seeds}), each from reset states of its own model. The difference is "
            f"{100 * (mine - other).mean():.1f} points [{100 * low:.1f}, {100 * high:.1f}] (Student's t over seeds)."
        )
    return said


def on_surface(case: str) -> bool:
    """Return whether a case has the paper's starting geometry, which never has as many spheres as ours."""
    return CASES[case].geometry == "surface"


def prediction(rows: Sequence[Row]) -> str:
    """Return what the rank correlation of stress test and trial is, of all policies and of those that chose nothing.

    Policies that learned an earlier stage are left out: their stress test is of that stage.
    """
    rows = [row for row in rows if row["trained"]["stage"] == row.get("stage", "insert")]
    fresh = [row for row in rows if row["seed"] >= FRESH]
    said = f"Spearman's rank correlation over {len(rows)} policies, settings and seeds mixed: {correlation(rows)}"
    if len(fresh) > 2:
        said += f"; over {len(fresh)} of seeds from {FRESH} on, which the test was not made with: {correlation(fresh)}"
    return f"{said} (bootstrap over policies; without those that learned an earlier stage, whose stress test is of it)."


def correlation(rows: Sequence[Row]) -> str:
    """Return Spearman's rank correlation of stress test and trial with its 95 % interval."""
    stress = np.array([row["stress"]["successes"] / row["stress"]["episodes"] for row in rows])
    real = np.array([row["successes"] / row["episodes"] for row in rows])
    rng = np.random.default_rng(0)
    with np.errstate(invalid="ignore"):  # samples of equal policies have no correlation
        drawn = [rank_correlation(stress[k], real[k]) for k in rng.integers(len(rows), size=(2000, len(rows)))]
    low, high = np.nanpercentile(drawn, [2.5, 97.5])
    return f"{rank_correlation(stress, real):.2f} [{low:.2f}, {high:.2f}]"


def rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return Spearman's rank correlation of two sets of numbers (n,)."""
    return float(np.corrcoef(rankdata(a), rankdata(b))[0, 1])


def main() -> None:
    """Try what is not tried yet, and write the page."""
    args = tyro.cli(Args, description=__doc__)
    if args.case not in CASES:
        raise SystemExit(f"trials: --case {args.case}: no such case; expected one of {', '.join(CASES)}")
    data = read_data(NAME)
    if missing := [str(folder) for folder in args.folders if not (folder / "runs").is_dir()]:
        raise SystemExit(f"trials: no trainings in {', '.join(missing)}; expected folders of benchmarks.train.learning")
    for folder in args.folders:
        kept = Measurements(folder / f"{NAME}.jsonl")
        ended = (folder / "runs").glob(f"{args.case}_{args.stage}_*/{RESULT}")
        names = {int(path.parent.name.rsplit("_", 1)[1]): f"{folder.name} {path.parent.name}" for path in ended}
        left = [seed for seed in sorted(names) if kept.wanted(names[seed])]
        jobs = (delayed(measure)(folder, seed, args) for seed in left)
        found = Parallel(n_jobs=args.processes, return_as="generator")(jobs)
        for seed, row in zip(left, found, strict=True):
            assert row is not None
            kept.add(names[seed], row)
        data |= kept.rows
    write_data(NAME, data)
    write_page(NAME, page(list(data.values())))


if __name__ == "__main__":
    main()
