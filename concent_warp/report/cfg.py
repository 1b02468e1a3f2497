"""Settings of the report."""

from __future__ import annotations

from dataclasses import dataclass

from concent_warp.checks import Share


@dataclass(frozen=True)
class ReportCfg:
    """Settings of the report.

    Example:
        >>> import concent_warp as cw
        >>> cw.ReportCfg(max_demonstrations=2).max_demonstrations
        2
    """

    noise_ratio: float = 1.2
    """RMS error over the noise below which an error counts as noise [-]: above the error of an estimated noise."""
    min_overlap: Share = 0.8
    """Overlap (IoU) of contact frames with the truth from which the contact counts as reproduced [-]: contacts that
    begin and end a tenth of their duration off have 0.8."""
    overlap_change: Share = 0.02
    """Change of the overlap above which it counts as risen or fallen [-]: the headline shows two digits."""
    max_demonstrations: int = 6
    """Most demonstrations with charts and replay, those with the worst spans first [-]; the others are in the tables
    alone, which bounds the size of the page."""
