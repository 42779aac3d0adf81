"""One table of a TOML file, read key by key; every complaint names file, line, table and key."""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import read_text

T = TypeVar("T", bound=str)


def read_toml(path: Path) -> Section:
    """The root table of a TOML file.

    Raises
    ------
    FormatError
        Where the file is missing or not TOML.
    """
    text = read_text(path)
    return Section(path, "", parse_toml(path, text), text)


#: Of a TOML file: a manifest of 35,000 captures, which is parsed in a second and 220 MB at worst.
_MOST_CHARACTERS = 1 << 21
#: Parts of a key, for which time and memory grow with the square; ours have three.
_MOST_PARTS = 32
#: A text, to the end of its line or of the file where it is not closed, or a comment.
_TEXT = re.compile(
    r'''"""(?:\\.|[^\\])*?(?:"{3,5}|\Z)|\'{3}.*?(?:\'{3,5}|\Z)|"(?:\\.|[^"\\\n])*+"?|'[^'\n]*+'?|#[^\n]*+''', re.DOTALL
)
#: A key or number, with the blanks around.
_DOTTED = re.compile(r"[\w\-. \t]+")


def parse_toml(path: Path, text: str) -> dict[str, Any]:
    """The values in the text of a TOML file.

    Raises
    ------
    FormatError
        Where it is not TOML, or much longer or deeper than any of ours.
    """
    if len(text) > _MOST_CHARACTERS:
        raise FormatError(path, Fact("toml-too-long", count=len(text), most=_MOST_CHARACTERS))
    keys = _DOTTED.findall(_TEXT.sub(_replace_by_word, text))
    if any(key.count(".") >= _MOST_PARTS for key in keys):
        raise FormatError(path, Fact("toml-key-too-deep", most=_MOST_PARTS))
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        line = re.search(r"at line (\d+)", str(error))
        raise FormatError(path, Fact("invalid-toml", detail=str(error)), line=int(line[1]) if line else None) from None


def _replace_by_word(match: re.Match[str]) -> str:
    """A text may be a part of a key."""
    return "" if match[0].startswith("#") else "x"


