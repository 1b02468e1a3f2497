"""Error messages for broken inputs: runs every case of `bad_input_cases` and writes the table of messages.

    python -m benchmarks.recording.bad_input [--output FILE] [--library]

Each case runs ``concent compare <recording> --model <model>`` in its own working folder. It passes if the command
fails, prints exactly one sentence on stderr without a traceback, and leaves no file behind, neither in the working
folder nor beside the inputs. The valid recording and model that the cases are made from must be accepted first.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks.recording.bad_input_cases import Case, cases, write_good
from concent_warp.errors import ConcentError
from concent_warp.model import Model
from concent_warp.recording.load import load_recording

OUTPUT = Path(__file__).parents[2] / "docs" / "benchmarks" / "bad_input.md"


@dataclass(frozen=True)
class Outcome:
    """Result of one case."""

    case: Case
    code: int
    """Exit status of the command."""
    message: str
    """Everything printed on stderr, with the paths of the temporary folder shortened."""
    left: list[str]
    """Files that were not there before."""
    seconds: float

    @property
    def faults(self) -> list[str]:
        """What is wrong with the way the input was refused."""
        found = []
        if self.code == 0:
            found.append("exit status 0")
        if len(self.message.splitlines()) != 1 or not self.message.endswith("."):
            found.append("not one sentence")
        if "Traceback" in self.message:
            found.append("a traceback")
        if self.left:
            found.append(f"files left: {self.left}")
        return found


def attempt(case: Case, *, command: bool) -> Outcome:
    """Build a case in a temporary folder and give it to the program.

    Args:
        case: The case.
        command: True runs the command line, False the readers of the library.
    """
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        inputs, work = root / "inputs", root / "work"
        inputs.mkdir()
        work.mkdir()
        recording, model = case.build(inputs)
        before = listing(root)
        start = time.perf_counter()
        with contextlib.chdir(work), contextlib.redirect_stdout(io.StringIO()), captured() as text:
            try:
                code = run_command(recording, model) if command else run_library(recording, model)
            except Exception:
                traceback.print_exc()
                code = 1
        seconds = time.perf_counter() - start
        message = text.getvalue().strip().replace(f"{inputs}{os.sep}", "").replace(str(root), "")
        return Outcome(case, code, message, sorted(listing(root) - before), seconds)


def run_command(recording: Path, model: Path) -> int:
    """Run ``concent compare`` in this process and return its exit status."""
    from concent_warp.cli import main

    try:
        code = main(["compare", str(recording), "--model", str(model)])
    except SystemExit as stop:
        code = stop.code
    if isinstance(code, str):
        print(code, file=sys.stderr)
        return 1
    return code or 0


def run_library(recording: Path, model: Path) -> int:
    """Read both inputs as the command does, and return its exit status."""
    try:
        load_recording(recording)
        Model.load(model)
    except ConcentError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


@contextlib.contextmanager
def captured() -> Iterator[io.StringIO]:
    """Collect what Python and the libraries below it write to stderr."""
    text = io.StringIO()
    sys.stderr.flush()
    saved = os.dup(2)
    with tempfile.TemporaryFile("w+") as file:
        os.dup2(file.fileno(), 2)
        try:
            with contextlib.redirect_stderr(file):
                yield text
        finally:
            file.flush()
            os.dup2(saved, 2)
            os.close(saved)
            file.seek(0)
            text.write(file.read())


def listing(folder: Path) -> set[str]:
    """Return the paths of all files below a folder."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def table(outcomes: list[Outcome], command: bool) -> str:
    """Return the page with all messages."""
    way = "`concent compare RECORDING --model MODEL`" if command else "`load_recording` and `Model.load`"
    passed = sum(not outcome.faults for outcome in outcomes)
    lines = [
        "# Broken inputs",
        "",
        f"`python -m benchmarks.recording.bad_input`: {len(outcomes)} inputs, each with one fault, are given to",
        f"{way}. {passed} of {len(outcomes)} are refused as required: exit status other than 0,",
        "one sentence on stderr, no traceback, no file left behind. The valid recording and model that they are made",
        f"from are accepted. The longest case takes {max(outcome.seconds for outcome in outcomes):.1f} s. Faults that",
        "are not in the table are not tested.",
        "",
        "| | input | fault | message |",
        "|---|---|---|---|",
    ]
    for i, outcome in enumerate(outcomes, 1):
        message = outcome.message.replace("|", "\\|").replace("\n", " ")
        failed = f" **FAILED: {', '.join(outcome.faults)}**" if outcome.faults else ""
        lines.append(f"| {i} | {outcome.case.kind} | {outcome.case.name} | {message}{failed} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Run all cases, print and write the table; the exit status says whether all passed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    parser.add_argument("--library", action="store_true", help="call the readers, not the command line")
    arguments = parser.parse_args()
    output, command = arguments.output.resolve(), not arguments.library
    sound = attempt(Case("none", "nothing", write_good), command=command)
    if sound.code or sound.message:
        print(f"the inputs are refused before anything in them is broken: {sound.message}", file=sys.stderr)
        return 1
    outcomes = [attempt(case, command=command) for case in cases()]
    page = table(outcomes, command)
    print(page)
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(page)
    return int(any(outcome.faults for outcome in outcomes))


if __name__ == "__main__":
    sys.exit(main())
