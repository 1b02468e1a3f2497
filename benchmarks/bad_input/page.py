"""The page with what became of all cases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from benchmarks.bad_input.attempt import MAX_BYTES, MAX_SECONDS, Outcome
from benchmarks.bad_input.random_input import Tried
from benchmarks.pages import machine, machine_line, table

LONGEST = 200
"""Characters of a message that are shown."""
INTRODUCTION = """# Bad input

`python -m benchmarks.bad_input`: {count} inputs for the commands of `concent`, one command each, in a folder of sound
inputs of which one is broken. {passed} of {count} are treated as required.

- A bad input is refused: an exit status other than 0 and no signal, one sentence on stderr, no file that is new, gone
  or changed, at most {seconds:g} s and {memory:g} GiB of memory, libraries included.
- A sound but unusual input is accepted: exit status 0.

Each command runs in a process forked from one that has imported all libraries; the memory of these, about 0.4 GiB, is
counted. Two commands run at a time. Faults that are not in the list are not tested.

{machine}
"""


def page(outcomes: Sequence[Outcome], random: Mapping[str, Tried]) -> str:
    """Return the page."""
    passed = sum(not outcome.faults for outcome in outcomes)
    introduction = INTRODUCTION.format(
        count=len(outcomes),
        passed=passed,
        seconds=MAX_SECONDS,
        memory=MAX_BYTES / 2**30,
        machine=machine_line(machine()),
    )
    parts = [introduction, "## By area\n", summary(outcomes), *random_part(random)]
    parts += ["## By command and area\n", by_command(outcomes), "## Messages\n", messages(outcomes)]
    return "\n".join(parts)


def row_of(name: Sequence[str], outcomes: Sequence[Outcome]) -> list[str]:
    """Return a row of the table for some outcomes."""
    sound = sum(outcome.case.accepted for outcome in outcomes)
    return [
        *name,
        str(len(outcomes)),
        str(sum(not outcome.faults and not outcome.case.accepted for outcome in outcomes)),
        f"{sum(not outcome.faults and outcome.case.accepted for outcome in outcomes)} of {sound}" if sound else "",
        str(sum(bool(outcome.faults) for outcome in outcomes)),
        str(sum("Traceback" in outcome.message for outcome in outcomes)),
        f"{max(outcome.seconds for outcome in outcomes):.1f}",
        f"{max(outcome.memory for outcome in outcomes) / 2**30:.2f}",
    ]


COLUMNS = ("cases", "refused", "accepted", "faults", "tracebacks", "longest [s]", "memory [GiB]")


def summary(outcomes: Sequence[Outcome]) -> str:
    """Return the table by area."""
    areas = dict.fromkeys(outcome.case.area for outcome in outcomes)
    rows = [row_of([area], [o for o in outcomes if o.case.area == area]) for area in areas]
    if outcomes:
        rows.append(row_of(["**all**"], outcomes))
    return table(["area", *COLUMNS], rows)


def by_command(outcomes: Sequence[Outcome]) -> str:
    """Return how many cases each command has in each area."""
    areas = list(dict.fromkeys(outcome.case.area for outcome in outcomes))
    commands = list(dict.fromkeys(outcome.case.command for outcome in outcomes))
    known = [c for c in commands if sum(o.case.command == c for o in outcomes) > 3]
    rows = []
    for command in [*known, ""]:
        ours = [o for o in outcomes if (o.case.command == command if command else o.case.command not in known)]
        counts = [sum(outcome.case.area == area for outcome in ours) for area in areas]
        slowest = f"{max((outcome.seconds for outcome in ours), default=0):.1f}"
        faults = str(sum(bool(outcome.faults) for outcome in ours))
        rows.append([command or "others", *(str(count or "") for count in counts), faults, slowest])
    return table(["command", *areas, "faults", "longest [s]"], rows)


def random_part(random: Mapping[str, Tried]) -> list[str]:
    """Return the part about random inputs, empty without any."""
    if not random:
        return []
    rows = [
        [name, str(tried.refused + tried.accepted), str(tried.refused), str(tried.accepted), str(len(tried.faults))]
        for name, tried in random.items()
    ]
    text = (
        "## Random input\n\nSound inputs changed at random (hypothesis, derandomized): each is either refused in one "
        "sentence or accepted; a\nrecording with flipped bits is accepted only if what is read is unchanged.\n"
    )
    return [text, table(["input", "examples", "refused", "accepted", "faults"], rows)]


def messages(outcomes: Sequence[Outcome]) -> str:
    """Return the table of all cases with what was said."""
    rows = []
    for number, outcome in enumerate(outcomes, 1):
        said = escaped(outcome.message) or ("accepted" if outcome.case.accepted else "")
        failed = f" **FAULT: {escaped(', '.join(outcome.faults))}**" if outcome.faults else ""
        rows.append([str(number), outcome.case.command, escaped(outcome.case.name), said + failed])
    return table(["", "command", "input", "message"], rows)


def escaped(text: str) -> str:
    """Return a text as the cell of a table, shortened."""
    line = " ".join(text.split())
    if len(line) > LONGEST:
        line = f"{line[: LONGEST - 60]} ... {line[-50:]}"
    for character in "\\|<>*_[]`":
        line = line.replace(
            character, "\\" + character if character not in "<>" else {"<": "&lt;", ">": "&gt;"}[character]
        )
    return line
