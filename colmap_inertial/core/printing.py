"""Text from files and names on its way to people: to a terminal, a log, a table or a page."""

from __future__ import annotations

import logging
import sys
import unicodedata
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.segment import Segment

#: What spreadsheets take for the beginning of a formula.
_FORMULA = ("=", "+", "-", "@", "\t", "\uff1d", "\uff0b", "\uff0d", "\uff20")  # the last four are full-width


def printable(text: str) -> str:
    """The same text with an escape such as ``\\x1b`` in place of each character that is no sign.

    Line ends and tabs stay. Control characters drive terminals, signs that turn the direction of writing hide what a
    name is, and halves of surrogate pairs (names that are no UTF-8) cannot be written.
    """
    if text.isprintable():
        return text
    return "".join(c if _is_sign(c) else c.encode("unicode_escape").decode() for c in text)


def _is_sign(character: str) -> bool:
    return character.isprintable() or character in "\n\t" or unicodedata.category(character) == "Zs"


def printable_values(value: Any) -> Any:
    """A value of JSON types with :func:`printable` texts and keys."""
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, dict):
        return {printable_values(key): printable_values(item) for key, item in value.items()}
    return [printable_values(item) for item in value] if isinstance(value, list | tuple) else value


def cell(text: str) -> str:
    """A text for a cell of a CSV file, which a spreadsheet shows, and does not work out as a formula."""
    return printable(f"'{text}" if text.startswith(_FORMULA) else text)


def say(text: object, *, error: bool = False) -> None:
    """Print lines on standard output, or on standard error."""
    print(printable(str(text)), file=sys.stderr if error else sys.stdout, flush=True)


def open_console(**how: Any) -> Console:
    """A ``rich.console.Console`` that shows :func:`printable` text alone; its own colours and movements stay."""
    from rich.console import Console
    from rich.segment import Segment

    class Printable(Console):
        def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
            for text, style, control in super().render(renderable, options):
                yield Segment(text if control else printable(text), style, control)

        def on_broken_pipe(self) -> None:
            raise BrokenPipeError  # rich would end with code 1

    return Printable(**how)


class PrintableFormatter(logging.Formatter):
    """Time, level and message of a log's line, :func:`printable`."""

    def __init__(self, times: str | None = None) -> None:
        super().__init__("%(asctime)s %(levelname)s %(message)s", times)

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        return printable(super().format(record))
