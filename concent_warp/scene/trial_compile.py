"""Trial of a large or unusual scene in a process of its own, with limited time and memory.

MuJoCo's compiler cannot be stopped from within its process, nor can memory that it takes be bounded there.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from concent_warp.errors import SceneError
from concent_warp.limits import limits, raising

PROGRAM = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from concent_warp.scene.trial_process import compile_given; compile_given()"
)
"""What the process runs; it finds the same packages as this one."""
SAID = "the scene: "
"""Begins the line in which the process says what MuJoCo says."""
OUT_OF_MEMORY = ("MemoryError", "bad_alloc", "allocate memory", "unknown exception", "Unable to allocate")
"""What is said where memory is exhausted."""
NESTED = "CONCENT_TRIAL"
"""Environment variable that is set in the process, so that it does not start another."""


def try_compile(source: str, *, path: Path | None = None, text: str | None = None) -> None:
    """Compile a scene in a process of its own.

    Args:
        source: Where the scene is from, for messages.
        path: MJCF file; or else
        text: MJCF text.

    Raises:
        SceneError: It takes too much time or memory, MuJoCo refuses it, or it ends the process.
    """
    if NESTED in os.environ:
        return
    most = limits()
    command = [sys.executable, "-P", "-c", PROGRAM, json.dumps(sys.path)]
    command += [str(most.scene_memory_bytes), "" if path is None else str(path.resolve())]
    with tempfile.TemporaryDirectory() as folder:
        try:
            done = subprocess.run(
                command,
                input="" if text is None else text,
                capture_output=True,
                text=True,
                errors="replace",
                cwd=folder,
                env={**os.environ, NESTED: "1"},
                timeout=most.scene_seconds,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise SceneError(
                "MuJoCo takes too long to compile this scene",
                where=source,
                expected=f"at most {most.scene_seconds:g} s",
                fix=raising("scene_seconds"),
            ) from None
        except OSError:  # no process can be started: the scene is compiled untried
            return
    if done.returncode == 0:
        return
    said = next((line for line in reversed(done.stderr.splitlines()) if line.startswith(SAID)), "")
    memory = any(word in done.stderr for word in OUT_OF_MEMORY) or done.returncode == -signal.SIGKILL
    if memory:
        raise SceneError(
            "MuJoCo needs too much memory for this scene",
            where=source,
            expected=f"at most {most.scene_memory_bytes:,} bytes",
            fix=raising("scene_memory_bytes"),
        )
    if said:
        raise SceneError(said.removeprefix(SAID).rstrip("."))
    if done.returncode < 0:
        name = signal.Signals(-done.returncode).name
        raise SceneError(
            "MuJoCo crashes when it compiles this scene", where=source, found=name, fix="simplify the MJCF"
        )
