"""Mutants of the library's sources: small changes by the operators of cosmic-ray, drawn at random with a seed.

A mutant is drawn by its place: places without replacement, then one of the changes that are possible there, so that a
sum, which has several replacements, weighs no more than a comparison. Left out are

- bodies of Warp kernels and functions, type annotations and blocks under `TYPE_CHECKING`, which Python does not run;
- files and functions named after CUDA, which need a graphics processor;
- bitwise and shift operators in place of arithmetic ones, which raise TypeError on floating-point numbers, and
  `is` in place of `==`: any test that runs the line notices the former, and the latter is equivalent on small numbers.
"""

from __future__ import annotations

import ast
import random
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

ROOMS: dict[str, tuple[str, ...]] = {
    "fit": ("concent_warp/fit",),
    "diagnosis": ("concent_warp/diagnosis",),
    "effects": ("concent_warp/effects",),
    "reward": (
        "train/environment/reward.py",
        "train/environment/environment.py",
        "train/environment/quaternions.py",
        "train/environment/virtual_collision.py",
        "train/task/stages.py",
        "train/task/slots.py",
    ),
    "kernels": ("kernels",),
}
"""Files and folders of each room."""
TESTS: dict[str, tuple[str, ...]] = {
    "fit": ("tests/fit", "tests/estimation"),
    "diagnosis": ("tests/diagnosis",),
    "effects": ("tests/effects", "tests/simulate"),
    "reward": ("tests/train",),
    "kernels": ("tests/kernels",),
}
"""Tests of each room; a mutant is tried on those of all rooms that run its function, the room's own first."""
_ARITHMETIC = ("Add", "Sub", "Mul", "Div", "FloorDiv", "Mod", "Pow")
_COMPARISON = ("Eq", "NotEq", "Lt", "LtE", "Gt", "GtE")
_NOT_RUN = re.compile(r"wp\.(kernel|func|func_native|func_grad|struct)\b")


@dataclass(frozen=True)
class Mutant:
    """A change of one place in a file."""

    room: str
    file: str
    """Path from the root of the repository."""
    line: int
    """Line of the change, from 1."""
    scope: str
    """Qualified name of the function that holds the place; empty at the level of the module or of a class."""
    operator: str
    """Name of cosmic-ray's operator."""
    occurrence: int
    """Which of the changes the operator can make in the file."""

    @property
    def key(self) -> str:
        """Name that differs from those of all other mutants."""
        return f"{self.file}:{self.line} {self.operator} {self.occurrence}"


def operators() -> dict[str, Any]:
    """Return the operators in use, by name."""
    from cosmic_ray.operators.provider import OperatorProvider

    provider = OperatorProvider()
    kinds: dict[str, Any] = {name: provider[name] for name in provider if _is_used(name)}
    return {name: kind() for name, kind in kinds.items()}


def _is_used(name: str) -> bool:
    """Return whether an operator is in use, see the module."""
    kind, *sides = name.split("_")
    if kind == "ReplaceBinaryOperator":
        return len({side in _ARITHMETIC for side in sides}) == 1
    if kind == "ReplaceComparisonOperator":
        return len({side in _COMPARISON for side in sides}) == 1
    return kind not in ("VariableReplacer", "VariableInserter", "NoOp")


def sources(root: Path, room: str) -> list[Path]:
    """Return the files of a room that run without a graphics processor, in order."""
    found = []
    for place in ROOMS[room]:
        path = root / place
        found += [path] if path.is_file() else sorted(path.rglob("*.py"))
    return [path for path in found if "cuda" not in path.name]


def drawn(root: Path, room: str, count: int, seed: int) -> list[Mutant]:
    """Return `count` mutants of a room, fewer where it has not as many places.

    A smaller sample of the same seed is the beginning of a larger one.
    """
    places: dict[tuple[str, int, int], list[Mutant]] = {}
    for path in sources(root, room):
        for (line, column), mutant in mutants(root, room, path):
            places.setdefault((mutant.file, line, column), []).append(mutant)
    rng = random.Random(f"{room} {seed}")
    order = sorted(places)
    rng.shuffle(order)
    chosen = (rng.choice(places[place]) for place in order)
    return list(islice((mutant for mutant in chosen if _is_made(root, mutant)), count))


def _is_made(root: Path, mutant: Mutant) -> bool:
    """Return whether cosmic-ray can make a mutant: it cannot replace an exception that is an attribute of a module."""
    try:
        mutated((root / mutant.file).read_text(), mutant)
    except AttributeError:
        return False
    return True


