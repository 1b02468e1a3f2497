"""Train a policy to bring about the contact events of a demonstration.

    python examples/steps/train.py [--iterations 300] [--worlds 4096] [--out runs/insert]

On a GPU the defaults take minutes. A CPU wants fewer worlds, and hours.
"""

from pathlib import Path

import tyro

import concent_warp as cw


def main(out: Path = Path("runs/insert"), iterations: int = 300, worlds: int = 4096, steps: int = 24) -> None:
    """Train the insertion from the demonstration and model of the policy that comes with the package."""
    run = cw.load_policy("shape_sorter").run
    cfg = cw.TrainCfg(
        environment=cw.EnvironmentCfg(stage="insert", worlds=worlds), ppo=cw.PpoCfg(iterations=iterations, steps=steps)
    )
    policy = cw.train(
        run.model,
        run.recording,
        cfg,
        events=run.events,
        out=out,
        overwrite=True,
        progress=lambda i: print(f"iteration {i.iteration}: {i.steps} steps in {i.seconds:.0f} s", flush=True),
    )
    print(f"{policy.weights['iteration']} iterations; {out}")


if __name__ == "__main__":
    tyro.cli(main)
