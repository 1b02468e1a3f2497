"""Fit the contact geometry of objects, so that the replay moves as the recording did.

    python examples/steps/fit_geometry.py [--generations 20] [--out runs/fit]

Spheres on the surface close the hole of the shape sorter: the block rests on the rim. The fit moves them until it falls
in.
"""

from pathlib import Path

import tyro

import concent_warp as cw


def main(out: Path = Path("runs/fit"), generations: int = 20, spheres: int = 96) -> None:
    """Fit, and write the model and the history of the fit to a folder."""
    recording = cw.load_policy("shape_sorter").run.recording
    result = cw.fit_geometry(
        cw.Model.from_recording(recording),
        recording,
        cw.FitCfg(generations=generations),
        start=cw.ContactGeometryCfg(count=spheres, placement="surface"),
        engine="mujoco",
        out=out,
        progress=lambda p: print(f"generation {p.generation}: {1e3 * p.best:.1f} mm at best", flush=True),
    )
    comparison = cw.compare({"start": result.start, "fitted": result.model}, recording)
    before, after = (comparison.summarise(name, "block_position").mean for name in comparison.models)
    print(f"block position: {1e3 * before:.1f} -> {1e3 * after:.1f} mm; {out}/model.toml")


if __name__ == "__main__":
    tyro.cli(main)
