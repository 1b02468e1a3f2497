"""Which command is meant, and what becomes of errors. The commands are imported only when they are called."""

from __future__ import annotations

import inspect
import io
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from importlib import import_module
from threading import Timer

from concent_warp.cli.boundary import DONE, ERROR, complain, exit_code
from concent_warp.cli.terminal import HAS_PRINTED
from concent_warp.errors import ConcentError
from concent_warp.run_folder import processes
from concent_warp.version import __version__

GROUPS = {
    "start": {
        "demo": "record in Reality, a simulated world, then fit, compare and report",
        "record": "record demonstrations in Reality",
        "import": "read the log of another system: LeRobot, MCAP, ROS bag, images, BOP",
    },
    "from a video to a recording": {
        "calibrate": "find camera poses and clock offset from tags or the robot in view",
        "track": "track the objects in the RGB-D video of a recording",
    },
    "from a recording to a model": {
        "geometry": "place contact spheres on the objects of a scene; export MJCF",
        "fit": "fit the contact geometry; extract contact events; report",
        "replay": "replay a recording in a model and save the prediction",
        "events": "extract the contact event sequence of a recording",
    },
    "which effect is missing": {
        "compare": "compare one model or two with a recording",
        "diagnose": "name the physical effect that a model lacks, or say why not",
        "suggest": "find the motion to record next, where that is open",
        "locate": "find which joints and objects lack forces, and where",
        "add": "add a physical effect to a model and fit it to a recording",
    },
    "from a model to a policy": {
        "train": "train a policy under the contact events of a demonstration",
        "distil": "train a student that sees to act as a policy does",
        "evaluate": "count how often a policy succeeds, in simulation and Reality",
        "explain": "find why trials of a policy failed: perception, physics or policy",
        "improve": "explain failed trials, mend the cause, train on, in rounds",
        "play": "show a policy live in the browser",
        "export": "write a policy as ONNX, or a recording as a LeRobot data set",
    },
    "images": {
        "splat-fit": "fit Gaussian splats to posed images of an object",
        "render-train": "train the networks that paint robot and background",
        "render": "render episodes or a recording as a data set of images",
        "train-flow": "train a policy that sees, from a data set of images",
    },
}
"""Commands by the step of the pipeline, each a module of this package, "-" as "_", with what it does."""
COMMANDS = {name: text for group in GROUPS.values() for name, text in group.items()}
EXAMPLES = {
    "demo": "concent demo --out runs/demo",
    "record": "concent record --seeds 0 1 -o demo.h5",
    "import": "concent import bag.mcap --model robot.xml --map robot.toml -o demo.h5",
    "calibrate": "concent calibrate demo.h5 --tag-size 0.04 -o calibrated.h5 --picture calibration.png",
    "track": "concent track video.h5 -o tracked.h5",
    "geometry": "concent geometry scene.xml -o model.toml",
    "fit": "concent fit demo.h5 -o runs/demo",
    "replay": "concent replay demo.h5 --model model.toml -o rollout.npz",
    "events": "concent events demo.h5 --model model.toml -o events",
    "compare": "concent compare demo.h5 --model model.toml --baseline scene.xml",
    "diagnose": "concent diagnose demo.h5 --model scene.xml --html report.html",
    "suggest": "concent suggest demo.h5 --model scene.xml --diagnosis found -o motion.h5",
    "locate": "concent locate demo.h5 --model scene.xml --png forces.png",
    "add": "concent add joint_friction --model scene.xml --fit demo.h5 -o with_friction.toml",
    "train": "concent train demo.h5 --model model.toml -o runs/insert",
    "distil": "concent distil runs/insert -o runs/student",
    "evaluate": "concent evaluate --checkpoint runs/insert --episodes 200",
    "explain": "concent explain runs/insert trials --html explanation.html",
    "improve": "concent improve demo.h5 --policy runs/insert --trials trials --rounds 3",
    "play": "concent play --checkpoint runs/insert",
    "export": "concent export --checkpoint runs/insert -o policy.onnx",
    "splat-fit": "concent splat-fit photographs -o runs/splats",
    "render-train": "concent render-train robot.h5 -o runs/render",
    "render": "concent render --checkpoint runs/insert -o dataset",
    "train-flow": "concent train-flow dataset -o runs/flow",
}
"""One example of each command, shown by its help."""
OF_NO_TYPE = re.compile(
    r"^error parsing (\S+): no type matching (\S+) could be instantiated from \[(.*?)\]", re.IGNORECASE
)
"""What tyro says of a value that is of none of the types that an option may have."""
LOADING_AFTER = 1.5
"""Time after which a command that has not yet printed anything says that it is loading [s]."""


