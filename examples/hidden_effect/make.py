"""The recording of docs/tutorial_effects.md: a servo swings a payload, and its drawing lacks something.

    python examples/hidden_effect/make.py [FOLDER]

It writes demo.h5 and scene.xml to the folder, by default the one that this file is in. They come out the same each
time. What is hidden is known here and nowhere else: Coulomb friction of 0.03 N m in the servo's gear, by a bristle
model, where the drawing has none.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from concent_warp.reality.hidden.registry import hidden
from concent_warp.reality.rigs.pendulum import PENDULUM
from concent_warp.reality.rigs.rig import RigTrial, record_rig
from concent_warp.reality.rigs.signals import hold, joined, minimum_jerk_profile, sweep
from concent_warp.recording.formats.hdf5 import write_hdf5

FRICTION = 0.03
"""What the drawing lacks [N m]."""
SEED = 3


def plan(rng: np.random.Generator, k: int) -> RigTrial:
    """Swing out and back at two speeds, creep, and come home: four seconds."""
    del k
    reach = rng.uniform(1.0, 1.2)
    parts = [hold(0.0, 0.2), sweep(0.0, reach, 1.5), hold(reach, 0.2), sweep(reach, -0.6, 3.0), hold(-0.6, 0.2)]
    parts += [sweep(-0.6, -0.4, 0.4), sweep(-0.4, -0.6, 0.4), minimum_jerk_profile(-0.6, 0.0, 0.5)]
    parts += [hold(0.0, max(0.1, 4.0 - sum(map(len, parts)) / 100))]
    return RigTrial(4.0, {"servo": joined(parts)}, settling_time=0.5)


def main(folder: Path) -> None:
    """Record and write."""
    rig = replace(PENDULUM, plan=plan)
    effect = hidden("joint_friction", FRICTION, rig).effect
    recording = record_rig(rig, [effect], demonstrations=1, seed=SEED)
    recording = replace(recording, source="examples/hidden_effect")
    folder.mkdir(parents=True, exist_ok=True)
    write_hdf5(recording, folder / "demo.h5")
    (folder / "scene.xml").write_text(rig.scene.xml.lstrip())


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
