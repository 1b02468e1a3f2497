"""What is kept of each round: trials, cause, what was added, commands, times."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from concent_warp.documents import read_json
from concent_warp.errors import ConcentError, TrainError
from concent_warp.events.decode import decode
from concent_warp.files import write_json
from concent_warp.train.trials.evaluate import wilson

Step = Literal["trials", "explain", "model", "train"]
STEPS: tuple[Step, ...] = ("trials", "explain", "model", "train")
"""Steps of a round in their order."""
Ending = Literal["target", "rounds", "waiting", "stopped"]
"""Why it ended: success was reached, all rounds are done, trials of a robot are missing, or the user has to act."""
ROUND_FILE, RESULT_FILE, PAGE_FILE = "round.json", "improve.json", "improve.html"
"""Files of a round, and of all rounds."""


@dataclass(frozen=True)
class MissingEffect:
    """An effect that the explanation names, or of a model that was fitted.

    Example:
        >>> import concent_warp as cw
        >>> cw.MissingEffect("joint_friction", ("joint1",), ("torque[joint1]",), (1.2,)).text
        'joint_friction (torque[joint1] 1.2)'
    """

    name: str
    target: tuple[str, ...]
    parameters: tuple[str, ...]
    """Names of its parameters."""
    values: tuple[float, ...]
    """Their values."""

    @property
    def text(self) -> str:
        """The effect with its values, in words."""
        values = ", ".join(f"{name} {value:.3g}" for name, value in zip(self.parameters, self.values, strict=True))
        return f"{self.name} ({values})" if values else self.name


@dataclass(frozen=True)
class ImprovementRound:
    """One round: the trials of a policy, why they failed, what was done about it.

    Example:
        >>> import concent_warp as cw
        >>> cw.ImprovementRound(1, "runs/insert", successes=12, trials=20).rate
        0.6
    """

    number: int
    policy: str
    """Folder of the policy whose trials these are."""
    done: tuple[Step, ...] = ()
    """Steps that are finished."""
    files: tuple[str, ...] = ()
    """Recordings of the trials."""
    digests: tuple[str, ...] = ()
    """SHA-256 of these."""
    successes: int = 0
    trials: int = 0
    cause: str = ""
    """The cause of the failures, as `Explanation.cause`; empty where nothing was explained."""
    sentences: tuple[str, ...] = ()
    """The explanation in sentences."""
    effects: tuple[MissingEffect, ...] = ()
    """Missing effects that were found, with the values of the explanation."""
    fitted: tuple[MissingEffect, ...] = ()
    """Effects of the next policy's model that were fitted in this round, with their values."""
    indistinct: tuple[str, ...] = ()
    """Other effects that explain the trials as well as the first."""
    mend: str = ""
    """What was done, in words."""
    commands: tuple[str, ...] = ()
    """Commands that the steps equal."""
    seconds: tuple[float, ...] = ()
    """Time of each finished step [s], in the order of `done`."""

    @property
    def rate(self) -> float:
        """Share of the trials that succeeded."""
        return self.successes / max(self.trials, 1)

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the success rate."""
        return wilson(self.successes, self.trials)

    def to_json(self) -> dict[str, Any]:
        """Return the round in plain types."""
        return {**asdict(self), "rate": self.rate, "interval": list(self.interval)}

    def save(self, folder: Path) -> None:
        """Write it to a folder."""
        write_json(folder / ROUND_FILE, asdict(self))

    @staticmethod
    def load(folder: Path) -> ImprovementRound | None:
        """Return the round that `save` wrote to a folder; None where there is none.

        Raises:
            TrainError: The file is damaged.
        """
        path = folder / ROUND_FILE
        if not path.is_file():
            return None
        try:
            return decode(ImprovementRound, read_json(path, TrainError), str(path))
        except ConcentError as error:
            raise TrainError(f"{str(error).rstrip('.')}; start anew with --overwrite") from None


@dataclass(frozen=True)
class Improved:
    """Rounds of improvement.

    Example:
        >>> import concent_warp as cw
        >>> rounds = (cw.ImprovementRound(1, "runs/insert", successes=12, trials=20),)
        >>> cw.Improved(rounds, "waiting", "Trials are missing.", (), "runs/improve/round_1/policy").sentences()[0]
        'Round 1: 12 of 20 trials succeed (60 % [39, 78]).'
    """

    rounds: tuple[ImprovementRound, ...]
    """Rounds in their order; the last one may have trials only."""
    ending: Ending
    reason: str
    """Why it ended, in a sentence."""
    advice: tuple[str, ...]
    """What to do next: commands, each after a comment."""
    policy: str
    """Folder of the last policy."""

    def sentences(self) -> list[str]:
        """Return the result in sentences."""
        return [*(sentence for one in self.rounds for sentence in round_sentences(one)), self.reason]

    def to_json(self) -> dict[str, Any]:
        """Return the result in plain types, as documented in ``docs/improve.md``."""
        return {
            "ending": self.ending,
            "reason": self.reason,
            "advice": list(self.advice),
            "policy": self.policy,
            "rounds": [one.to_json() for one in self.rounds],
        }

    def save(self, folder: Path) -> None:
        """Write ``improve.json``."""
        write_json(folder / RESULT_FILE, self.to_json())


def round_sentences(one: ImprovementRound) -> list[str]:
    """Return a round in sentences."""
    said = []
    if one.trials:
        low, high = (100 * end for end in one.interval)
        counts = f"{one.successes} of {one.trials} trials succeed"
        said.append(f"Round {one.number}: {counts} ({100 * one.rate:.0f} % [{low:.0f}, {high:.0f}]).")
    if one.cause:
        said.append(f"Why the others fail: {one.cause}.")
    if found := one.fitted or one.effects:
        said.append(f"{'Missing' if one.effects else 'Fitted again'}: {'; '.join(effect.text for effect in found)}.")
    if one.indistinct:
        said.append(f"The trials cannot distinguish it from {', '.join(one.indistinct)}.")
    if one.mend:
        said.append(f"What was done: {one.mend}.")
    return said


class RoundsProgress:
    """Progress over all rounds: steps weigh as long as they took in earlier rounds."""

    def __init__(self, rounds: int, report: Callable[[float, str], None]) -> None:
        """Begin.

        Args:
            rounds: Number of rounds.
            report: Called with the share done, 0..1, and what is being done.
        """
        self._rounds, self._report, self._last = rounds, report, 0.0
        # Relative times until they are measured: insertion on a CPU.
        self._weights: dict[Step, float] = {"trials": 1.0, "explain": 4.0, "model": 2.0, "train": 6.0}

    def measured(self, rounds: Iterable[ImprovementRound]) -> None:
        """Take the weights from the mean times of the steps of rounds, as soon as these have all steps."""
        found: dict[Step, list[float]] = {step: [] for step in STEPS}
        for one in rounds:
            for step, seconds in zip(one.done, one.seconds, strict=True):
                found[step].append(seconds)
        if all(found.values()):
            self._weights = {step: sum(times) / len(times) for step, times in found.items()}

    def __call__(self, number: int, step: Step, share: float, text: str) -> None:
        """Report that a share of a step of a round is done; what is reported never falls."""
        whole = sum(self._weights.values())
        before = sum(self._weights[one] for one in STEPS[: STEPS.index(step)])
        done = (number - 1) * whole + before + min(max(share, 0.0), 1.0) * self._weights[step]
        total = self._rounds * whole + self._weights["trials"]
        self._last = max(self._last, min(done / max(total, 1e-9), 1.0))
        self._report(self._last, f"round {number}: {text}")

    def end(self) -> None:
        """Report that all is done."""
        self._report(1.0, "done")