def mutants(root: Path, room: str, path: Path) -> Iterator[tuple[tuple[int, int], Mutant]]:
    """Yield place (line from 1, column) and mutant, for all mutants of a file."""
    code = path.read_text()
    scopes, file = Scopes(code), str(path.relative_to(root))
    nodes = [node for node in _nodes(_tree(code)) if node.type not in _UNCHANGED and not _is_punctuation(node)]
    for name, operator in operators().items():
        changes = (place for node in nodes for place in operator.mutation_positions(node))
        for occurrence, ((line, column), _) in enumerate(changes):
            scope = scopes.of(line, column)
            if scope is not None:
                yield (line, column), Mutant(room, file, line, scope, name, occurrence)


def mutated(code: str, mutant: Mutant) -> str:
    """Return the code of a file with the change of a mutant."""
    from cosmic_ray.ast import Visitor

    operator = operators()[mutant.operator]

    class Change(Visitor):
        """Changes one node."""

        count = 0

        def visit(self, node: Any) -> Any:
            """Return the node, changed if it is the one, None to remove it."""
            for index, _ in enumerate(operator.mutation_positions(node)):
                if self.count == mutant.occurrence:
                    node = operator.mutate(node, index)
                self.count += 1
            return node

    changed: Any = Change().walk(_tree(code))
    return changed.get_code()


def changed_lines(code: str, other: str) -> tuple[str, str]:
    """Return the first line in which two codes differ, of each, without the blanks around it."""
    for before, after in zip(code.splitlines(), other.splitlines(), strict=False):
        if before != after:
            return before.strip(), after.strip()
    return "", ""


def _tree(code: str) -> Any:
    """Return the concrete syntax tree of a file."""
    import parso

    return parso.parse(code)


_UNCHANGED = ("name", "string", "newline", "endmarker", "fstring_start", "fstring_string", "fstring_end")
"""Types of nodes that no operator changes."""


def _is_punctuation(node: Any) -> bool:
    """Return whether a node is a bracket or the like, which no operator changes."""
    return node.type == "operator" and node.value in (*"()[]{},:.=;", "->")


def _nodes(tree: Any) -> Iterator[Any]:
    """Yield the nodes of a tree in the order of cosmic-ray's walk."""
    yield tree
    for child in getattr(tree, "children", ()):
        yield from _nodes(child)


class Scopes:
    """Which function holds a place of a file, and which places Python does not run."""

    def __init__(self, code: str) -> None:
        """Read a file."""
        self._functions: list[tuple[tuple[int, int], tuple[int, int], str]] = []
        self._skipped: list[tuple[tuple[int, int], tuple[int, int]]] = []
        self._visit(ast.parse(code), "")

    def of(self, line: int, column: int) -> str | None:
        """Return the qualified name of the innermost function around a place, empty for none, None if it is not run."""
        here = (line, column)
        if any(start <= here < end for start, end in self._skipped):
            return None
        found = [name for start, end, name in self._functions if start <= here < end]
        return found[-1] if found else ""

    def _visit(self, node: ast.AST, prefix: str) -> None:
        """Note what lies in a node."""
        for child in ast.iter_child_nodes(node):
            inner = prefix
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
                name = prefix + child.name
                inner = f"{name}.<locals>."
                compiled = any(_NOT_RUN.match(ast.unparse(d)) for d in child.decorator_list)
                if compiled or "cuda" in child.name:
                    start = min([child.lineno, *(d.lineno for d in child.decorator_list)])
                    self._skipped.append(((start, 0), _end(child)))
                    continue
                self._functions.append((_start(child.body[0]), _end(child), name))
                self._skip(child.returns)
            elif isinstance(child, ast.ClassDef):
                inner = f"{prefix}{child.name}."
            elif isinstance(child, ast.arg | ast.AnnAssign):
                self._skip(child.annotation)
            elif isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
                self._skip(child)
            self._visit(child, inner)

    def _skip(self, node: ast.AST | None) -> None:
        """Note that a node is not run."""
        if node is not None:
            self._skipped.append((_start(node), _end(node)))


def _start(node: Any) -> tuple[int, int]:
    """Return where a node begins."""
    return node.lineno, node.col_offset


def _end(node: Any) -> tuple[int, int]:
    """Return where a node ends."""
    return node.end_lineno, node.end_col_offset
