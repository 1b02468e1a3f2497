from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]
APART = "concent_warp.reality"


def imported(source: str) -> set[str]:
    """Return the modules that a source text imports, wherever in it; relative imports as they are written."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            names |= {module} | {f"{module.rstrip('.')}.{alias.name}" for alias in node.names}
    return names


def test_library_does_not_import_reality():
    files = [path for room in ("concent_warp", "kernels", "train", "render") for path in (ROOT / room).rglob("*.py")]
    allowed = [ROOT / "concent_warp" / "reality", ROOT / "concent_warp" / "cli", ROOT / "concent_warp" / "deploy"]
    library = [path for path in files if not any(room in (path, *path.parents) for room in allowed)]
    assert len(library) > 30
    offenders = [
        str(path.relative_to(ROOT))
        for path in library
        if any(name.startswith(APART) or name.endswith(".reality") for name in imported(path.read_text()))
    ]
    assert not offenders


def test_an_import_of_reality_would_be_noticed():
    for line in (
        "import concent_warp.reality.record",
        "from concent_warp.reality import record",
        "from concent_warp import reality",
        "def f():\n    from concent_warp.reality.world import HiddenEffect",
    ):
        assert any(name.startswith(APART) for name in imported(line)), line


def test_reality_imports_no_model_engine_fit_or_diagnosis():
    forbidden = [
        f"concent_warp.{room}" for room in ("model", "effects", "simulate", "fit", "events", "diagnose", "report")
    ]
    for path in (ROOT / "concent_warp" / "reality").glob("*.py"):
        reached = {name for name in imported(path.read_text()) if name.startswith(tuple(forbidden))}
        assert not reached, path.name
