"""Run folders reduced to what running the policy takes, as the pretrained policies in `train/pretrained` are.

Kept are the policy's weights, model, contact events, commands and measurements of the demonstration, and settings; left
out are optimiser, value function, worlds and generators, tracked points and images. `origin.toml` says which command
made a policy, and with which versions.
"""

from __future__ import annotations

import shlex
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

from concent_warp.errors import ConcentError
from concent_warp.files import write_text
from concent_warp.train.learning.ppo import CHECKPOINT
from concent_warp.train.policy.load import Policy
from concent_warp.train.policy.pretrained import ORIGIN

COMMAND = "settings.toml"
"""File of a run folder in which `concent train` writes its command."""


def write_pretrained(policy: Policy, out: Path, *, overwrite: bool = False) -> dict[str, Any]:
    """Write a run's policy with what it needs to a folder, in one piece or not at all; return what `origin.toml` says.

    Args:
        policy: The policy, loaded from a run folder.
        out: Folder to make.
        overwrite: Replace an earlier policy in the folder.

    Raises:
        ConcentError: The folder is there and is not to be, or cannot be, replaced.
    """
    import tomli_w
    import torch

    if out.exists() and not (overwrite and (out / ORIGIN).is_file()):
        fix = "pass --overwrite" if (out / ORIGIN).is_file() else "choose another folder"
        raise ConcentError("the folder exists", where=out, fix=fix)
    run, weights = policy.run, policy.weights
    one = replace(run.recording[0], points={}, image={})
    partial = out.with_name(f".{out.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    replace(run, recording=replace(run.recording, demonstrations=(one,))).save(partial)
    kept = {name: weights[name] for name in ("actor_state_dict", "iteration", "steps", "seconds")}
    torch.save(kept, partial / CHECKPOINT)
    length = {"iterations": weights["iteration"], "steps": weights["steps"], "seconds": round(weights["seconds"], 1)}
    origin = length | _origin_of(policy.folder / COMMAND)
    write_text(partial / ORIGIN, tomli_w.dumps(origin))
    if out.exists():
        shutil.rmtree(out)
    partial.rename(out)
    return origin


def _origin_of(settings: Path) -> dict[str, Any]:
    """Return the command and the versions that a run folder was made by, as far as it says so."""
    if not settings.is_file():
        return {}
    stored = tomllib.loads(settings.read_text())
    found: dict[str, Any] = {"command": _without_folders(stored["command"])} if "command" in stored else {}
    return found | ({"versions": stored["versions"]} if "versions" in stored else {})


def _without_folders(command: str) -> str:
    """Return a command with the files in it named without the folders that they lay in."""
    return shlex.join(Path(part).name if "/" in part else part for part in shlex.split(command))
