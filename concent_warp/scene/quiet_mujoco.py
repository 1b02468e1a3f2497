"""MuJoCo's warnings, switched off for a while: they are one setting of the process, which threads share."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import mujoco

_LOCK = threading.Lock()
_BEFORE: list[Callable[[str], None] | None] = []
"""What took the warnings before, once for everyone who keeps them off."""


@contextmanager
def quiet_mujoco() -> Iterator[None]:
    """Keep MuJoCo from printing its warnings and from writing MUJOCO_LOG.TXT to the working folder.

    Whoever is last to leave, in whichever thread, puts back what took the warnings before.
    """
    with _LOCK:
        _BEFORE.append(_BEFORE[0] if _BEFORE else mujoco.get_mju_user_warning())
        mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        with _LOCK:
            before = _BEFORE.pop()
            if not _BEFORE:
                mujoco.set_mju_user_warning(before)
