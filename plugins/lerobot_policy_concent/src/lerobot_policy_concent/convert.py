"""`lerobot-concent-convert RUN OUT`: a run folder as a folder for `--policy.path`, which needs no run folder."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from concent_warp import ConcentError
from lerobot_policy_concent.configuration_concent import ConcentConfig
from lerobot_policy_concent.modeling_concent import ConcentPolicy
from lerobot_policy_concent.processor_concent import make_concent_pre_post_processors


def convert(run: str | Path, out: str | Path) -> Path:
    """Write config.json, model.safetensors and processors, as lerobot saves policies, and return the folder.

    Args:
        run: Run folder of `concent distil` or `concent train-flow`.
        out: Folder to write, which must not exist or be empty.

    Raises:
        concent_warp.TrainError: There is no policy that sees, or the folder is not empty.
    """
    out = Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConcentError("the folder is not empty", where=out, fix="choose another one")
    config = ConcentConfig(run=str(run), device="cpu", push_to_hub=False)
    policy = ConcentPolicy(config)
    config.run = None
    policy.save_pretrained(out)
    for processor in make_concent_pre_post_processors(config):
        processor.save_pretrained(out)
    return out


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="lerobot-concent-convert", description=__doc__)
    parser.add_argument("run", type=Path, help="run folder of concent distil or concent train-flow")
    parser.add_argument("out", type=Path, help="folder to write")
    given = parser.parse_args()
    try:
        out = convert(given.run, given.out)
    except (ConcentError, OSError) as error:
        sys.exit(f"error: {error}")
    print(f"{out}: use it with --policy.path={out}")


if __name__ == "__main__":
    main()
