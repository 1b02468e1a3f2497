"""The boundary between a command and the shell: errors become one sentence and an exit code, streams stay usable."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from concent_warp.cli.terminal import one_line_warnings
from concent_warp.errors import ConcentError, printable
from concent_warp.run_folder import command_line, processes, versions
from concent_warp.version import __version__

DONE, FAULT, ERROR, NOTHING_FOUND, INTERRUPTED, CLOSED, TERMINATED = 0, 1, 2, 3, 130, 141, 143
"""Exit codes: done; an error that no check foresaw; an input or setting that cannot be worked with; what was looked
for is not there, as a motion that decides a diagnosis; and, as shells count, 128 with the number of a signal:
interrupted, output closed by its reader, terminated."""
WAIT_FOR_RANK_ZERO = 10.0
"""How long other processes wait for the first one to say what is wrong [s]."""


def exit_code(command: str, run: Callable[[], int]) -> int:
    """Return the exit code of a command; what stops it is said in one sentence on standard error.

    Args:
        command: What the sentence begins with, such as "concent fit".
        run: Runs the command and returns its exit code.
    """
    signalled = threading.Event()
    with ExitStack() as stack:
        stack.enter_context(_usable_streams())
        stack.enter_context(one_line_warnings(command))
        stack.enter_context(_termination_as_interruption(signalled))
        code = _code_of(command, run, signalled)
        return _flushed(command, code)


def _code_of(command: str, run: Callable[[], int], signalled: threading.Event) -> int:
    """Return the exit code of a function, in place of whatever it raises."""
    try:
        return run()
    except ConcentError as error:
        complain(f"{command}: {error}")
        return ERROR
    except BrokenPipeError:
        return _leave_pipe()
    except KeyboardInterrupt as interrupt:
        if processes()[0] == 0:
            word = "terminated" if signalled.is_set() else "interrupted"
            _write_error(f"\n{command}: {word}. {interrupt}".rstrip())
        return TERMINATED if signalled.is_set() else INTERRUPTED
    except SystemExit as end:  # tyro ends the process after a wrong option or --help
        wait_for_rank_zero()
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except OSError as error:
        place = "" if error.filename is None else f"{error.filename}: "
        complain(f"{command}: {place}{error.strerror or error}; check the path and the disk.")
        return ERROR
    except RecursionError as error:
        complain(f"{command}: an input is nested too deeply; make it flatter{_logged(error)}.")
        return ERROR
    except Exception as error:
        if isinstance(error, MemoryError) or "OutOfMemory" in type(error).__name__:
            advice = "use a smaller input, fewer worlds or smaller images"
            complain(f"{command}: the memory is not enough; {advice}{_logged(error)}.")
            return ERROR
        kind, text = type(error).__name__, " ".join(str(error).split())[:300]
        said = f"{kind}: {text}" if text else kind
        complain(f"{command}: stopped by an error that no check foresaw ({said}); check the input{_logged(error)}.")
        return FAULT


def _logged(error: BaseException) -> str:
    """Return where the details of an error are, as the end of a sentence; empty where no file can be written."""
    try:
        file, path = tempfile.mkstemp(prefix="concent_", suffix=".log", text=True)
        with open(file, "w", encoding="utf-8", errors="backslashreplace") as log:
            log.write(f"{command_line()}\nconcent {__version__}, {versions()}\n\n")
            log.write("".join(traceback.format_exception(error)))
    except OSError:
        return ""
    return f", and report it with the details in {path} if it should work"


@contextmanager
def _usable_streams() -> Iterator[None]:
    """Replace standard streams that are closed, and let those write any text that cannot encode all characters."""
    for name in ("stdout", "stderr"):
        stream: Any = getattr(sys, name)
        if stream is None or stream.closed:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
        elif hasattr(stream, "reconfigure") and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")
    yield


@contextmanager
def _termination_as_interruption(signalled: threading.Event) -> Iterator[None]:
    """Let a first SIGTERM interrupt a command as Ctrl-C does, so that it cleans up; a second one ends it at once.

    Of several processes torchrun ends the others with SIGTERM when one fails; they could not clean up together.
    """
    if processes()[1] > 1 or threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(*_: object) -> None:
        signalled.set()
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _flushed(command: str, code: int) -> int:
    """Write what is left for standard output, and return the exit code."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        return _leave_pipe()
    except OSError as error:
        _leave_pipe()
        if code == DONE:
            complain(f"{command}: standard output cannot be written: {error.strerror}; check where it goes.")
            return ERROR
    return code


def _leave_pipe() -> int:
    """Give up standard output, which its reader has closed as `head` does, and return the exit code for that."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return CLOSED


def complain(sentence: str) -> None:
    """Write to standard error; of several processes, which one error stops all, the first that comes to it."""
    wait_for_rank_zero()
    _write_error(printable(sentence))


def _write_error(text: str) -> None:
    """Write a line to standard error if that can be written."""
    with suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)


def wait_for_rank_zero() -> None:
    """Wait for the first of several processes, which says what is wrong with all and ends them by leaving."""
    if processes()[0] > 0:
        time.sleep(WAIT_FOR_RANK_ZERO)
