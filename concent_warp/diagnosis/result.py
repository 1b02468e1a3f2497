"""The result of a diagnosis: which effect is missing with its evidence, or why none can be named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np

from concent_warp.comparison.units import interval_texts, p_value_text
from concent_warp.diagnosis.constants import FinerTimeStep, HoldingConstraint
from concent_warp.diagnosis.detectable import Detectable, detectable_sentence
from concent_warp.diagnosis.experiment.suggested import SuggestedExperiment
from concent_warp.diagnosis.replayed import Replayed
from concent_warp.diagnosis.result_html import diagnosis_html
from concent_warp.diagnosis.values_text import SCATTER_CLAUSE, nominal_sentence, parameters_text
from concent_warp.effects.table import posteriors_table
from concent_warp.fit.effects.intervals import FittedParameter
from concent_warp.model import Model

Verdict = Literal["effect", "group", "none_needed", "none_of_these", "unsettled"]
FARTHER = (
    "In a replay in one piece the model with what was fitted is farther off than as given, or hardly nearer: it stays "
    "as given."
)
"""What is said where nothing was named, and what was fitted makes a replay no better."""
VERDICTS: dict[Verdict, str] = {
    "effect": "an effect is missing, and the data identify it",
    "group": "an effect is missing; the data cannot distinguish between a few",
    "none_needed": "no discrepancy detected",
    "none_of_these": "something is missing that no effect in the library explains",
    "unsettled": "the time did not suffice for a verdict",
}
"""Verdicts in words."""
STEP_TOO_LONG = "the time step of the model is too long for a verdict"
NOISE_OPEN = "the noise is too uncertain for a verdict"
"""The same of "unsettled" where no time was short."""
MOST_DETECTABLE = 6
"""Effects whose smallest detectable sizes are named."""


@dataclass(frozen=True)
class Finding:
    """An effect with its evidence.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> cfg = cw.DiagnoseCfg(effects=("joint_friction",), jobs=1, explain=False)
        >>> finding = cw.diagnose(cw.Model.from_recording(recording), recording, cfg).effects[0]
        >>> finding.name, finding.accepted, finding.gain > 0.9
        ('joint_friction', True, True)
    """

    name: str
    target: tuple[str, ...]
    family: str
    parameters: tuple[FittedParameter, ...]
    gain: float
    """Share of the held-out error that it removes [-]."""
    low: float
    """Lower end of the 95 % interval of the gain."""
    high: float
    """Upper end."""
    p: float
    """Probability that the best of all candidates gains as much where nothing is missing [-]."""
    sign_p: float
    """p-value of this effect's gain alone, by sign flips of the blocks' gains [-]."""
    accepted: bool
    step: int
    """Index of the addition that it is a candidate for."""
    removes: tuple[tuple[str, float], ...]
    """Channels whose residual falls, with the fall as a share of the squared residual [-], largest first."""
    reason: str = ""
    """Why it was not accepted, where it was not."""
    smallest_p: float = 0.0
    """Smallest `p` that the null distribution can give [-]."""

    @property
    def p_text(self) -> str:
        """`p` as text: "p = 0.03", or "p <= 0.0025" at the smallest that the null distribution can give."""
        return p_value_text(self.p, self.smallest_p)

    @property
    def may_be_null(self) -> bool:
        """Whether each parameter, by itself, may be at the value at which the effect does nothing."""
        return bool(self.parameters) and not any(p.excludes_null for p in self.parameters)

    def to_json(self) -> dict[str, Any]:
        """Return the finding in plain types."""
        return {
            "name": self.name,
            "target": list(self.target),
            "family": self.family,
            "parameters": [_parameter(p) for p in self.parameters],
            "gain": {"value": self.gain, "interval": [self.low, self.high]},
            "p": self.p,
            "p_smallest": self.smallest_p,
            "p_sign_flip": self.sign_p,
            "accepted": self.accepted,
            "step": self.step,
            "removes": [{"channel": name, "share": share} for name, share in self.removes],
            **({"reason": self.reason} if self.reason else {}),
        }


@dataclass(frozen=True)
class UnknownForceFound:
    """A force of no known form that explains part of the last model's residual."""

    words: str
    """The coordinate or body that it acts on, and what it depends on."""
    gain: float
    """Share of the held-out error that it removes [-]."""
    p: float
    """Probability that the best of such forces gains as much where nothing is missing [-]."""
    share: float
    """Share of the discrepancy of the model as given that it explains, beyond what an effect does [-]."""
    instead: float | None = None
    """Share of the held-out error that the effect removes which was added instead [-]; None where the force acts beside
    all effects."""
    form_error: bool = False
    """Whether it explains so little of the discrepancy that it is an error of the form of the accepted effects."""
    varies: bool = False
    """Whether it is no force but an effect that has another value in each window."""

    @property
    def sentence(self) -> str:
        """A sentence on what the force explains."""
        words, gain = f"{self.words[0].upper()}{self.words[1:]}", 100 * self.gain
        if self.form_error:
            return (
                f"{words} explains {_percent(self.share)} of the discrepancy besides: no more than an error in the "
                "formulas of the accepted effects."
            )
        if self.instead is None:
            return f"{words} explains another {gain:.0f} % of the error."
        added = f"the effect that was added explains {100 * self.instead:.0f} %"
        return f"{words} explains {gain:.0f} % of an error of which {added}."

    def to_json(self) -> dict[str, Any]:
        """Return the force in plain types."""
        return asdict(self)


