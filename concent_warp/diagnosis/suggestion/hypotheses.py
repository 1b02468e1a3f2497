"""The hypotheses that the next recording is to distinguish: what a diagnosis leaves open, fitted to the data at hand.

Two kinds: the effects of a group, one hypothesis each beside all other accepted effects; or the ends of the interval
of a parameter that is not known well enough.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.diagnosis.diagnose import DIAGNOSIS_FILE
from concent_warp.diagnosis.result import Diagnosis
from concent_warp.diagnosis.suggestion.cfg import SuggestCfg
from concent_warp.documents import is_number, read_json
from concent_warp.effects.effect import AddedEffect, with_unit
from concent_warp.effects.registry import effect_class
from concent_warp.errors import ModelError
from concent_warp.fit.effects.fit import fit_effects
from concent_warp.fit.effects.intervals import NORMAL_QUANTILE
from concent_warp.fit.effects.nominal import possible_nominal_effects
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from concent_warp.simulate.select import EngineName


@dataclass(frozen=True)
class Hypothesis:
    """A model that may be right."""

    name: str
    model: Model
    """Its values are fitted to the data at hand."""
    std: np.ndarray
    """Standard deviation with which these leave its parameters open, shape (P,); 0 for one that is given."""
    nominal: int = 0
    """Number of parameters, the first ones, that are nominal values within their tolerance and were not fitted."""

    def with_nominal_values(self, cfg: SuggestCfg) -> Hypothesis:
        """Return the hypothesis with all nominal values that it lacks, open within their tolerance."""
        compiled, added, std = self.model.compile(), [], list[float]()
        have = {(a.effect.name, target) for a in self.model.effects for target in a.effect.target}
        for effect in possible_nominal_effects(self.model):
            targets = [t for t in effect.target if (effect.name, t) not in have]
            if not targets:
                continue
            lacking = type(effect)(*targets)
            parameters = lacking.parameters(compiled)
            added.append(AddedEffect(lacking, tuple(p.null for p in parameters)))
            std += [cfg.fit.least_squares.prior * p.scale for p in parameters]
        model = replace(self.model, effects=(*added, *self.model.effects))
        return Hypothesis(self.name, model, np.concatenate([std, self.std]), len(std))


@dataclass(frozen=True)
class OpenQuestion:
    """What a diagnosis leaves open."""

    models: Mapping[str, Model]
    """Models by hypothesis, the likeliest first, not yet fitted; one alone for an interval."""
    parameter: tuple[int, int, float, float] | None = None
    """Effect and parameter whose interval is too wide, and the interval; None for a group."""
    sentence: str = ""
    """What is open, or why nothing is."""
    width: float = 0.0
    """Half the interval over the parameter's distance from the null value [-]."""

    def narrowed(self, evidence: float) -> float:
        """Return the width that is left after a recording.

        The ends of a 95 % interval are 2 x 1.96 standard deviations s apart, and tell them apart with an evidence E
        [nat] adds the information 2 E / (2 x 1.96 s)^2 to 1 / s^2.
        """
        return self.width / float(np.sqrt(1 + 2 * evidence / (2 * NORMAL_QUANTILE) ** 2))

    def needed(self, width: float) -> float:
        """Return the evidence that narrows the interval to a width [nat], see `narrowed`."""
        return 0.5 * (2 * NORMAL_QUANTILE) ** 2 * max((self.width / width) ** 2 - 1, 0.0)


def open_question(model: Model, diagnosis: Diagnosis | Mapping[str, Any], cfg: SuggestCfg) -> OpenQuestion:
    """Return what a diagnosis leaves open; without models where nothing is.

    Args:
        model: The model that was diagnosed.
        diagnosis: The diagnosis, or its JSON object.
        cfg: Settings.

    Raises:
        ModelError: The diagnosis is of another model, or not as `Diagnosis.to_json` returns it.
    """
    document = diagnosis.to_json() if isinstance(diagnosis, Diagnosis) else diagnosis
    verdict, findings, groups = _checked(document)
    accepted = sorted((f for f in findings if f.get("accepted")), key=lambda f: f.get("step", 0))
    if verdict == "none_needed":
        return OpenQuestion({}, sentence="No effect is missing: there is nothing to distinguish.")
    base = _with_nominal(model, document.get("nominal_values") or [])
    for place, group in enumerate(groups[: len(accepted)]):
        if len(group) > 1:
            others = [f for k, f in enumerate(accepted) if k != place]
            known = {name: _finding(name, findings, accepted[place]) for name in group[: cfg.max_hypotheses]}
            models = {name: _with(base, [*others, found]) for name, found in known.items()}
            left = len(group) - len(models)
            more = f", and {left} less likely ones that are left out" if left else ""
            return OpenQuestion(models, sentence=f"Open: {_listed(list(models))}{more}.")
    if not accepted:
        return OpenQuestion(
            {}, sentence=f'The verdict is "{verdict}" without an accepted effect: no hypotheses to distinguish.'
        )
    widest = max(
        ((_width(p), k, i) for k, f in enumerate(accepted) for i, p in enumerate(f["parameters"])), default=None
    )
    if widest is None or widest[0] <= cfg.max_interval:
        names, whose = _listed([f["name"] for f in accepted]), "their" if len(accepted) > 1 else "its"
        known = f"all {whose} parameters within {100 * cfg.max_interval:.0f} % (--max-interval)"
        if remark := document.get("remark"):
            return OpenQuestion({}, sentence=f"The model has {names}, and {known}. {remark}")
        return OpenQuestion({}, sentence=f"The data identify {names}, and {known}: there is nothing to suggest.")
    width, k, i = widest
    found = _with(base, accepted)
    effect = len(base.effects) + k
    row = accepted[k]["parameters"][i]
    name, (low, high) = row["name"], row["interval"]
    sentence = f"Open: {name} of {accepted[k]['name']} is known to {100 * width:.0f} % only."
    return OpenQuestion({accepted[k]["name"]: found}, (effect, i, float(low), float(high)), sentence, width)


