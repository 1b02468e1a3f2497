"""What the commands say of a fit, of contact events and of a comparison."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.markup import escape

from concent_warp.cli.terminal import quiet_warp, say, say_written, status_bar
from concent_warp.comparison.result import Comparison
from concent_warp.comparison.table import mean_and_interval
from concent_warp.comparison.units import percent_text, unit_text
from concent_warp.events.sequence import ContactEventSequence

if TYPE_CHECKING:
    from concent_warp.fit.geometry.search import Progress
    from concent_warp.ground import Grounded


@contextmanager
def fit_progress() -> Iterator[Callable[[Progress], None]]:
    """Show the progress of a fit."""
    quiet_warp()
    with status_bar("fitting") as update:

        def show(progress: Progress) -> None:
            text = f"{progress.what} {progress.generation}/{progress.generations}, best {1e3 * progress.best:.2f} mm"
            update(progress.generation / max(progress.generations, 1), text, progress.seconds_left)

        yield show


def say_grounded(found: Grounded, folder: Path) -> None:
    """Write the summary of the main job: errors, overlap, stages, and where the results are."""
    from rich.table import Table
    from rich.text import Text

    comparison = found.comparison
    channel, phases = comparison.main_channel(), comparison.contact_phases()
    unseen = tuple(d for d in comparison.demonstrations if d not in found.fitted)
    unit = unit_text(comparison.summarise(comparison.after, channel, phases).unit)
    title = Text(f"mean error of {channel} [{unit}], {' + '.join(phases) or 'all times'}")
    table = Table(title=title, title_justify="left")
    for name in ("demonstrations", *comparison.models, "change"):
        table.add_column(name, justify="left" if name == "demonstrations" else "right")
    if found.overlap:
        table.add_column("contact overlap", justify="right")
    for label, chosen in (("fitted", found.fitted), ("not seen by the fit", unseen)):
        if not chosen:
            continue
        cells = [mean_and_interval(comparison.summarise(m, channel, phases, chosen)) for m in comparison.models]
        difference = comparison.difference(channel, phases, chosen)
        cells.append(percent_text(difference.share) if np.isfinite(difference.share) else "-")
        if found.overlap:
            means = [np.mean([values[d] for d in chosen if d in values]) for values in found.overlap.values()]
            cells.append(" → ".join(f"{mean:.2f}" for mean in means))
        table.add_row(f"{', '.join(chosen)} ({label})", *cells)
    say(table)
    say(f"fit: {found.fit.stopped}; {int(found.fit.mask.sum())} of {len(found.fit.mask)} spheres moved")
    if found.fit.gradients is not None:
        say(escape(found.fit.gradients.remark))
    say_events(found.events)
    say_written(folder / "model.toml", folder / "report.html")


def say_events(events: Mapping[str, ContactEventSequence]) -> None:
    """Write the stages of contact event sequences."""
    for name, sequence in events.items():
        stages = ", ".join(f"{s.name} {s.start:.2f}-{s.end:.2f} s" for s in sequence.stages)
        say(escape(f"{name}: {stages or 'no contact stages'}; {len(sequence.contacts)} contacts"))


def say_diverged(comparison: Comparison) -> None:
    """Write which replays have not stayed finite."""
    for (model, demonstration), time in comparison.diverged.items():
        say(escape(f"{model} diverged in {demonstration} at {time:.2f} s"))
