"""Independent tasks of a diagnosis, in processes by joblib where more than one is allowed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar, cast

from concent_warp.simulate.parallel import limit_simulations

T = TypeVar("T")

Progress = Callable[[float, str], None]
"""Called with the share done, 0..1, and what is being done."""


def ignore_progress(share: float, text: str) -> None:
    """Ignore the progress, see `Progress`."""
    del share, text


class TaskRunner:
    """Runs independent tasks in order of their results and reports progress."""

    def __init__(self, jobs: int = 1, progress: Progress = ignore_progress) -> None:
        """Prepare to run `jobs` processes at a time, -1 for one per CPU."""
        self.jobs, self.progress = jobs, progress
        self.share = 0.0
        """Share of the whole diagnosis that is done, 0..1."""

    def run(
        self, task: Callable[..., T], arguments: Sequence[tuple[Any, ...]], text: str, span: float = 0.0
    ) -> list[T]:
        """Return the results of a task for each tuple of arguments, in their order.

        Args:
            task: A module-level function.
            arguments: One tuple a task.
            text: What is being done, for the progress.
            span: Share of the whole diagnosis that these tasks take.
        """
        results: list[T] = []
        for i, result in enumerate(self.results(task, arguments)):
            results.append(result)
            self.progress(self.share + span * (i + 1) / max(len(arguments), 1), f"{text}, {i + 1} of {len(arguments)}")
        self.share += span
        return results

    def results(self, task: Callable[..., T], arguments: Sequence[tuple[Any, ...]]) -> Iterable[T]:
        """Yield the results in order, as they are known."""
        return run_tasks(task, arguments, self.jobs)


def run_tasks(task: Callable[..., T], arguments: Sequence[tuple[Any, ...]], jobs: int) -> Iterable[T]:
    """Yield the results of independent tasks in order, by joblib where several may run at a time.

    Where there are fewer tasks than processes, each task runs several simulations at a time.
    """
    if jobs == 1 or len(arguments) < 2:
        return (task(*each) for each in arguments)
    from joblib import Parallel, delayed, effective_n_jobs

    threads = effective_n_jobs(jobs) // len(arguments)
    calls = (delayed(_with_threads)(threads, task, *each) for each in arguments)
    return cast("Iterable[T]", Parallel(n_jobs=jobs, return_as="generator")(calls))


def _with_threads(threads: int, task: Callable[..., T], *arguments: Any) -> T:
    """Run a task with at most so many simulations at a time, at least one."""
    with limit_simulations(threads):
        return task(*arguments)
