"""The time that a diagnosis may take, and what is not settled when it is over."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

import numpy as np

from concent_warp.diagnosis.result import Verdict
from concent_warp.simulate.time_limit import TimeUpError, stop_at

T = TypeVar("T")

SEARCH_SHARE, PROFILE_SHARE, TOGETHER_SHARE = 0.75, 0.87, 0.93
"""Shares of the time after which the search for effects ends, the profile likelihoods of those that were accepted, and
the fit of all together."""


class TimeBudget:
    """The time of one diagnosis from now on; unlimited where it is None."""

    def __init__(self, seconds: float | None) -> None:
        """Set the time [s]."""
        self.begun, self.seconds = time.time(), seconds
        self.unsettled: list[str] = []
        """Sentences on what there was no time for."""
        self.cut: set[int] = set()
        """Indices of the additions whose search was not finished."""
        self.doubted: set[int] = set()
        """Indices of the additions to a model that leaves little more than noise, where there was no time to try
        whether its time step, nominal values or other initial states explain that as well."""

    def left(self) -> float:
        """Return the time that is left [s], infinite where it is unlimited."""
        return np.inf if self.seconds is None else max(self.begun + self.seconds - time.time(), 0.0)

    @contextmanager
    def until(self, share: float) -> Iterator[None]:
        """Let simulations within stop after a share of the time, 0..1."""
        with stop_at(None if self.seconds is None else self.begun + share * self.seconds):
            yield

    def attempt(
        self, work: Callable[[], T], otherwise: T, unsettled: str, share: float = 1.0, doubted: int | None = None
    ) -> T:
        """Return the result of some work, or what there is otherwise where the time does not suffice for it.

        Args:
            work: What to do.
            otherwise: Result without it.
            unsettled: Sentence on what is not settled then.
            share: Share of the time after which it stops, 0..1.
            doubted: Index of the addition that is in doubt without it, see `doubted`.
        """
        try:
            with self.until(share):
                return work()
        except TimeUpError:
            self.note(unsettled)
            if doubted is not None:
                self.doubted.add(doubted)
            return otherwise

    def note(self, sentence: str, cut: int | None = None) -> None:
        """Keep a sentence on what is not settled, and of which addition the search was not finished."""
        if sentence not in self.unsettled:
            self.unsettled.append(sentence)
        if cut is not None:
            self.cut.add(cut)

    def verdict(self, found: Verdict, accepted: Sequence[int]) -> Verdict:
        """Return a verdict, or "unsettled" where candidates that might change it were not fitted.

        An accepted effect stands where all that could have been accepted in its place were fitted, and what else might
        explain a little; that nothing, or nothing in the library, is missing takes a search to its end.

        Args:
            found: The verdict on what was computed.
            accepted: Indices of the additions in which an effect was accepted.
        """
        decisive = (self.cut | self.doubted) & set(accepted) if found in ("effect", "group") else self.cut
        return "unsettled" if decisive else found


def in_words(names: Sequence[str], most: int = 6) -> str:
    """Return names as a list, of many the first and how many there are."""
    return ", ".join(names) if len(names) <= most else f"{', '.join(names[:most])} and {len(names) - most} more"
