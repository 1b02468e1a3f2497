"""Run folders reduced to what running the policy needs, the form of the pretrained policies in `train/pretrained`.

They have the policy's weights, model, contact events, commands and measurements of the demonstration, and settings,
without optimiser, value function, environment state, tracked points and images. `origin.toml` has command and versions
of the training.
"""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from concent_warp.checkpoint_file import write_checkpoint
from concent_warp.documents import read_toml
from concent_warp.errors import ConcentError
from concent_warp.files import claim, write_text
from concent_warp.run_folder import exchange, make_folder
from concent_warp.train.learning.ppo import CHECKPOINT
from concent_warp.train.policy.load import Policy
from concent_warp.train.policy.pretrained import ORIGIN

COMMAND = "settings.toml"
"""File of a run folder with the command of `concent train`."""


def write_pretrained(policy: Policy, out: Path, *, overwrite: bool = False) -> dict[str, Any]:
    """Write a policy with what it needs to a folder atomically; return the content of `origin.toml`.

    Args:
        policy: The policy, loaded from a run folder.
        out: Folder to create.
        overwrite: Replace an earlier policy in the folder.

    Raises:
        ConcentError: The folder exists and is not replaced.
    """
    import tomli_w

    _check_replaceable(out, overwrite=overwrite)
    claim(out)
    _check_replaceable(out, overwrite=overwrite)  # another command may just have written it
    run, weights = policy.run, policy.weights
    one = replace(run.recording[0], points={}, image={})
    make_folder(out.parent)
    with TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as made:
        folder = Path(made) / out.name
        replace(run, recording=replace(run.recording, demonstrations=(one,))).save(folder)
        kept = {name: weights[name] for name in ("actor_state_dict", "iteration", "steps", "seconds")}
        if "stress" in weights:
            kept["stress"] = weights["stress"]
        write_checkpoint(folder / CHECKPOINT, kept)
        length = {
            "iterations": weights["iteration"],
            "steps": weights["steps"],
            "seconds": round(weights["seconds"], 1),
        }
        origin = length | _origin_of(policy.folder / COMMAND)
        write_text(folder / ORIGIN, tomli_w.dumps(origin))
        if not out.exists():
            folder.rename(out)
        elif not exchange(folder, out):
            out.rename(Path(made) / "old")
            folder.rename(out)
    return origin


def _check_replaceable(out: Path, *, overwrite: bool) -> None:
    """Check that a policy may be written to a folder.

    Raises:
        ConcentError: The folder exists and is not replaced.
    """
    if out.exists() and not (overwrite and (out / ORIGIN).is_file()):
        fix = "pass --overwrite" if (out / ORIGIN).is_file() else "choose another folder"
        raise ConcentError("the folder exists", where=out, fix=fix)


def _origin_of(settings: Path) -> dict[str, Any]:
    """Return command and versions of a training from its settings file; empty without one."""
    if not settings.is_file():
        return {}
    stored = read_toml(settings)
    found: dict[str, Any] = {"command": _without_folders(stored["command"])} if "command" in stored else {}
    return found | ({"versions": stored["versions"]} if "versions" in stored else {})


def _without_folders(command: str) -> str:
    """Return a command with the folders removed from its file names."""
    return shlex.join(Path(part).name if "/" in part else part for part in shlex.split(command))
