"""Structure of the code: rooms, their size, circles of imports, public names, length of the README.

    python -m benchmarks.development.structure              # this checkout
    python -m benchmarks.development.structure OTHER        # a checkout of another version beside it

A room is a folder of modules of the package. A circle is a set of modules that import one another, imports under
`TYPE_CHECKING` included. Public are functions of modules without a leading underscore; the front door is what
`import concent_warp` offers.
"""

from __future__ import annotations

import ast
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path

from benchmarks.pages import ROOT, table

FOLDERS = {"concent_warp": "concent_warp", "kernels": "concent_warp.kernels", "train": "concent_warp.train"}
FOLDERS |= {"render": "concent_warp.render"}
"""Top-level folders, with the packages that they are installed as."""


def modules(root: Path) -> dict[str, ast.Module]:
    """Return the parsed modules of a checkout by name."""
    found = {}
    for folder, package in FOLDERS.items():
        for path in (root / folder).rglob("*.py"):
            parts = path.relative_to(root / folder).with_suffix("").parts
            name = ".".join((package, *(part for part in parts if part != "__init__")))
            found[name] = ast.parse(path.read_text())
    return found


def imports(name: str, tree: ast.Module, known: set[str]) -> Iterator[str]:
    """Yield the modules of the package that one imports anywhere in its text."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                one = f"{node.module}.{alias.name}"
                yield from ({one, node.module} & known) - {name} if one not in known else {one}
        elif isinstance(node, ast.Import):
            yield from {alias.name for alias in node.names} & known


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Return the strongly connected components of more than one node (Tarjan, SIAM J. Comput. 1, 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in graph[node]:
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            at = stack.index(node)
            if len(stack) - at > 1:
                found.append(sorted(stack[at:]))
            del stack[at:]

    for node in graph:
        if node not in index:
            visit(node)
    return found


def rooms(root: Path) -> dict[Path, int]:
    """Return the number of modules in each folder of the package, `__init__.py` not counted."""
    found: dict[Path, int] = {}
    for folder in FOLDERS:
        for path in (root / folder).rglob("*.py"):
            if path.name != "__init__.py":
                found[path.parent] = found.get(path.parent, 0) + 1
    return found


def front_door(root: Path) -> int:
    """Return how many names the package of a checkout offers."""
    return len(runpy.run_path(str(root / "concent_warp" / "__init__.py")).get("__all__", ()))


def main() -> None:
    """Print the table."""
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT
    trees = modules(root)
    graph = {name: set(imports(name, tree, set(trees))) for name, tree in trees.items()}
    of_rooms: dict[str, set[str]] = {}
    for name, others in graph.items():
        room = name.split(".")[1] if "." in name else name
        of_rooms.setdefault(room, set())
        of_rooms[room] |= {o.split(".")[1] if "." in o else o for o in others} - {room}
    public = sum(
        isinstance(node, ast.FunctionDef) and not node.name.startswith("_")
        for tree in trees.values()
        for node in tree.body
    )
    sizes = rooms(root)
    largest = max(sizes, key=lambda path: sizes[path])
    rows = [
        ["rooms (folders of modules)", str(len(sizes))],
        ["modules in the largest", f"{sizes[largest]} (`{largest.relative_to(root)}`)"],
        ["circles of modules", str(len(circles(graph)))],
        ["circles of top-level rooms", str(len(circles(of_rooms)))],
        ["names of the front door", str(front_door(root))],
        ["public functions of modules", f"{public:,}"],
        ["words of the README", f"{len((root / 'README.md').read_text().split()):,}"],
    ]
    print(table(["", "value"], rows))


if __name__ == "__main__":
    main()
