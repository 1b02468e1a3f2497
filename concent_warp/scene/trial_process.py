"""What the process runs that `trial_compile` starts: it compiles one scene with bounded memory."""

from __future__ import annotations

import sys
from pathlib import Path

from concent_warp.errors import SceneError
from concent_warp.scene.scene import Scene
from concent_warp.scene.trial_compile import SAID


def compile_given() -> None:
    """Compile the scene that the arguments of this process name, or that standard input holds."""
    memory, name = int(sys.argv[2]), sys.argv[3]
    _bound_memory(memory)
    try:
        if name:
            Scene.from_mjcf(Path(name))
        else:
            assert Scene(sys.stdin.read()).model.nbody
    except SceneError as error:
        print(SAID + " ".join(str(error).split()), file=sys.stderr)
        sys.exit(1)


def _bound_memory(extra: int) -> None:
    """Let this process allocate at most `extra` bytes more, where the system has such a limit; leave no core file."""
    try:
        import resource
    except ImportError:
        return
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    usage = Path("/proc/self/statm")
    used = int(usage.read_text().split()[0]) * resource.getpagesize() if usage.is_file() else 1 << 30
    resource.setrlimit(resource.RLIMIT_AS, (used + extra, used + extra))
