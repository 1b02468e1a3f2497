"""The list of slow tests has none that are not there."""

from __future__ import annotations

import re
from pathlib import Path


def test_each_slow_test_that_is_listed_is_there(root: Path) -> None:
    lines = (root / "tests" / "slow.txt").read_text(encoding="utf-8").splitlines()
    names = [line for line in lines if not line.startswith("#")]
    assert names == sorted(set(names))
    for name in names:
        file, _, function = name.partition("[")[0].partition("::")
        text = (root / file).read_text(encoding="utf-8")
        assert not function or re.search(rf"^def {function}\(", text, re.MULTILINE), name
