"""Gradients through Newton against central differences, by the length of the simulated horizon.

Settling, pushing, tumbling, and insertion of a peg of spheres into a socket of spheres
(`benchmarks/fit/gradient_scenes.py`), three starting geometries each. The loss of a horizon is the Chamfer distance
over the frames until then. Slopes along eight smooth deformations of the spheres, and with respect to friction,
stiffness and mass, are compared with central differences.

    python -m benchmarks.fit.gradient_check                 # a few minutes on a CPU; writes into docs/benchmarks
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro

from benchmarks.fit.gradient_scenes import SCENES, SceneName, record, starting_model
from benchmarks.pages import FOLDER, machine, machine_line, table, write_data, write_page
from concent_warp.estimation.object_tracks import whole_demonstration
from concent_warp.fit.geometry.offset import offset_directions
from concent_warp.fit.geometry.perturbation import Perturbation
from concent_warp.fit.newton.horizon import shortened
from concent_warp.fit.newton.loss import NewtonLoss
from concent_warp.fit.newton.scene import newton_scene
from concent_warp.fit.newton.worlds import Parameters

NAME = "gradient_check"
STEP, SHARE = 1e-5, 0.01
"""Central differences: deformation [m], and change of a factor."""
DIRECTIONS = 8
FACTORS = ("friction_scale", "stiffness_scale", "mass_scale")
WORDS = {"settle": "settling", "push": "pushing", "tumble": "tumbling", "insertion": "insertion, sphere on sphere"}


@dataclass(frozen=True)
class Args:
    """Command line."""

    scenes: tuple[SceneName, ...] = SCENES
    seeds: tuple[int, ...] = (0, 1, 2)
    horizons: tuple[float, ...] = (0.1, 0.2, 0.4, 0.6, 0.8, 1.5)
    """[s]; those beyond the end of a demonstration are left out."""
    device: str = "cpu"
    write: bool = True
    """Write the page."""


def check(scene: SceneName, seed: int, horizon: float, device: str) -> dict[str, Any] | None:
    """Return the slopes of one geometry over one horizon, both ways; None where the demonstration is shorter."""
    recording = record(scene, seed)
    model = starting_model(scene, recording, seed)
    assert model.geometry is not None
    segment = whole_demonstration(model.scene, recording["demo_0"], model.geometry.bodies)
    m = model.scene.model
    if horizon > len(segment.ctrl) * m.opt.timestep + 0.02:
        return None
    prepared = newton_scene(model, [shortened(m, segment, horizon)])
    position = model.geometry.position
    directions = deformations(model, seed)
    exact = NewtonLoss(prepared, 1, device=device)(Parameters(position[None]))
    signs = np.array([1.0, -1.0])
    moved = position + STEP * signs[:, None, None, None] * directions
    losses = NewtonLoss(prepared, 2 * DIRECTIONS, device=device).losses(Parameters(moved.reshape(-1, *position.shape)))
    differences = -np.diff(losses.reshape(2, DIRECTIONS), axis=0)[0] / (2 * STEP)
    slopes = np.einsum("dsc,sc->d", directions, exact.by["position"][0])
    pair, both = NewtonLoss(prepared, 2, device=device), np.stack([position, position])
    by = {}
    for name in FACTORS:
        value = 1 + SHARE * signs
        up, down = pair.losses(Parameters(both, **{name: value[:, None] if name == "mass_scale" else value}))
        by[name] = [float(np.ravel(exact.by[name])[0]), float((up - down) / (2 * SHARE))]
    return {
        "scene": scene, "seed": seed, "horizon": horizon, "steps": prepared.steps,
        "slopes": slopes.tolist(), "differences": differences.tolist(), **by,
    }  # fmt: skip


def deformations(model: Any, seed: int) -> np.ndarray:
    """Return smooth deformations whose largest displacement is 1, shape (DIRECTIONS, S, 3); the first is a swelling."""
    growth = offset_directions(model.geometry, model.scene)
    every = np.ones(len(growth), dtype=bool)
    rng = np.random.default_rng(seed)
    noise = Perturbation(model.geometry, every, "gaussian_process", 0.02).sample(DIRECTIONS, 3, rng)
    noise[0] = growth
    return noise / np.linalg.norm(noise, axis=2).max(axis=1)[:, None, None]


def relative(rows: list[dict[str, Any]]) -> np.ndarray:
    """Return |slopes - differences| / |differences| over the deformations of each row."""
    return np.array(
        [
            np.linalg.norm(np.subtract(r["slopes"], r["differences"])) / max(np.linalg.norm(r["differences"]), 1e-12)
            for r in rows
        ]
    )


def cell(value: float) -> str:
    """Return a relative error as text."""
    return "not finite" if not np.isfinite(value) else f"{value:.2g}" if value < 10 else f"{value:.0f}"


def main(args: Args) -> list[dict[str, Any]]:
    """Check all, and write the page."""
    rows = []
    for scene in args.scenes:
        for horizon in args.horizons:
            for seed in args.seeds:
                if (found := check(scene, seed, horizon, args.device)) is not None:
                    rows.append(found)
                    print(scene, horizon, seed, cell(float(relative([found])[0])), flush=True)
    if not args.write:
        return rows
    assert __doc__ is not None
    text = ["# Gradients through Newton, checked", "", "\n".join(__doc__.split("\n")[2:6]), ""]
    facts = machine(args.device)
    text += [f"`python -m benchmarks.fit.gradient_check`. {machine_line(facts)}", ""]
    text += [
        "Relative error of the slopes along the deformations: norm of the difference over the norm of the central",
        "differences, median (worst) of the geometries; then the same for single factors, and the size of the slopes.",
        "",
    ]
    head = ["motion", "until [s]", "steps", "relative error", "friction", "stiffness", "mass", "slope [mm/mm]"]
    lines = []
    for scene in args.scenes:
        for horizon in args.horizons:
            mine = [r for r in rows if r["scene"] == scene and r["horizon"] == horizon]
            if not mine:
                continue
            error = relative(mine)
            factors = []
            for name in FACTORS:
                off = [abs(a - b) / max(abs(b), 1e-9) for a, b in (r[name] for r in mine)]
                factors.append(cell(float(np.median(off))))
            size = float(np.median([np.abs(r["slopes"]).max() for r in mine]))
            steps = f"{np.median([r['steps'] for r in mine]):.0f}"
            worst = f"{cell(float(np.median(error)))} ({cell(float(error.max()))})"
            lines.append([WORDS[scene], f"{horizon:g}", steps, worst, *factors, f"{size:.2g}"])
    text += [table(head, lines)]
    page = FOLDER / f"{NAME}.md"
    said = page.read_text().split("## Reading the figures", 1)[1:] if page.is_file() else []
    text += [f"## Reading the figures{part}" for part in said]
    write_data(NAME, {"machine": facts, "rows": [{k: as_number(v) for k, v in r.items()} for r in rows]})
    write_page(NAME, "\n".join(text))
    return rows


def as_number(value: Any) -> Any:
    """Return a value for JSON, which knows no infinite numbers: None in their place."""
    if isinstance(value, list):
        return [as_number(v) for v in value]
    return value if not isinstance(value, float) or np.isfinite(value) else None


if __name__ == "__main__":
    main(tyro.cli(Args))
