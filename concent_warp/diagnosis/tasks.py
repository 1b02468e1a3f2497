"""Independent tasks of a diagnosis, in processes by joblib where more than one is allowed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar, cast

from concent_warp.simulate.parallel import limit_simulations
from concent_warp.simulate.time_limit import TimeUpError, deadline, stop_at

T = TypeVar("T")

Progress = Callable[[float, str], None]
"""Called with the share done, 0..1, and what is being done."""

PART = 0.4
"""Share of what is left of a phase that some tasks in it take, where it is not known how many follow [-]. Empirical."""


def ignore_progress(share: float, text: str) -> None:
    """Ignore the progress, see `Progress`."""
    del share, text


class TaskRunner:
    """Runs independent tasks in order of their results and reports progress."""

    def __init__(self, jobs: int = 1, progress: Progress = ignore_progress) -> None:
        """Prepare to run `jobs` processes at a time, -1 for one per CPU."""
        self.jobs, self.progress = jobs, progress
        self.share, self.end = 0.0, 1.0
        """Shares of the whole diagnosis that are done now and at the end of the present phase, 0..1."""

    def enter(self, begin: float, end: float) -> None:
        """Begin a phase.

        Args:
            begin: Share of the whole diagnosis that is done, 0..1; less than before where more is to do than it seemed.
            end: Share that is done at its end.
        """
        self.share, self.end = begin, end

    def run(
        self, task: Callable[..., T], arguments: Sequence[tuple[Any, ...]], text: str, part: float = PART
    ) -> list[T]:
        """Return the results of a task for each tuple of arguments, in their order.

        Args:
            task: A module-level function.
            arguments: One tuple a task.
            text: What is being done, for the progress.
            part: Share of what is left of the phase that these tasks take, 0..1.

        Raises:
            TimeUpError: There was no time for one of them.
        """
        results = self.run_in_time(task, arguments, text, part)
        finished = [result for result in results if result is not None]
        if len(finished) < len(results):
            raise TimeUpError("a task was not finished in the time given")
        return finished

    def run_in_time(
        self, task: Callable[..., T], arguments: Sequence[tuple[Any, ...]], text: str, part: float = PART
    ) -> list[T | None]:
        """Return the results as `run` does, None for those that there was no time for."""
        results: list[T | None] = []
        span = part * (self.end - self.share)
        for i, result in enumerate(self.results(task, arguments)):
            results.append(result)
            self.progress(self.share + span * (i + 1) / len(arguments), f"{text}, {i + 1} of {len(arguments)}")
        self.share += span if arguments else 0.0
        return results

    def results(self, task: Callable[..., T], arguments: Sequence[tuple[Any, ...]]) -> Iterable[T | None]:
        """Yield the results in order, as they are known; None for those that there was no time for."""
        return run_tasks_in_time(task, arguments, self.jobs)


def run_tasks(task: Callable[..., T], arguments: Sequence[tuple[Any, ...]], jobs: int) -> Iterable[T]:
    """Yield the results of independent tasks in order, see `run_tasks_in_time`.

    Raises:
        TimeUpError: There was no time for one of them.
    """
    for found in _outcomes(task, arguments, jobs):
        if not found:
            raise TimeUpError("a task was not finished in the time given")
        yield found[0]


def run_tasks_in_time(task: Callable[..., T], arguments: Sequence[tuple[Any, ...]], jobs: int) -> Iterable[T | None]:
    """Yield the results of independent tasks in order, by joblib where several may run at a time.

    Where there are fewer tasks than processes, each task runs several simulations at a time. Of those that the time
    does not suffice for (`concent_warp.simulate.time_limit`) the result is None.
    """
    return (found[0] if found else None for found in _outcomes(task, arguments, jobs))


def _outcomes(
    task: Callable[..., T], arguments: Sequence[tuple[Any, ...]], jobs: int
) -> Iterable[tuple[T] | tuple[()]]:
    """Yield the results in order, empty where the time did not suffice."""
    end = deadline()
    if jobs == 1 or len(arguments) < 2:
        return (_until(end, task, *each) for each in arguments)
    from joblib import Parallel, delayed, effective_n_jobs

    threads = effective_n_jobs(jobs) // len(arguments)
    calls = (delayed(_with_threads)(threads, end, task, *each) for each in arguments)
    return cast("Iterable[tuple[T] | tuple[()]]", Parallel(n_jobs=jobs, return_as="generator")(calls))


def _with_threads(threads: int, end: float | None, task: Callable[..., T], *arguments: Any) -> tuple[T] | tuple[()]:
    """Run a task with at most so many simulations at a time, at least one, until a time."""
    with limit_simulations(threads):
        return _until(end, task, *arguments)


def _until(end: float | None, task: Callable[..., T], *arguments: Any) -> tuple[T] | tuple[()]:
    """Run a task; return nothing if it is not done at a time [s since the epoch]."""
    try:
        with stop_at(end):
            return (task(*arguments),)
    except TimeUpError:
        return ()
