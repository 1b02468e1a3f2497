"""What the pages of results share: where they and their data lie, facts of the machine, Markdown tables."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping, Sequence
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any

from concent_warp.files import write_text

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "docs" / "benchmarks"
PACKAGES = ("mujoco", "mujoco-warp", "warp-lang", "torch")


def machine(device: str = "cpu") -> dict[str, Any]:
    """Return what results depend on: processor, cores, graphics processor where `device` is one, versions, date."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    facts: dict[str, Any] = {
        "processor": names[0] if names else platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        **{name: version(name) for name in PACKAGES},
        "date": date.today().isoformat(),
    }
    if device != "cpu":
        import warp as wp

        facts = {"device": wp.get_device(device).name, **facts}
    return facts


def machine_line(facts: dict[str, Any]) -> str:
    """Return the facts of a machine as a sentence."""
    first = f"{facts['device']}, " if "device" in facts else ""
    packages = ", ".join(f"{name} {facts[name]}" for name in ("python", *PACKAGES))
    return f"Measured {facts['date']} on {first}{facts['processor']}, {facts['cores']} cores ({packages})."


def machines(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a sentence for each machine that rows were measured on, as they are kept by their keys."""
    return " ".join(dict.fromkeys(machine_line(row["machine"]) for row in rows.values()))


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table whose columns, but the first, are aligned to the right."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def data_path(name: str) -> Path:
    """Return where the data of a page lie."""
    return FOLDER / "data" / f"{name}.json"


def read_data(name: str) -> dict[str, Any]:
    """Return the data of a page, nothing where there are none yet."""
    path = data_path(name)
    return json.loads(path.read_text()) if path.is_file() else {}


def write_data(name: str, data: dict[str, Any]) -> None:
    """Write the data of a page."""
    path = data_path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")


def write_page(name: str, text: str) -> None:
    """Write a page and print it."""
    path = FOLDER / f"{name}.md"
    write_text(path, text.rstrip() + "\n")
    print(text)
    print(f"wrote {path.relative_to(ROOT)}")
