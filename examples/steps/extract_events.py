"""Extract the contact event sequence: who touches whom, when, and in which stages.

python examples/steps/extract_events.py [--out runs/events]
"""

from pathlib import Path

import tyro

import concent_warp as cw


def main(out: Path = Path("runs/events")) -> None:
    """Print stages and target events, and write them with a schedule plot to a folder."""
    run = cw.load_policy("shape_sorter").run  # a grounded model and the demonstration it was grounded with
    (events,) = cw.extract_events(run.model, run.recording, out=out).values()
    for stage in events.stages:
        print(f"{stage.name}: {stage.start:.2f} to {stage.end:.2f} s, {' and '.join(stage.bodies)}")
    print(f"{out}/events.json, {out}/schedule.png")


if __name__ == "__main__":
    tyro.cli(main)
