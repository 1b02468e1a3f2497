"""Compare models with measurements: error by channel, with its interval, beside the noise.

python examples/steps/compare.py
"""

import concent_warp as cw


def main() -> None:
    """Compare the nominal model of a servo with one that has friction in its joint."""
    recording = cw.load_recording(cw.example("servo"))
    nominal = cw.Model.from_recording(recording)
    friction = nominal.add_effect("joint_friction", values={"torque[hinge]": 0.03})
    comparison = cw.compare({"nominal": nominal, "with friction": friction}, recording)
    for channel in comparison.channels:
        for name in comparison.models:
            s = comparison.summarise(name, channel)
            print(f"{channel}, {name}: {s.mean:.2g} [{s.low:.2g}, {s.high:.2g}] {s.unit}, {s.ratio:.1f} x noise")
        print(f"{channel}: the error has {comparison.difference(channel).verdict}")


if __name__ == "__main__":
    main()
