"""The ``concent`` command. Each command reads its arguments and calls one function of the library."""

from concent_warp.cli.entry import main

__all__ = ["main"]