@dataclass(frozen=True)
class Diagnosis:
    """Which physical effect a model lacks.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> cfg = cw.DiagnoseCfg(effects=("joint_friction",), jobs=1, explain=False)
        >>> diagnosis = cw.diagnose(cw.Model.from_recording(recording), recording, cfg)
        >>> [effect.name for effect in diagnosis.accepted], diagnosis.model.effects[0].effect.name
        (['joint_friction'], 'joint_friction')
    """

    verdict: Verdict
    effects: tuple[Finding, ...]
    """Accepted effects, then rejected ones, best first."""
    groups: tuple[tuple[str, ...], ...]
    """Names that the data cannot distinguish, one tuple an addition; the likeliest first."""
    where: tuple[Mapping[str, Any], ...]
    """Where the model as given fails: channel, phase, start and end [s], body, direction, ratio, sentence."""
    unexplained: float
    """Squared residual of the final model beyond the noise, over that of the model as given [-]."""
    ratio: tuple[float, ...]
    """RMS residual over noise of the model as given and after each addition [-]."""
    detectable: tuple[Detectable, ...]
    """Smallest size of each effect that this recording would reveal."""
    next_experiment: SuggestedExperiment | None
    """Motion that would distinguish the effects of the first group; None where there is no such group."""
    issues: tuple[str, ...]
    """Sentences on what is wrong or doubtful with the data themselves."""
    models: tuple[Model, ...] = field(repr=False)
    """The model as given, its own parameters fitted, and after each addition."""
    versions: Mapping[str, str] = field(default_factory=dict)
    seed: int = 0
    unknown_force: UnknownForceFound | None = None
    """A force of no known form that explains part of the last model's residual; None where there is none."""
    form_error: float | None = None
    """Share of the discrepancy that is left above the noise and taken for errors in the formulas of the accepted
    effects [-]; None where no more than noise is left, or something else is missing."""
    remainder_searched: bool | None = None
    """Whether the search for further effects beside the accepted ones came to its end; False where the time ended it,
    so that something smaller may be missing too; None where the verdict is another one than "effect" or "group"."""
    replayed: Replayed | None = None
    """What a replay in one piece says of `model`; None where it was not done, or the verdict is another one than
    "effect" or "group", or than "unsettled" for the sake of this replay and a noise that is too uncertain."""
    time_step: FinerTimeStep | None = None
    """A shorter time step that the data ask for; None where the model's own is short enough."""
    holding: tuple[HoldingConstraint, ...] = ()
    """Where the data ask for constraints that hold, by other constants of the simulator than its defaults."""
    nominal_values: tuple[FittedParameter, ...] = ()
    """Masses, lengths, gains and latencies that the data ask for within their tolerance; factors but for latencies."""
    unsettled: tuple[str, ...] = ()
    """Sentences on what there was no time for, see `DiagnoseCfg.seconds`."""
    explains: bool = True
    """Whether the accepted effects explain enough to be in `model`, see `DiagnoseCfg.min_explained`."""
    rests_on_scatter: bool = False
    """Whether what the last model leaves is no more than noise only because the scatter of simulated contacts over a
    time step counts as such."""
    farther: bool = False
    """Whether `model` stays as given as what was found, and not named, makes a replay of the recording no better."""

    @property
    def model(self) -> Model:
        """The model with all accepted effects; as given where something else is missing that explains far more."""
        return self.models[-1 if self.explains else 0]

    @property
    def accepted(self) -> tuple[Finding, ...]:
        """The effects that were accepted, in the order of their addition."""
        return tuple(f for f in self.effects if f.accepted)

    @property
    def changes_model(self) -> bool:
        """Whether `model` differs from the model as given by more than the values of its own parameters."""
        return self.explains and (
            bool(self.accepted or self.nominal_values or self.holding) or self.time_step is not None
        )

    @property
    def headline(self) -> str:
        """The verdict in words; where effects were accepted and a discrepancy is left, it says both."""
        if self.verdict == "none_of_these" and self.accepted:
            return "the library explains a part; something is missing that none of its effects explains"
        if self.replayed is not None and self.verdict == "unsettled":
            return NOISE_OPEN
        if self.replayed is not None and self.replayed.doubtful:
            return f"{VERDICTS[self.verdict]}, over short windows{self._size_open}"
        if self.verdict == "unsettled" and self.time_step is not None and self.time_step.too_long:
            return STEP_TOO_LONG
        return f"{VERDICTS[self.verdict]}{self._size_open}"

    @property
    def _size_open(self) -> str:
        """What the headline adds where the intervals of an effect that is named include no change."""
        names = [f.name for f in self.accepted if f.may_be_null] if self.verdict == "effect" else []
        if not names:
            return ""
        return ", but not its size" if len(self.accepted) == 1 else f", but not the size of {_joined(names, 'and')}"

    def to_json(self) -> dict[str, Any]:
        """Return the diagnosis in plain types, as documented in ``docs/diagnose.md``."""
        return {
            "verdict": self.verdict,
            "effects": [f.to_json() for f in self.effects],
            "groups": [list(group) for group in self.groups],
            "explains": self.explains,
            "where": [dict(place) for place in self.where],
            "unexplained": self.unexplained,
            "unknown_force": None if self.unknown_force is None else self.unknown_force.to_json(),
            "form_error": self.form_error,
            "remainder_searched": self.remainder_searched,
            "replayed": None if self.replayed is None else self.replayed.to_json(),
            "time_step": None if self.time_step is None else self.time_step.to_json(),
            "holding": [h.to_json() for h in self.holding],
            "nominal_values": [_parameter(p) for p in self.nominal_values],
            "changes_besides": self.changes_besides(),
            "posterior": self._posterior(),
            "ratio": list(self.ratio),
            "rests_on_scatter": self.rests_on_scatter,
            "detectable": [d.to_json() for d in self.detectable],
            "next_experiment": None if self.next_experiment is None else self.next_experiment.summary(),
            "issues": list(self.issues),
            "unsettled": list(self.unsettled),
            "versions": dict(self.versions),
            "seed": self.seed,
        }

    def _posterior(self) -> dict[str, Any] | None:
        """Return the joint posterior of the parameters of `model` in plain types; None where there is none."""
        effects = [a for a in self.model.effects if a.posterior is not None] if self.changes_model else []
        if not effects:
            return None
        bare = replace(self.model, effects=()).compile()
        (row, *_) = posteriors_table(effects)
        members = [effects[k] for k in row["effects"]]
        named = [(a.effect.name, p) for a in members for p in a.effect.parameters(bare)]
        values = [v for a in members for v in a.values]
        return {
            "parameters": [
                {"effect": name, "name": p.name, "value": _number(value), "unit": p.unit, "scale": scale,
                 "bounds": [_number(low), _number(high)]}
                for (name, p), value, scale, low, high in zip(
                    named, values, row["scale"], row["low"], row["high"], strict=True
                )
            ],
            "covariance": row["covariance"],
        }  # fmt: skip

    def _remainder_sentences(self) -> list[str]:
        """Return what is said of a remainder beside the accepted effects: its size, and whether it was searched."""
        said = []
        if self.form_error is not None:
            said.append(
                f"What is left, {self.ratio[-1]:.2f} x noise, is {_percent(self.form_error)} of the discrepancy: no "
                "more than errors in the formulas of the accepted effects."
            )
        if self.rests_on_scatter and self.verdict in ("effect", "group"):
            said.append(f"Residuals are {self.ratio[-1]:.2f} x noise; {SCATTER_CLAUSE}.")
        if self.remainder_searched is False:
            said.append("Whether something smaller is missing too was not settled in this time.")
        if self.replayed is not None and self.replayed.doubtful:
            said.append(self.replayed.sentence)
        return said

    def _repr_html_(self) -> str:
        """Return the verdict and the accepted effects as HTML, for notebooks."""
        headline = f"{self.headline[0].upper()}{self.headline[1:]}"
        return diagnosis_html(headline, [row for f in self.accepted for row in _table_rows(f)], self.sentences())

    def sentences(self) -> list[str]:
        """Return the result in sentences."""
        said = []
        if self.verdict == "none_needed":
            beside = f"; {SCATTER_CLAUSE}" if self.rests_on_scatter else ""
            said.append(f"No discrepancy detected: residuals are {self.ratio[-1]:.2f} x noise{beside}.")
            if self.detectable:
                said.append(detectable_sentence(self.detectable[:MOST_DETECTABLE]))
        for k, finding in enumerate(self.accepted):
            group = self.groups[k] if k < len(self.groups) else (finding.name,)
            lead = "Missing" if k == 0 else "Then missing"
            lead = "The best so far" if self.verdict == "unsettled" else lead
            lead = "Explains a part" if self.verdict == "none_of_these" else lead
            said.append(
                f"{lead}: {finding.name}{_owner(finding)} ({parameters_text(finding.parameters)}). "
                f"Held-out error falls by {100 * finding.gain:.0f} % "
                f"[{100 * finding.low:.0f}, {100 * finding.high:.0f}], {finding.p_text}."
            )
            if len(group) > 1:
                said.append(f"The data cannot distinguish it from {_joined(group[1:])}.")
            if finding.may_be_null:
                said.append(
                    f"Each interval of {finding.name} includes no change, as errors of nominal values within their "
                    "tolerance, or of the fit, may be as large: the fall of the error speaks for it."
                )
        if self.verdict == "none_of_these":
            share = f"{100 * self.unexplained:.0f} %" if self.unexplained >= 0.005 else "Less than 1 %"
            said.append(f"{share} of the discrepancy stays unexplained by any effect in the library.")
            if not self.explains and self.accepted:
                too_little = "The effects above explain too little to be added: the model stays as given."
                said.append(FARTHER if self.farther else too_little)
        said += self._remainder_sentences()
        if self.unknown_force is not None:
            said.append(self.unknown_force.sentence)
        if self.next_experiment:
            said.append(f"Next experiment: {self.next_experiment.sentence}")
        farther = [FARTHER] if self.farther and not self.accepted else []
        return [*self.issues, *self.changes_besides(), *farther, *said, *self.unsettled]

    def changes_besides(self) -> list[str]:
        """Return a sentence on each thing that the last model has besides effects: constants and nominal values."""
        said = [one.sentence for one in (*self.holding, self.time_step) if one is not None]
        return [*said, nominal_sentence(self.nominal_values)] if self.nominal_values else said


