"""One HTML file that shows a comparison, the contact events and the fit behind them; it needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from concent_warp.checks import check_settings
from concent_warp.comparison.result import Comparison
from concent_warp.diagnosis.forces.result import UnexplainedForces
from concent_warp.diagnosis.result import Diagnosis
from concent_warp.events.sequence import ContactEventSequence
from concent_warp.files import write_text
from concent_warp.report.cfg import ReportCfg
from concent_warp.report.diagnosis_section import bullet_list, diagnosis_section
from concent_warp.report.headline import cards, headline_channel, verdict
from concent_warp.report.page_data import kind_of, ordered_channels, page_data
from concent_warp.report.tables import demonstration_table, error_table, provenance
from concent_warp.report.template import filled, options, page_file, script_json
from concent_warp.report.worst_spans import noise_words, shown_demonstrations, worst_span_list
from concent_warp.version import __version__

if TYPE_CHECKING:
    from concent_warp.fit.geometry.search import FitResult
    from concent_warp.model import Model
    from concent_warp.recording.recording import Recording


def write_report(
    path: str | Path,
    recording: Recording,
    comparison: Comparison,
    cfg: ReportCfg | None = None,
    *,
    events: Mapping[str, ContactEventSequence] | None = None,
    fit: FitResult | None = None,
    fitted: Sequence[str] = (),
    overlap: Mapping[str, Mapping[str, float]] | None = None,
    settings: Mapping[str, Any] | None = None,
    diagnosis: Diagnosis | Mapping[str, Any] | None = None,
    location: UnexplainedForces | Mapping[str, Any] | None = None,
    first_section: str = "",
) -> None:
    """Write the report, in one piece or not at all.

    Args:
        path: The ``.html`` file.
        recording: What was commanded and measured.
        comparison: Of one or more models with this recording.
        cfg: Settings.
        events: Contact event sequences of the last model, by demonstration; by default those of the comparison.
        fit: The fit that led from the first model to the last.
        fitted: Demonstrations that the fit has seen; empty where there was none.
        overlap: Overlap of contact frames with the truth, by model and demonstration, where the truth is known.
        settings: ``command``, ``versions`` and ``settings`` to show.
        diagnosis: A diagnosis, or its JSON object.
        location: Unexplained forces, or their JSON object.
        first_section: HTML of a section to show before all others.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> comparison = cw.compare(cw.Model.from_recording(recording), recording)
        >>> cw.write_report("report.html", recording, comparison)
    """
    cfg = cfg or ReportCfg()
    check_settings(cfg)
    path, events, overlap = Path(path), events or comparison.events, overlap or {}
    diagnosis = diagnosis.to_json() if isinstance(diagnosis, Diagnosis) else diagnosis
    location = location.to_json() if isinstance(location, UnexplainedForces) else location
    shown_models = {name: comparison.models[name] for name in dict.fromkeys((comparison.before, comparison.after))}
    chosen = [recording[name] for name in shown_demonstrations(comparison, cfg.max_demonstrations)]
    data = page_data(shown_models, chosen, comparison, events, fit)
    data["forces"] = _forces(data, location)
    parts = {
        "title": escape(_title(recording, fit, diagnosis is not None)),
        "subtitle": escape(_subtitle(recording, comparison, fitted)),
        "verdict": escape(verdict(comparison, fitted, overlap, cfg)),
        "cards": "\n".join(card.html() for card in cards(comparison, events, fitted, overlap, cfg)),
        "demonstration_options": options([d.name for d in chosen]),
        "channel_options": options(ordered_channels(comparison)),
        "model_keys": "".join(
            f'<span class="key {kind_of(comparison, name)}"></span>{escape(name)}&emsp;' for name in comparison.models
        )
        + '<span class="key noise"></span>noise floor',
        "diagnosis": first_section + diagnosis_section(diagnosis),
        "where": _worst_spans_section(comparison, [d.name for d in chosen]),
        "place_switch": PLACE_SWITCH if data["places"] else "",
        "errors_about": (
            "How far the simulation is from the measurement at each instant of the replay. The bands are "
            f"{_bands(comparison)}, found in the replay of the last model; numbers mark the worst spans. "
            "Click to move the replay to that instant."
        ),
        "schedule": page_file("schedule.html") if events else "",
        "replay_about": (
            "The recorded commands, simulated open loop from the initial state that is recorded, or else from the one "
            "that follows the first readings best. "
            "Green: the measured pose of the objects, or the tracked points where no pose was measured."
        ),
        "follow_options": options(_follow_order(data, comparison)) + '<option value="">the scene</option>',
        "replay_views": _views("replay", comparison, shown_models),
        "sphere_switch": SPHERE_SWITCH if data["geometry"] else "",
        "forces": _forces_section(data["forces"], location),
        "geometry": _geometry_section(data, comparison, shown_models),
        "fit": _fit_section(fit),
        "tables_about": escape(
            f"Mean error over time with its 95 % interval ({comparison.bootstrap.rule}); RMS, 95th percentile, largest "
            f"error, noise floor (RMS) and RMS error over it (x noise) of “{comparison.after}”. Green and red changes "
            "are those whose interval excludes 0."
        ),
        "tables": _tables(comparison, fitted, overlap),
        "provenance": provenance(settings or {}),
        "footer": escape(f"Written by concent {__version__}. {_left_out(comparison, cfg.max_demonstrations)}"),
        "data": script_json(data),
        "style": page_file("style.css"),
        "script": "\n".join(page_file(name) for name in ("scene3d.js", "charts.js", "timeline.js", "page.js")),
    }
    write_text(path, filled(page_file("page.html"), parts))


def _follow_order(data: Mapping[str, Any], comparison: Comparison) -> list[str]:
    """Return the objects that the camera can follow, first the one that the headline channel measures."""
    main = headline_channel(comparison)
    about = {r.body for d in comparison.demonstrations if (r := comparison.residual(comparison.before, d, main))}
    return sorted(data["view"]["bodies"], key=lambda name: name not in about)


def _worst_spans_section(comparison: Comparison, shown: Sequence[str]) -> str:
    """Return the section that says where the last model fails."""
    strips = ""
    if len(comparison.models) > 1:
        strips = f" The upper strip is “{comparison.before}”, the lower one “{comparison.after}”."
    about = (
        f"Every channel over time, coloured by its error over the measurement noise.{strips} Bands are "
        f"{_bands(comparison)}. Click a strip or a place to see it in the replay. {noise_words(comparison)}"
    )
    said = " ".join(comparison.tolerance_sentences())
    places = worst_span_list(comparison, shown) + (f"<p>{escape(said)}</p>" if said else "")
    return filled(page_file("worst_spans.html"), {"about": escape(about), "places": places})


def _bands(comparison: Comparison) -> str:
    """Return what the phases of a comparison are."""
    return "the contact stages" if comparison.staged else "the phases of motion"


def _forces(data: Mapping[str, Any], location: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """Return the unexplained forces that can be drawn: those on bodies of the scene."""
    known = {body["name"] for body in data["bodies"]}
    return [dict(arrow) for arrow in (location or {}).get("arrows", ()) if arrow["body"] in known]


def _forces_section(arrows: Sequence[Mapping[str, Any]], location: Mapping[str, Any] | None) -> str:
    """Return the section of unexplained forces, empty where they were not looked for."""
    if not location:
        return ""
    bodies = list(dict.fromkeys(arrow["body"] for arrow in arrows))
    view = filled(page_file("forces_view.html"), {"bodies": options(bodies)}) if bodies else ""
    return filled(page_file("forces.html"), {"views": view, "sentences": bullet_list(location.get("sentences", ()))})


def _geometry_section(data: Mapping[str, Any], comparison: Comparison, models: Mapping[str, Model]) -> str:
    """Return the section of the contact geometry, empty where there is none to show."""
    if not data["geometry"]:
        return ""
    bodies = options(data["geometry"]["bodies"])
    return filled(page_file("geometry.html"), {"bodies": bodies, "views": _views("geometry", comparison, models)})


def _fit_section(fit: FitResult | None) -> str:
    """Return the section of the fit, empty where there was none."""
    if fit is None or not fit.history:
        return ""
    last = fit.history[-1]
    text = (
        f"{len(fit.history)} generations, {last['simulations']:,} simulations in {last['seconds']:.0f} s; "
        f"ended because: {fit.stopped}. {int(fit.mask.sum())} of {len(fit.mask)} spheres have moved."
    )
    return filled(page_file("fit.html"), {"text": escape(text)})


def _tables(comparison: Comparison, fitted: Sequence[str], overlap: Mapping[str, Mapping[str, float]]) -> str:
    """Return all tables: headline channel and objects by phase, demonstrations, and other channels folded away."""
    first = {headline_channel(comparison), *comparison.object_channels}
    shown = [c for c in comparison.channels if c in first]
    others = [c for c in comparison.channels if c not in first]
    parts = [error_table(comparison, shown, phases=True)]
    if len(comparison.demonstrations) > 1:
        parts.append("<h3 style='margin-top:18px'>By demonstration</h3>")
        parts.append(demonstration_table(comparison, fitted, overlap))
    if others:
        parts.append(
            f"<details><summary>{len(others)} further channels</summary>"
            f"{error_table(comparison, others, phases=True)}</details>"
        )
    return "\n".join(parts)


def _views(name: str, comparison: Comparison, models: Mapping[str, Model]) -> str:
    """Return a canvas for each model shown."""
    return "".join(
        f'<figure><figcaption><span class="{kind_of(comparison, model)}">{escape(model)}</span></figcaption>'
        f'<canvas id="{name}-{i}" aria-label="{name} of {escape(model)}"></canvas></figure>'
        for i, model in enumerate(models)
    )


def _title(recording: Recording, fit: FitResult | None, diagnosed: bool) -> str:
    """Return the title of the page."""
    task = next((d.task for d in recording.demonstrations if d.task), "")
    about = "Diagnosis" if diagnosed else "Model against measurement"
    return ("Grounded simulation" if fit is not None else about) + (f": {task}" if task else "")


def _subtitle(recording: Recording, comparison: Comparison, fitted: Sequence[str]) -> str:
    """Return what the report is about."""
    number = len(comparison.demonstrations)
    length = sum(recording[name].duration for name in comparison.demonstrations)
    text = f"{number} demonstration{'s' if number != 1 else ''}, {length:.1f} s in all, from {recording.source}"
    return text + (f"; the fit has seen {', '.join(fitted)}" if fitted else "")


def _left_out(comparison: Comparison, most: int) -> str:
    """Return which demonstrations have no charts."""
    more = len(comparison.demonstrations) - most
    return f"Charts and replay show {most} demonstrations; {more} more are in the tables." if more > 0 else ""


PLACE_SWITCH = '<label><input type="checkbox" id="mark" checked> worst spans</label>'
SPHERE_SWITCH = '<label><input type="checkbox" id="spheres"> objects as spheres</label>'
