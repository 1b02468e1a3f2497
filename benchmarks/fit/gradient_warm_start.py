"""Fits of a missing effect with and without a start by gradients through Newton: simulated steps, time and result.

Scenes of boxes with one wrong parameter in the model: a block that slides to rest (friction), one that hits another
(the other's mass), one that drops flat (contact compliance). The truth is an exact box in C MuJoCo with half the time
step; poses are measured at 100 Hz with 0.1 mm and 1 mrad of noise. Candidates of the diagnosis are sliding friction,
mass, inertia and contact compliance, without and with `DiagnoseCfg.gradient`.

    python -m benchmarks.fit.gradient_warm_start --out runs/gradient_warm_start.jsonl            # resumable
    python -m benchmarks.fit.gradient_warm_start --out runs/gradient_warm_start.jsonl --report   # page, in docs
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from benchmarks.measurements import Measurements
from benchmarks.pages import FOLDER, machine, machine_line, read_data, table, write_data, write_page
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.diagnosis.result import Diagnosis
from concent_warp.fit.newton.scale_factors import FactorCfg, factors
from concent_warp.model import ContactParameters, Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry
from concent_warp.simulate.engine import Rollout, Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine

NAME = "gradient_warm_start"
SceneName = Literal["slide", "collide", "drop"]
EFFECTS = {"slide": ("sliding_friction", "a"), "collide": ("mass", "b"), "drop": ("contact_compliance", "a")}
"""The wrong effect of each scene, and its body."""
CANDIDATES = ("sliding_friction", "mass", "inertia", "contact_compliance")
HALF, RADIUS, MASS, FRICTION = 0.02, 0.002, 0.08, 0.4
"""Half the edge of a block and radius of its corner spheres [m], its mass [kg], and friction, in the model."""
SOLREF = (0.01, 1.0)
"""Time constant [s] and damping ratio of the model's contacts."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    out: Path = Path("runs") / f"{NAME}.jsonl"
    scenes: tuple[SceneName, ...] = ("slide", "collide", "drop")
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    device: str = "cpu"
    """Where Newton runs."""
    seconds: float | None = None
    """No fit is begun after so long."""
    report: bool = False
    """Write the page from what was measured."""


def xml(scene: SceneName, step: float, friction: float, mass: float, time_constant: float) -> str:
    """Return the MJCF of a scene; `mass` is the second block's [kg]."""
    solref = f'solref="{time_constant} {SOLREF[1]}"'
    blocks, sensors = "", ""
    for name, weight, x in (("a", MASS, 0.0), ("b", mass, 0.07))[: 2 if scene == "collide" else 1]:
        frame = f'objtype="xbody" objname="{name}"'
        blocks += (
            f'<body name="{name}" pos="{x} 0 {HALF}"><freejoint/>'
            f'<geom type="box" size="{HALF} {HALF} {HALF}" mass="{weight}" friction="{friction}" {solref}/></body>'
        )
        sensors += f'<framepos name="{name} position" {frame}/><framequat name="{name} orientation" {frame}/>'
    floor = f'<geom name="floor" type="plane" size="2 2 0.1" friction="{friction}" {solref}/>'
    return (
        f'<mujoco><option timestep="{step}" cone="elliptic"/><worldbody>{floor}{blocks}</worldbody>'
        f"<sensor>{sensors}</sensor></mujoco>"
    )


