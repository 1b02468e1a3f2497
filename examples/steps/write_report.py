"""Write a report: models before and after beside the recording, with the diagnosis, in one HTML file.

python examples/steps/write_report.py [--out runs/report.html]
"""

from pathlib import Path

import tyro

import concent_warp as cw


def main(out: Path = Path("runs/report.html")) -> None:
    """Diagnose the servo, with three effects as candidates, and show the result."""
    recording = cw.load_recording(cw.example("servo"))
    nominal = cw.Model.from_recording(recording)
    few = cw.DiagnoseCfg(effects=("joint_friction", "joint_damping", "actuator_delay"))
    diagnosis = cw.diagnose(nominal, recording, few)
    comparison = cw.compare({"before": nominal, "after": diagnosis.model}, recording)
    out.parent.mkdir(parents=True, exist_ok=True)
    cw.write_report(out, recording, comparison, diagnosis=diagnosis)
    print(out)


if __name__ == "__main__":
    tyro.cli(main)
