"""Scripts that run in a process of their own each, forked from one that has imported for all of them."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

SERVER = """
import importlib, json, os, sys

for name in sys.argv[1:]:
    importlib.import_module(name)
for line in sys.stdin:
    script, arguments = json.loads(line)
    pipes = [os.pipe(), os.pipe()]
    child = os.fork()
    if not child:
        for number, (_, end) in enumerate(pipes, 1):
            os.dup2(end, number)
        for pipe in pipes:
            os.close(pipe[0])
            os.close(pipe[1])
        sys.argv = ["-c", *arguments]
        exec(script, {"__name__": "__main__"})
        sys.exit()  # with all that is done at the end of an interpreter
    for _, end in pipes:
        os.close(end)
    said = [os.fdopen(begin).read() for begin, _ in pipes]
    print(json.dumps([os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), *said]), flush=True)
"""


class Forks:
    """A process that has imported some modules and nothing else, as a context; scripts run in forks of it."""

    def __init__(self, *modules: str) -> None:
        command = [sys.executable, "-c", SERVER, *modules]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def run(self, script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Return how a script ended and what it printed, as of ``python -c`` with some arguments."""
        given, found = self._process.stdin, self._process.stdout
        assert given is not None
        assert found is not None
        given.write(json.dumps([script, arguments]) + "\n")
        given.flush()
        code, out, err = json.loads(found.readline())
        return subprocess.CompletedProcess([script, *arguments], code, out, err)

    def __enter__(self) -> Forks:
        return self

    def __exit__(self, *_: Any) -> None:
        self._process.communicate()
        assert self._process.returncode == 0
