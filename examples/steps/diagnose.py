"""Diagnose which physical effect a model lacks, and add it.

python examples/steps/diagnose.py [--out runs/diagnosis]
"""

from pathlib import Path

import tyro

import concent_warp as cw


def main(out: Path = Path("runs/diagnosis")) -> None:
    """Diagnose the nominal model of a servo, and write the model with the missing effect to a folder."""
    recording = cw.load_recording(cw.example("servo"))
    diagnosis = cw.diagnose(cw.Model.from_recording(recording), recording)
    print(diagnosis.headline)
    print(*diagnosis.sentences(), sep="\n")
    out.mkdir(parents=True, exist_ok=True)
    diagnosis.model.save(out / "model.toml")
    print(f"{out}/model.toml")


if __name__ == "__main__":
    tyro.cli(main)