def _usage() -> str:
    """Return the text of ``concent --help``."""
    lines = []
    for title, commands in GROUPS.items():
        lines += [f"{title}:", *(f"  {name:<13}{text}" for name, text in commands.items()), ""]
    return "\n".join(
        [
            "usage: concent [-h] [--version] COMMAND ...",
            "",
            "From one measured demonstration to a grounded simulation.",
            "",
            *lines,
            "concent COMMAND --help lists the options of a command; concent demo is the place to start.",
        ]
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    0: done. 1: an error that no check foresaw. 2: an input or a setting cannot be worked with. 3: there is nothing to
    suggest. 130, 143: interrupted,
    terminated. 141: the reader of the output has gone. What is wrong is said in one sentence on standard error.

    Args:
        argv: Arguments without the program's name; those of the process by default.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    name = f"concent {arguments[0]}" if arguments and arguments[0] in COMMANDS else "concent"
    return exit_code(name, lambda: _answer(arguments))


def _answer(arguments: Sequence[str]) -> int:
    """Print the help or the version, or run a command, and return the exit code."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_usage())
    elif arguments[0] == "--version":
        print(f"concent {__version__}")
    elif arguments[0] not in COMMANDS:
        complain(f"concent: no command {arguments[0]!r}; expected one of {', '.join(COMMANDS)}.")
        return ERROR
    else:
        _run(arguments[0], arguments[1:])
    return DONE


def _run(command: str, arguments: Sequence[str]) -> None:
    """Run one command.

    Raises:
        ConcentError: An input or a setting cannot be worked with.
    """
    import tyro

    from concent_warp.checks import check_settings, named_as
    from concent_warp.cli.help_text import ALL, readable_help
    from concent_warp.cli.option_names import option_namer
    from concent_warp.files import claimed_files
    from concent_warp.run_folder import INVOCATION

    INVOCATION.set((command, *arguments))
    with _loading(command, help_only=bool({"-h", "--help", ALL} & set(arguments))):
        module = import_module(f"concent_warp.cli.commands.{command.replace('-', '_')}")
        with named_as(option_namer(module.Arguments)):
            with _one_sentence(command), readable_help(command, everything=ALL in arguments):
                given = ["--help" if one == ALL else one for one in arguments]
                settings = tyro.cli(
                    module.Arguments,
                    args=given,
                    default=module.Arguments.default(given) if hasattr(module.Arguments, "default") else None,
                    prog=f"concent {command}",
                    description=f"{_summary(module.Arguments)}\n\nExample: {EXAMPLES[command]}",
                    config=(tyro.conf.HelptextFromCommentsOff,),
                )
            check_settings(settings)
            with claimed_files():
                module.run(settings)


@contextmanager
def _one_sentence(command: str) -> Iterator[None]:
    """Raise an error of one sentence in place of the box that tyro writes where options are wrong.

    Raises:
        ConcentError: Options are unknown, missing or not of their type.
    """
    box = io.StringIO()
    try:
        with redirect_stderr(box):
            yield
    except SystemExit as end:
        if not end.code:
            raise
        raise _found_in_settings(end) or ConcentError(
            parser_sentence(box.getvalue()), fix=f"see concent {command} --help"
        ) from None
    else:
        print(box.getvalue(), end="", file=sys.stderr)


def _found_in_settings(error: BaseException | None) -> ConcentError | None:
    """Return the error of a setting that led to another one, None if there is none."""
    while error is not None and not isinstance(error, ConcentError):
        error = error.__context__
    return error


def parser_sentence(box: str) -> str:
    """Return what is wrong with options, from the box of text that tyro writes about it.

    Args:
        box: A title, what is wrong, a ruler, and perhaps similar options; indented lines are options, those indented
            more their help.
    """
    parts: list[list[str]] = [[]]
    for line in box.splitlines()[1:]:
        inner = line.strip("│╭╰╮╯").removeprefix(" ").removeprefix(" " * (line[:1] == " ")).rstrip()
        if inner and not inner.strip("─-"):
            parts.append([])
        elif inner and not inner.startswith(8 * " "):
            parts[-1].append(inner)
    parts = [part for part in parts if part] or [[]]
    words = (" ".join(line.split()) + "," * line.startswith(" ") for line in parts[0])
    said = " ".join(words).rstrip(",") or "the options are not right"
    if unfit := OF_NO_TYPE.search(said):  # what was tried, one type after the other, says less than the value
        option, kinds, value = unfit.groups()
        said = f"{option} is not right; expected {kinds.replace('{None}|', '')}, found {value}"
    said = f"{said[0].lower()}{said[1:]}".rstrip(".")
    meant = [line.split()[0].rstrip(",") for part in parts[1:2] if "meant" in part[0] for line in part[1:]]
    return f"{said}; perhaps {' or '.join(meant[:3])} is meant" if meant else said


def _summary(arguments: type) -> str:
    """Return the description of a command: its docstring, each paragraph on one line."""
    paragraphs = (inspect.getdoc(arguments) or "").split("\n\n")
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)


@contextmanager
def _loading(command: str, *, help_only: bool) -> Iterator[None]:
    """Print on standard error that a command is loading, unless it has printed something or ended before."""
    stderr = sys.stderr
    timer = Timer(LOADING_AFTER, lambda: HAS_PRINTED.is_set() or print(f"concent {command}: loading ...", file=stderr))
    timer.daemon = True
    HAS_PRINTED.clear()
    if processes()[0] == 0 and not help_only:
        timer.start()
    try:
        yield
    finally:
        timer.cancel()