class Section:
    """A table of a TOML file whose keys are taken one by one; :meth:`finish` complains about those left."""

    def __init__(self, path: Path, name: str, values: dict[str, Any], text: str) -> None:
        self.path = path
        self.name = name
        self._values = values
        self._text = text
        self._known: list[str] = []

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def names(self) -> list[str]:
        """Keys in the order of the file."""
        return list(self._values)

    def fail(self, key: str | None, fault: Fact) -> NoReturn:
        """Raise the :class:`FormatError` of this table (and of one of its keys)."""
        where = f"[{self.name}]" if self.name else "top level"
        entry = where if key is None else f"{where} {key}"
        raise FormatError(self.path, Fact("wrong-entry", entry=entry, fault=fault), line=self._line(key))

    def section(self, key: str, *, short: str | None = None) -> Section | None:
        """The table under ``key``, or ``None`` where it is absent; a text in its place is its key ``short``."""
        value = self._take(key)
        if value is None:
            return None
        name = f"{self.name}.{key}" if self.name else key
        if short is not None and isinstance(value, str):
            value = {short: value}
        if not isinstance(value, dict):
            self.fail(key, Fact("not-a-table", name=name))
        return Section(self.path, name, value, self._text)

    def table(self, key: str) -> Section:
        """The table under ``key``; an empty one where it is absent."""
        section = self.section(key)
        return Section(self.path, key, {}, self._text) if section is None else section

    def text(self, key: str) -> str | None:
        """A text, not empty."""
        value = self._take(key)
        if value is not None and (not isinstance(value, str) or not value.strip()):
            self.fail(key, Fact("not-a-text", found=repr(value)))
        return value

    def choice(self, key: str, allowed: Iterable[T]) -> T | None:
        """One of the allowed texts."""
        value = self._take(key)
        names = list(allowed)
        if value is not None and value not in names:
            self.fail(key, Fact("not-one-of", allowed=tuple(names), found=repr(value)))
        return value

    def file(self, key: str) -> Path | None:
        """A path; a relative one counts from the TOML file's folder."""
        value = self.text(key)
        if value is not None and "\0" in value:
            self.fail(key, Fact("nul-character"))
        return None if value is None else self.path.parent / value

    def files(self, key: str) -> tuple[Path, ...]:
        """A path, or a list of them, as of :meth:`file`; none where the key is absent."""
        value = self._take(key)
        if not isinstance(value, list):
            path = self.file(key)
            return () if path is None else (path,)
        if not value or any(not isinstance(item, str) or not item.strip() or "\0" in item for item in value):
            self.fail(key, Fact("not-paths", found=repr(value)[:249]))
        return tuple(self.path.parent / item for item in value)

    def boolean(self, key: str) -> bool | None:
        """``true`` or ``false``."""
        value = self._take(key)
        if value is not None and not isinstance(value, bool):
            self.fail(key, Fact("not-a-boolean", found=repr(value)))
        return value

    def number(self, key: str, *, low: float = -math.inf, high: float = math.inf) -> float | None:
        """A finite number from ``low`` to ``high``."""
        value = self._take(key)
        if value is None:
            return None
        number = self._number(key, value)
        if not low <= number <= high:
            self.fail(key, Fact("not-in-range", low=low, high=high, found=repr(value)))
        return number

    def positive(self, key: str) -> float | None:
        """A finite number above zero."""
        value = self.number(key)
        if value is not None and value <= 0:
            self.fail(key, Fact("not-above-zero", found=repr(value)))
        return value

    def integer(self, key: str) -> int | None:
        """A positive whole number."""
        value = self._take(key)
        if value is not None and (not isinstance(value, int) or isinstance(value, bool) or not 0 < value < 10**9):
            self.fail(key, Fact("not-a-positive-integer", found=repr(value)))
        return value

    def numbers(self, key: str, count: int | None = None) -> tuple[float, ...] | None:
        """A list of finite numbers."""
        value = self._take(key)
        if value is None:
            return None
        if not isinstance(value, list) or (count is not None and len(value) != count):
            self.fail(key, Fact("not-numbers", count=count, found=repr(value)))
        return tuple(self._number(key, item) for item in value)

    def matrix(self, key: str) -> list[list[float]] | None:
        """A list of lists of finite numbers, all of one length."""
        value = self._take(key)
        if value is None:
            return None
        if not isinstance(value, list) or not all(isinstance(r, list) and len(r) == len(value[0]) for r in value):
            self.fail(key, Fact("not-a-matrix"))
        return [[self._number(key, item) for item in row] for row in value]

    def raw(self, key: str) -> Any:
        """The value as it stands, or ``None`` where it is absent."""
        return self._take(key)

    def require(self, key: str, value: Any) -> Any:
        """``value``, or a complaint that the key is missing."""
        if value is None:
            self.fail(None, Fact("key-missing", key=key))
        return value

    def require_known(self, known: Sequence[str]) -> None:
        """Complain about keys that are not among the known ones; the most similar one is named."""
        for key in self._values:
            if key not in known:
                near = difflib.get_close_matches(key, known, n=1, cutoff=0.0)
                self.fail(key, Fact("unknown-key", near=near, known=known))

    def finish(self) -> None:
        """Complain about keys that nobody asked for."""
        self.require_known(self._known)

    def _take(self, key: str) -> Any:
        if key not in self._known:
            self._known.append(key)
        return self._values.get(key)

    def _number(self, key: str, value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.fail(key, Fact("not-a-number", found=repr(value)))
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            self.fail(key, Fact("not-finite", found=repr(value)[:178]))
        return number

    def _line(self, key: str | None) -> int | None:
        """The line of a key (or of the table's head), found in the text; ``None`` for unusual spellings."""
        lines = self._text.splitlines()
        return _find_line(lines, self.name, key) or (_find_line(lines, "", self.name) if self.name else None)


def _find_line(lines: Sequence[str], table: str, key: str | None) -> int | None:
    inside = not table
    for number, line in enumerate(lines, start=1):
        head = re.match(r"\s*\[\s*([^\]]+?)\s*\]\s*(#.*)?$", line)
        if head:
            name = head[1].replace(" ", "").replace('"', "")
            inside = name == table
            if (inside and key is None) or (key is not None and name == f"{table}.{key}".lstrip(".")):
                return number
        elif inside and key is not None and re.match(rf"\s*[\"']?{re.escape(key)}[\"']?\s*[=.]", line):
            return number
    return None