def case(scene: SceneName, seed: int) -> tuple[Model, Recording, float]:
    """Return a model, a recording of what it lacks, and the factor on what is wrong in it."""
    rng = np.random.default_rng([seed, len(scene)])
    factor = float(rng.uniform(0.25, 0.6) if scene == "slide" else rng.uniform(1.5, 2.5))
    wrong = {"slide": (factor, 1.0, 1.0), "collide": (1.0, factor, 1.0), "drop": (1.0, 1.0, factor)}[scene]
    at_model = xml(scene, 0.002, FRICTION, MASS, SOLREF[0])
    m = mujoco.MjModel.from_xml_string(xml(scene, 0.001, FRICTION * wrong[0], MASS * wrong[1], SOLREF[0] * wrong[2]))
    d = mujoco.MjData(m)
    if scene == "drop":
        d.qpos[2] += rng.uniform(0.01, 0.02)
    else:
        turn = rng.uniform(-1, 1) if scene == "slide" else 0.0
        d.qpos[3:7] = Rotation.from_euler("z", turn).as_quat(scalar_first=True)
        d.qvel[:2] = (rng.uniform(0.5, 0.8), rng.uniform(-0.1, 0.1) if scene == "slide" else 0.0)
        d.qvel[5] = rng.uniform(-3, 3) if scene == "slide" else 0.0
    qpos, qvel, read = d.qpos.copy(), d.qvel.copy(), []
    for k in range(400 if scene != "drop" else 300):
        mujoco.mj_forward(m, d)
        if k % 10 == 0:
            read.append(d.sensordata.copy())
        mujoco.mj_step(m, d)
    clock, measured = np.arange(len(read)) / 100, {}
    for s in range(m.nsensor):
        value = np.array(read)[:, m.sensor_adr[s] : m.sensor_adr[s] + m.sensor_dim[s]]
        if m.sensor_dim[s] == 4:
            noise = Rotation.from_rotvec(1e-3 * rng.standard_normal((len(value), 3)))
            value = (Rotation.from_quat(value, scalar_first=True) * noise).as_quat(scalar_first=True)
        else:
            value = value + 1e-4 * rng.standard_normal(value.shape)
        measured[m.sensor(s).name] = Channel(clock, value, noise_std=1e-4 if m.sensor_dim[s] == 3 else 5e-4)
    demonstration = Demonstration("demo_0", qpos=qpos, qvel=qvel, measured=measured)
    drawn = Scene(at_model)
    bodies = ("a", "b")[: 2 if scene == "collide" else 1]
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * (HALF - RADIUS)
    count = 8 * len(bodies)
    geometry = ContactGeometry(
        bodies, np.repeat(np.arange(len(bodies)), 8), np.tile(corners, (len(bodies), 1)), np.full(count, RADIUS),
        np.full(count, MASS / 8), np.full(count, FRICTION),
    )  # fmt: skip
    contact = ContactParameters(solref=SOLREF, condim=3)
    return Model(drawn, geometry, contact), Recording(at_model, (demonstration,)), factor


def run(args: Args, scene: SceneName, seed: int) -> dict[str, Any]:
    """Diagnose both ways."""
    model, recording, factor = case(scene, seed)
    row: dict[str, Any] = {"scene": scene, "seed": seed, "factor": factor}
    begun = time.perf_counter()
    found = factors(model, recording, FactorCfg(device=args.device))
    row["newton"] = {
        "friction": found.friction, "stiffness": found.stiffness, "mass": found.mass,
        "seconds": time.perf_counter() - begun, "before_mm": 1e3 * found.before, "mujoco_mm": 1e3 * found.mujoco,
        "simulated_s": found.simulated,
    }  # fmt: skip
    for way, gradient in (("plain", False), ("led", True)):
        cfg = DiagnoseCfg(effects=CANDIDATES, max_additions=1, jobs=1, explain=False, gradient=gradient, seed=seed)
        begun = time.perf_counter()
        with counted() as steps:
            diagnosis = diagnose(model, recording, cfg)
        row[way] = {
            "steps": sum(steps), "seconds": time.perf_counter() - begun, "verdict": diagnosis.verdict,
            "named": [f.name for f in diagnosis.accepted], "ratio": diagnosis.ratio[-1],
            **error_of(diagnosis, scene, factor),
        }  # fmt: skip
    return {**row, "machine": machine(args.device)}


def error_of(diagnosis: Diagnosis, scene: SceneName, factor: float) -> dict[str, float | None]:
    """Return the error of what was wrong in the model, relative, in the first fit of the effect."""
    name, target = EFFECTS[scene]
    truth = {"slide": FRICTION, "collide": 1.0, "drop": SOLREF[0]}[scene] * factor
    for finding in diagnosis.effects:
        if finding.name.split("(")[0] == name and target in finding.target and finding.step == 0:
            return {"value": finding.parameters[0].value, "error": abs(finding.parameters[0].value / truth - 1)}
    return {"value": None, "error": None}


