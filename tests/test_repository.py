"""Build server, commit hooks and issue templates name what exists."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

BIN = Path(sys.executable).parent


def load(path: Path) -> Any:
    """Return what a YAML file holds; the key `on` is not a boolean."""
    return yaml.load(path.read_text(), yaml.BaseLoader)


@pytest.fixture(scope="module")
def targets(root: Path) -> set[str]:
    """Return the targets of the Makefile that stand for no file."""
    (line,) = re.findall(r"^\.PHONY: (.*)$", (root / "Makefile").read_text(), re.MULTILINE)
    return set(line.split())


def test_help_lists_every_target_and_every_target_has_a_rule(root, targets):
    text = (root / "Makefile").read_text()
    assert set(re.findall(r'"make (\w+) ', text)) == targets - {"help"}
    assert set(re.findall(r"^(\w+):(?!=)", text, re.MULTILINE)) == targets


def test_workflow_calls_targets_on_every_python_that_the_package_allows(root, targets):
    workflow = load(root / ".github" / "workflows" / "checks.yml")
    lines = [step.get("run", "") for job in workflow["jobs"].values() for step in job["steps"]]
    called = {word for line in lines for word in re.sub(r"\S+=.*", "", line).split() if line.startswith("make ")}
    assert {"lint", "types", "imports", "tests", "docs"} <= called - {"make"} <= targets
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    assert project["requires-python"] == ">=3.11,<3.14"
    assert workflow["jobs"]["tests"]["strategy"]["matrix"]["python"] == ["3.11", "3.12", "3.13"]


def test_hooks_call_tools_that_are_installed(root):
    (repository,) = load(root / ".pre-commit-config.yaml")["repos"]
    programs = [hook["entry"].split()[0] for hook in repository["hooks"]]
    assert [name for name in programs if name != "make" and not (BIN / Path(name).name).is_file()] == []
    assert len(programs) >= 8


@pytest.mark.parametrize("name", ["bug", "feature", "question"])
def test_issue_template_is_a_form_with_a_required_field(root, name):
    form = load(root / ".github" / "ISSUE_TEMPLATE" / f"{name}.yml")
    assert form["name"]
    assert form["description"]
    fields = [part for part in form["body"] if part["type"] != "markdown"]
    assert any(part.get("validations", {}).get("required") == "true" for part in fields)
    assert len({part["id"] for part in fields}) == len(fields)


def test_bug_template_asks_for_recording_model_command_and_versions(root):
    form = load(root / ".github" / "ISSUE_TEMPLATE" / "bug.yml")
    assert {"recording", "model", "command", "versions"} <= {part["id"] for part in form["body"]}


def test_test_files_have_names_of_their_own(root):
    names = [path.name for path in (root / "tests").rglob("test_*.py")]
    assert sorted({name for name in names if names.count(name) > 1}) == []  # pytest imports each by its name alone
