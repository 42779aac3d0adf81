"""Values that print on a screen: a line for each field, arrays by their shape, lists by their length."""

from __future__ import annotations

import html
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeVar

from colmap_inertial.core.facts import Fact

Class = TypeVar("Class", bound=type)


@dataclass(frozen=True, kw_only=True)
class PrintLimits:
    """Limits on the printed size of a value."""

    lines: int = 20
    width: int = 100
    #: Lists of more items are printed by their length.
    items: int = 6


_LIMITS = PrintLimits()


def prints_in_lines(cls: Class) -> Class:
    """Class decorator: ``repr`` in at most 20 lines, and a table for notebooks (``_repr_html_``)."""
    for name, shown in (("__repr__", _format_text), ("_repr_html_", _format_table)):
        setattr(cls, name, shown)
    return cls


def _rows(value: Any) -> list[tuple[str, str]]:
    rows = [(f.name, shorten(getattr(value, f.name))) for f in fields(value) if f.repr]
    rows = [(name, text) for name, text in rows if text not in ("None", "()", "")] or rows
    if len(rows) > _LIMITS.lines - 1:
        more = ", ".join(name for name, _ in rows[_LIMITS.lines - 2 :])
        rows = [*rows[: _LIMITS.lines - 2], ("and", _cut(more))]
    return rows


def _format_text(self: Any) -> str:
    rows = _rows(self)
    width = max(len(name) for name, _ in rows)
    return "\n".join([type(self).__name__, *(f"  {name:<{width}}  {text}" for name, text in rows)])


def _format_table(self: Any) -> str:
    lines = "".join(
        f"<tr><th style='text-align:left'>{name}</th><td style='text-align:left'>{html.escape(text)}</td></tr>"
        for name, text in _rows(self)
    )
    return f"<table><caption>{type(self).__name__}</caption>{lines}</table>"


def shorten(value: Any) -> str:
    """A value in one line."""
    if isinstance(value, float):  # numpy's, too
        return f"{value:.6g}"
    if getattr(value, "shape", ()):
        if value.size <= _LIMITS.items and value.ndim == 1:
            return "[" + ", ".join(f"{number:.6g}" for number in value.tolist()) + "]"
        return f"array {' x '.join(map(str, value.shape))}"
    if isinstance(value, Mapping):
        return f"{len(value)} by name: {_cut(', '.join(map(str, value)), _LIMITS.width // 2)}" if value else "()"
    if isinstance(value, Fact):
        return _cut(str(value))
    if isinstance(value, tuple | list | frozenset):
        if all(isinstance(item, float | int | str | Fact) for item in value) and len(value) <= _LIMITS.items:
            return _cut("(" + ", ".join(shorten(item) for item in value) + ")")
        return f"{len(value)} of {type(next(iter(value))).__name__}"
    if hasattr(value, "__dataclass_fields__") and not isinstance(value, Fact):
        return type(value).__name__
    return _cut(str(value))


def _cut(text: str, width: int = _LIMITS.width) -> str:
    text = " ".join(text.split())
    return text if len(text) <= width else f"{text[: width - 3]}..."