@contextmanager
def counted() -> Iterator[list[int]]:
    """Note the steps that C MuJoCo simulates in this process."""
    original, steps = MujocoEngine.run, []

    def run(self: MujocoEngine, variants: Variants, ctrl: np.ndarray, **options: Any) -> Rollout:
        steps.append(variants.count * ctrl.shape[-2])
        return original(self, variants, ctrl, **options)

    MujocoEngine.run = run
    try:
        yield steps
    finally:
        MujocoEngine.run = original


def report(rows: list[dict[str, Any]]) -> None:
    """Write the page."""
    assert __doc__ is not None
    text = ["# Gradients as a start for the diagnosis", "", "\n".join(__doc__.split("\n")[2:6]), ""]
    text += [f"`python -m benchmarks.fit.{NAME}`. Medians over seeds (range).", ""]
    text += [
        "- *gradients*: relative error of the wrong parameter at the end of the descent in Newton.",
        "- *steps*: of MuJoCo, in thousands, in the whole diagnosis; *with*: with `--gradient`.",
        "- *error*: relative error of the fitted value. *right*: diagnoses that name the effect, alone or in",
        "  a group. *residual*: over noise, of the model with the added effects.",
        "- *s*: seconds of the diagnosis; *Newton*: of the descent alone.",
        "",
        machine_line(rows[0]["machine"]),
        "",
    ]
    head = [
        "scene", "missing", "seeds", "gradients", "steps without", "steps with", "with / without", "error without",
        "error with", "right without", "right with", "residual without", "residual with", "s without", "s with",
        "Newton",
    ]  # fmt: skip
    lines = []
    for scene, (effect, _) in EFFECTS.items():
        mine = [r for r in rows if r["scene"] == scene]
        if not mine:
            continue

        def of(way: str, key: str, places: int = 0, scale: float = 1.0, mine: list[dict[str, Any]] = mine) -> str:
            return spread([r[way][key] * scale for r in mine if r[way][key] is not None], places)

        def right(way: str, mine: list[dict[str, Any]] = mine, effect: str = effect) -> str:
            return str(sum(any(name.split("(")[0] == effect for name in r[way]["named"]) for r in mine))

        lines.append(
            [
                scene, effect, str(len(mine)), spread([led_error(r) for r in mine], 2), of("plain", "steps", 0, 1e-3),
                of("led", "steps", 0, 1e-3), spread([r["led"]["steps"] / r["plain"]["steps"] for r in mine], 2),
                of("plain", "error", 3), of("led", "error", 3), right("plain"), right("led"), of("plain", "ratio", 2),
                of("led", "ratio", 2), of("plain", "seconds"), of("led", "seconds"), of("newton", "seconds"),
            ]
        )  # fmt: skip
    text += [table(head, lines)]
    write_data(NAME, {r["key"]: r for r in rows})
    page = FOLDER / f"{NAME}.md"
    said = page.read_text().split("## Reading the figures", 1)[1:] if page.is_file() else []
    write_page(NAME, "\n".join([*text, *(f"## Reading the figures{part}" for part in said)]))


def led_error(row: dict[str, Any]) -> float:
    """Return the relative error of the wrong parameter at the end of the gradient descent."""
    found = row["newton"]
    ends = {"slide": found["friction"], "collide": found["mass"].get("b"), "drop": found["stiffness"] ** -0.5}
    return abs(ends[row["scene"]] / row["factor"] - 1)


def spread(values: list[float], places: int) -> str:
    """Return median and range."""
    if not values:
        return "-"
    low, middle, high = (f"{v:,.{places}f}" for v in (min(values), float(np.median(values)), max(values)))
    return f"{middle} ({low}-{high})"


def main(args: Args) -> None:
    """Measure what is missing, or write the page."""
    kept = Measurements(args.out, seconds=args.seconds)
    if args.report:
        if not kept.rows:
            kept.rows.update(read_data(NAME))
        if not kept.rows:
            raise SystemExit(f"{args.out}: no results; run without --report first")
        report(list(kept.rows.values()))
        return
    for seed in args.seeds:
        for scene in args.scenes:
            key = f"{scene} {seed} {args.device}"
            if kept.wanted(key, 20.0):
                kept.add(key, run(args, scene, seed))
    kept.close()


if __name__ == "__main__":
    main(tyro.cli(Args))