def _percent(share: float) -> str:
    """Return a small share in per cent, to a tenth of one."""
    return f"{100 * share:.1f} %" if share >= 0.0005 else "less than 0.1 %"


def _owner(finding: Finding) -> str:
    """Return what a single target adds to the name of an effect: nothing where the name or the parameters tell it."""
    told = "(" in finding.name or any("[" in p.name for p in finding.parameters)
    return f" of {finding.target[0]}" if len(finding.target) == 1 and not told else ""


def _table_rows(finding: Finding) -> list[tuple[str, ...]]:
    """Return a row of the HTML table for each parameter; effect, gain and p-value stand in the first."""
    gain = f"{100 * finding.gain:.0f} % [{100 * finding.low:.0f}, {100 * finding.high:.0f}]"
    return [
        (
            finding.name if k == 0 else "",
            p.name,
            value,
            f"{low} to {high}",
            p.unit,
            gain if k == 0 else "",
            finding.p_text if k == 0 else "",
        )
        for k, p in enumerate(finding.parameters)
        for value, low, high in [interval_texts(p.value, p.low, p.high)]
    ]


def _parameter(p: FittedParameter) -> dict[str, Any]:
    """Return a fitted parameter in plain types."""
    interval = [_number(p.low), _number(p.high)]
    return {"name": p.name, "value": _number(p.value), "interval": interval, "unit": p.unit, "null": _number(p.null)}


def _number(value: float) -> float | None:
    """Return a number that JSON can hold; None for one that is not finite."""
    return float(value) if np.isfinite(value) else None


def _joined(names: Sequence[str], last: str = "or") -> str:
    """Return names as a list in words."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {last} {names[-1]}"
