"""Where the sources are, for tests of the package as a whole."""

from __future__ import annotations

import gc
import os
import tomllib
from pathlib import Path

import pytest

LONG = (
    *("test_drake_world.py", "test_bullet_world.py", "test_docs.py", "test_examples.py", "test_front_door.py"),
    *("test_cli_play.py", "test_distil.py", "test_foreign_recordings.py", "test_train.py", "test_robustness.py"),
    *("test_docs_site.py", "test_flow_at_work.py", "test_flow_policy.py", "test_springs.py", "test_suggest.py"),
    *("test_calibrate_by_tags.py", "test_foreign_contact.py", "test_time_budget.py", "test_render_commands.py"),
    *("test_independent_worlds.py", "test_bad_input.py", "test_data_parallel.py", "test_report_browser.py"),
    *("test_softer_contacts.py", "test_nominal_values.py", "test_overflow.py", "test_foreign.py"),
    *("test_cli_diagnose.py", "test_disk_full.py", "test_rough_impacts.py"),
)
"""Files of more than a quarter of a minute, the longest first."""
SLOW = Path(__file__).with_name("slow.txt")
"""Names of slow tests, besides those that are marked where they stand."""
os.environ.setdefault("LOKY_MAX_CPU_COUNT", "1")
"""Where a number of processes is not given, work is done in the test's own: one worker a CPU runs tests already."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what `slow.txt` lists, before slow tests are left out.

    Put long files first, so that no worker begins one when the others have nothing left to do.
    """
    slow = {line for line in SLOW.read_text(encoding="utf-8").splitlines() if not line.startswith("#")}
    for item in items:
        name = item.nodeid
        if not slow.isdisjoint({name, name.partition("[")[0], name.partition("::")[0]}):
            item.add_marker(pytest.mark.slow)
    items.sort(key=lambda item: LONG.index(item.path.name) if item.path.name in LONG else len(LONG))


def pytest_collection_finish() -> None:
    """Leave what all tests together have imported out of every garbage collection to come, and collect less often."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 10, 10)


@pytest.fixture(scope="session")
def root() -> Path:
    """Return the folder of the repository."""
    return Path(__file__).parents[1]


@pytest.fixture(scope="session")
def rooms(root: Path) -> dict[str, Path]:
    """Return the folder of each import package that does not lie within another's."""
    project = tomllib.loads((root / "pyproject.toml").read_text())
    return {package: root / folder for package, folder in project["tool"]["setuptools"]["package-dir"].items()}
