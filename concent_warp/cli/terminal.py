"""What the commands write to the terminal."""

from __future__ import annotations

import ctypes
import math
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

from concent_warp.errors import printable
from concent_warp.run_folder import processes

if TYPE_CHECKING:
    from rich.console import Console, RenderableType


HAS_PRINTED = Event()
"""Set once a command has printed something."""
WIDTH = 80
"""Columns of a table where there is no terminal and COLUMNS is not set."""


def _console(*, stderr: bool = False) -> Console:
    """Return the console for results, or for progress and remarks, which go to standard error."""
    from rich.console import Console

    width = None if sys.stdout.isatty() or "COLUMNS" in os.environ else WIDTH
    return Console(stderr=stderr, highlight=False, width=width, quiet=processes()[0] > 0)


def table_width() -> int:
    """Return the columns that a table may have."""
    return _console().width


def say(message: RenderableType) -> None:
    """Write a remark or a table to standard output; text may carry rich's markup."""
    HAS_PRINTED.set()
    out = _console()
    if isinstance(message, str):
        message = "\n".join(printable(line) for line in message.split("\n"))
    out.print(message, soft_wrap=isinstance(message, str) and not out.is_terminal)


def say_written(*paths: Path) -> None:
    """Write which files are new."""
    from rich.text import Text

    HAS_PRINTED.set()
    out = _console()
    out.print(Text("wrote ") + Text(printable(", ".join(map(str, paths))), style="bold"), soft_wrap=not out.is_terminal)


CANCELLED = r"\d+ tasks which were still being processed by the workers have been cancelled"
"""Warning of joblib after an interruption."""


@contextmanager
def one_line_warnings(command: str) -> Iterator[None]:
    """Show each warning of Python as one line, without the place in the code."""
    before = warnings.formatwarning

    def line(message: Warning | str, *_: object, **__: object) -> str:
        HAS_PRINTED.set()
        return f"{command}: warning: {printable(' '.join(str(message).split()))}\n"

    warnings.formatwarning = line
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", CANCELLED)
            yield
    finally:
        warnings.formatwarning = before


def quiet_warp() -> None:
    """Keep Warp from printing the modules that it loads; say so where it has to compile them first."""
    import warp

    warp.config.log_level = warp.LOG_WARNING
    cache = Path(warp.config.kernel_cache_dir or Path.home() / ".cache" / "warp" / warp.__version__)
    if not (cache.is_dir() and any(cache.iterdir())):
        _console(stderr=True).print("compiling kernels: once for this version of Warp, kept for later runs")
    if not _has_cuda_driver():
        with _no_native_output():
            warp.init()


def _has_cuda_driver() -> bool:
    """Return whether there is a CUDA driver; where there is none, Warp says so on standard error."""
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    return True


@contextmanager
def _no_native_output() -> Iterator[None]:
    """Drop what libraries that are not Python write to standard error, as Warp does where there is no CUDA driver."""
    try:
        saved = os.dup(2)
    except OSError:  # there is no standard error
        yield
        return
    try:
        sys.stderr.flush()
        with open(os.devnull, "wb") as null:
            os.dup2(null.fileno(), 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[..., None]]:
    """Show a bar with an estimate of the time left.

    What is given is to be called with the share done, 0..1, and where that is known a text on what is being done.
    """
    with status_bar(title) as update:
        first: tuple[float, float] | None = None

        def show(share: float, text: str = "") -> None:
            # What was done before, by a run that is continued, took none of this time.
            nonlocal first
            now = time.monotonic()
            first = first or (share, now)
            done = share - first[0]
            known = done > 0.02 * (1 - first[0])
            update(share, text, (now - first[1]) * (1 - share) / done if known else math.nan)

        yield show


@contextmanager
def status_bar(title: str) -> Iterator[Callable[[float, str, float | None], None]]:
    """Show a bar, a line of text beside it and the time left.

    What is given is to be called with the share done, 0..1, the text, and the seconds left, None to estimate them from
    the share. A text that ends with a line break stays above the bar. Where there is no terminal, plain lines come now
    and then.
    """
    out = _console(stderr=True)
    begun = time.monotonic()
    if not out.is_terminal:
        last = -PLAIN_PERIOD

        def plain(share: float, text: str, left: float | None) -> None:
            nonlocal last
            spent = time.monotonic() - begun
            if text.endswith("\n"):
                out.print(f"{title}: {printable(text.strip())}", markup=False)
            elif share > 0 and spent - last >= PLAIN_PERIOD:
                last = spent
                HAS_PRINTED.set()
                out.print(f"{title}: {100 * share:.0f} %{' ' * bool(text)}{text}{_time_left(share, spent, left)}")

        yield plain
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    HAS_PRINTED.set()
    columns = (TextColumn(title), BarColumn(), TextColumn("{task.fields[text]}"), TimeElapsedColumn())
    with Progress(*columns, console=out, transient=True) as bar:
        task = bar.add_task(title, total=1.0, text="")

        def update(share: float, text: str, left: float | None) -> None:
            if text.endswith("\n"):
                bar.console.print(printable(text.strip()), markup=False)
                return
            remaining = _time_left(share, time.monotonic() - begun, left)
            bar.update(task, completed=share, text=f"{text}{remaining}".lstrip(", "))

        yield update


PLAIN_PERIOD = 5.0
"""Time between lines of progress where there is no terminal [s]."""


def _time_left(share: float, spent: float, left: float | None) -> str:
    """Return the time left as words, empty while it is not known."""
    if left is None:
        if share <= 0.02:
            return ""
        left = spent * (1 - share) / share
    if math.isnan(left):
        return ""
    return f", {left / 60:.0f} min left" if left > 90 else f", {left:.0f} s left"