def fitted_hypotheses(
    question: OpenQuestion,
    recording: Recording,
    cfg: SuggestCfg,
    engine: EngineName,
    fit: Callable[[Model], Model] | None = None,
) -> list[Hypothesis]:
    """Return the hypotheses of an open question, each fitted to the data at hand.

    Args:
        question: What is open.
        recording: The data at hand.
        cfg: Settings.
        engine: Which engine simulates.
        fit: Returns a model with its effects fitted; `fit_effects` with the settings by default.
    """
    fit = fit or (lambda model: fit_effects(model, recording, cfg.fit, engine=engine).model)
    fitted = {name: fit(model) for name, model in question.models.items()}
    if question.parameter is None:
        return [Hypothesis(name, one, _spread(one)) for name, one in fitted.items()]
    (one,) = fitted.values()
    effect, k, low, high = question.parameter
    added = one.effects[effect]
    parameter = added.effect.parameters(_before(one, effect).compile())[k]
    column = sum(len(a.values) for a in one.effects[:effect]) + k
    spread = _spread(one)
    spread[column] = 0.0
    found = []
    for value in (low, high):
        values = (*added.values[:k], float(value), *added.values[k + 1 :])
        effects = (*one.effects[:effect], replace(added, values=values), *one.effects[effect + 1 :])
        label = with_unit(f"{parameter.name} = {value:.3g}", parameter.unit)
        found.append(Hypothesis(label, replace(one, effects=effects), spread))
    return found


def read_diagnosis(path: Path, model: Model) -> dict[str, Any]:
    """Return a saved diagnosis as its JSON object.

    Args:
        path: Folder that ``concent diagnose --out`` wrote, what its ``--json`` printed (``.json``), or the model that
            its ``--apply`` wrote (``.toml``), which has the accepted effects with their intervals, and no groups.
        model: The model that was diagnosed.

    Raises:
        ModelError: The file is missing, damaged, or of another kind.
    """
    path = path / DIAGNOSIS_FILE if path.is_dir() else path
    if path.suffix == ".toml":
        return _of_model(Model.load(path), model, path)
    document = read_json(path, ModelError)
    _checked(document, path)
    return document


def _of_model(better: Model, model: Model, path: Path) -> dict[str, Any]:
    """Return the JSON object of a diagnosis that led from a model to a better one."""
    compiled, findings = model.compile(), []
    known = [(a.effect.name, a.effect.target) for a in model.effects]
    for added in better.effects:
        if (added.effect.name, added.effect.target) in known or added.effect.nominal:
            continue
        parameters = added.effect.parameters(compiled)
        intervals = added.intervals or [(v, v) for v in added.values]
        rows = [
            {"name": p.name, "value": v, "interval": list(pair), "unit": p.unit, "null": p.null}
            for p, v, pair in zip(parameters, added.values, intervals, strict=True)
        ]
        findings.append(
            {"name": added.effect.name, "target": list(added.effect.target), "parameters": rows, "accepted": True,
             "step": len(findings)}
        )  # fmt: skip
    if not findings:
        raise ModelError(
            "the model has no effect that the diagnosed one lacks",
            where=path,
            fix="give what --apply of diagnose wrote",
        )
    return {
        "verdict": "effect",
        "effects": findings,
        "groups": [[f["name"]] for f in findings],
        "remark": f"{path} does not say what the data may confuse with that: give the folder of diagnose --out.",
    }


