"""Which command is meant, and what becomes of errors. The commands are imported only when they are called."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from importlib import import_module

from concent_warp.errors import ConcentError
from concent_warp.run_folder import processes
from concent_warp.version import __version__

COMMANDS = {
    "demo": "the main job in Reality, a simulated world, from recording to report",
    "record": "record demonstrations in Reality",
    "geometry": "lay contact spheres on the objects of a scene; export a model as MJCF",
    "fit": "fit the contact geometry to a recording; contact events and a report come with it",
    "replay": "replay a recording in a model and save what the model predicts",
    "events": "extract the contact event sequence of a recording",
    "compare": "compare a model, or two, with a recording",
    "locate": "find where a model lacks forces: by joint, and on which place of which object",
    "diagnose": "find which physical effect a model lacks, with the evidence, or why none can be named",
    "train": "train a policy to bring about the contact events of a demonstration",
    "evaluate": "count how often a trained policy succeeds, in simulation and in Reality",
    "play": "show a trained policy at work, live in the browser",
    "export": "write a trained policy as ONNX or TorchScript",
    "splat-fit": "fit Gaussian splats, the looks of an object, to posed images",
    "render": "render episodes of a policy, or a recording, as photorealistic images in a data set",
    "render-train": "train networks that paint robot and background as a real camera sees them",
    "add": "add a physical effect to a model, and fit it to a recording",
}
"""Names of the commands, each a module of this package, "-" as "_", with what they do."""
ERROR, INTERRUPTED, CLOSED = 2, 130, 141
PATIENCE = 10.0
"""How long other processes wait for the first one to say what is wrong [s]."""


def _usage() -> str:
    """Return the text of ``concent --help``."""
    lines = [f"  {name:<13}{text}" for name, text in COMMANDS.items()]
    return "\n".join(
        [
            "usage: concent [-h] [--version] COMMAND ...",
            "",
            "From one measured demonstration to a grounded simulation.",
            "",
            "commands:",
            *lines,
            "",
            "concent COMMAND --help lists the options of a command; concent demo is the place to start.",
        ]
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    0: done. 2: an input or a setting cannot be worked with, said in one sentence on standard error. 130: interrupted.

    Args:
        argv: Arguments without the program's name; those of the process by default.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_usage())
        return 0
    if arguments[0] == "--version":
        print(f"concent {__version__}")
        return 0
    if arguments[0] not in COMMANDS:
        print(f"concent: no command {arguments[0]!r}; expected one of {', '.join(COMMANDS)}.", file=sys.stderr)
        return ERROR
    code = _run(arguments[0], arguments[1:])
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        return _leave_pipe()
    return code


def _leave_pipe() -> int:
    """Give up standard output, which its reader has closed as `head` does, and return the exit code for that."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return CLOSED


def _run(command: str, arguments: Sequence[str]) -> int:
    """Run one command."""
    try:
        import tyro

        from concent_warp.run_folder import INVOCATION

        INVOCATION.set((command, *arguments))
        module = import_module(f"concent_warp.cli.commands.{command.replace('-', '_')}")
        settings = tyro.cli(
            module.Arguments,
            args=arguments,
            prog=f"concent {command}",
            config=(tyro.conf.FlagCreatePairsOff, tyro.conf.HelptextFromCommentsOff),
            console_outputs=processes()[0] == 0,
        )
        module.run(settings)
    except ConcentError as error:
        _complain(f"concent {command}: {error}")
        return ERROR
    except BrokenPipeError:
        return _leave_pipe()
    except OSError as error:
        place = "" if error.filename is None else f"{error.filename}: "
        _complain(f"concent {command}: {place}{error.strerror or error}; check the path and the disk.")
        return ERROR
    except KeyboardInterrupt as interrupt:
        if processes()[0] == 0:
            print(f"\nconcent {command}: interrupted. {interrupt}".rstrip(), file=sys.stderr)
        return INTERRUPTED
    except SystemExit as end:  # tyro ends the process after a wrong option or --help
        _wait_for_rank_zero()
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0


def _complain(sentence: str) -> None:
    """Write to standard error; of several processes, which one error stops all, the first that comes to it."""
    _wait_for_rank_zero()
    print(sentence, file=sys.stderr)


def _wait_for_rank_zero() -> None:
    """Wait for the first of several processes, which says what is wrong with all and ends them by leaving."""
    if processes()[0] > 0:
        time.sleep(PATIENCE)
