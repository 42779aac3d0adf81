"""What the page is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from colmap_inertial.checks.report.figures import Figure


@dataclass(frozen=True, kw_only=True)
class Plot:
    """A figure, and what it shows in words for those who cannot see it."""

    figure: Figure
    label: str


@dataclass(frozen=True, kw_only=True)
class Section:
    """One card of the page; ``short`` is its name in the list of links."""

    anchor: str
    short: str
    parts: Sequence[str | Plot]
    classes: str = ""