def _checked(document: Any, where: Path | None = None) -> tuple[str, list[dict[str, Any]], list[list[str]]]:
    """Return verdict, findings and groups of a diagnosis's JSON object.

    Raises:
        ModelError: It is none.
    """
    if not isinstance(document, Mapping) or not {"verdict", "effects", "groups"} <= set(document):
        found = sorted(document)[:5] if isinstance(document, Mapping) else type(document).__name__
        raise ModelError(
            "not a diagnosis",
            where=where or "diagnosis",
            expected='"verdict", "effects" and "groups", as concent diagnose --json prints them',
            found=found,
        )
    verdict, findings, groups = document["verdict"], document["effects"], document["groups"]
    whole = isinstance(findings, list) and all(map(_is_finding, findings))
    grouped = isinstance(groups, list) and all(
        isinstance(g, list) and all(isinstance(name, str) for name in g) for g in groups
    )
    if not (isinstance(verdict, str) and whole and grouped):
        raise ModelError(
            "the diagnosis is damaged", where=where or "diagnosis", fix="run concent diagnose --json again"
        )
    return verdict, findings, groups


def _is_finding(row: Any) -> bool:
    """Return whether something is an effect with its parameters as a diagnosis has it in JSON."""
    if not isinstance(row, Mapping) or not isinstance(row.get("name"), str):
        return False
    target, parameters = row.get("target"), row.get("parameters")
    if not (isinstance(target, list | tuple) and all(isinstance(t, str) for t in target)):
        return False
    return isinstance(parameters, list) and all(
        isinstance(p, Mapping)
        and isinstance(p.get("name"), str)
        and (p.get("value") is None or is_number(p["value"]))
        and isinstance(p.get("interval"), list | tuple)
        and len(p["interval"]) == 2
        and all(v is None or is_number(v) for v in p["interval"])
        for p in parameters
    )


def _finding(name: str, findings: Sequence[Mapping[str, Any]], first: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the finding of an effect of a group, of the addition that the group belongs to where there are several."""
    found = [f for f in findings if f["name"] == name]
    if not found:
        raise ModelError(f"the diagnosis has {name!r} in a group, and no values of it", where="diagnosis")
    return max(found, key=lambda f: (f is first, f.get("step") == first.get("step"), bool(f.get("accepted"))))


def _with(model: Model, findings: Sequence[Mapping[str, Any]]) -> Model:
    """Return a model with the effects of some findings at their values.

    Raises:
        ModelError: The model has no such target, or has an effect already.
    """
    for found in findings:
        kind = effect_class(str(found["name"]).split("(")[0])
        values = {p["name"]: float(p["value"]) for p in found["parameters"] if p["value"] is not None}
        model = model.add(kind(*found["target"]), values)
    return model


def _with_nominal(model: Model, rows: Sequence[Mapping[str, Any]]) -> Model:
    """Return a model with the nominal values that a diagnosis has fitted, before its other effects."""
    values = {str(r["name"]): float(r["value"]) for r in rows if "name" in r and is_number(r.get("value"))}
    compiled, added = model.compile(), []
    for effect in possible_nominal_effects(model) if values else ():
        for target in effect.target:
            (one,) = [type(effect)(target)]
            names = [p.name for p in one.parameters(compiled)]
            if set(names) <= set(values):
                added.append(AddedEffect(one, tuple(values[name] for name in names)))
    return replace(model, effects=(*added, *model.effects))


def _before(model: Model, effect: int) -> Model:
    """Return a model with the effects before one of them only."""
    return replace(model, effects=model.effects[:effect])


def _spread(model: Model) -> np.ndarray:
    """Return the standard deviations of all parameters of a fitted model, shape (P,)."""
    found = []
    for k, added in enumerate(model.effects):
        parameters = added.effect.parameters(_before(model, k).compile())
        for p, pair in zip(parameters, _intervals(added), strict=True):
            reach = (pair[1] - pair[0]) / (2 * NORMAL_QUANTILE)
            found.append(float(reach) if np.isfinite(reach) and reach > 0 else 0.1 * p.scale)
    return np.array(found)


def _intervals(added: AddedEffect) -> Sequence[tuple[float, float]]:
    """Return the intervals of an effect's parameters, without width where it has none."""
    return added.intervals or [(v, v) for v in added.values]


def _width(p: Mapping[str, Any]) -> float:
    """Return half the interval of a parameter over its distance from the null value [-]."""
    low, high = p["interval"]
    if low is None or high is None or p["value"] is None:
        return 0.0
    null = p.get("null")
    size = abs(p["value"] - null) if null is not None and np.isfinite(null) else abs(p["value"])
    return float((high - low) / 2 / max(size, 1e-12))


def _listed(names: Sequence[str]) -> str:
    """Return names as a list in words."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"
