"""Recordings in JSON, as tables: an array of objects, an object on each line, or lists under names.

Objects are read one by one, so that a recording takes no more than its text and its numbers.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator
from typing import Any

_BETWEEN = re.compile(r"[\s,\[\]]*")
#: Keys of one object, and objects whose keys make the header.
_MOST_KEYS, _FIRST = 400, 500
#: Keys under which messages carry rows, and rows carry values.
_LISTS, _INNER = ("payload", "data", "samples", "readings"), ("values", "value", "data")


def rows_of_json(text: str) -> str | None:
    """The same as a table with a header and commas; ``None`` for what is no JSON of rows."""
    start = text.lstrip()[:1]
    if start not in ("[", "{"):
        return None
    try:
        if start == "{" and (split := _split(next(objects_of_json(text), {}))) is not None:
            return split
        first = list(itertools.islice(_flat_rows(text), _FIRST))
        if len(first) == 1 and (columns := _columns(first[0])) is not None:
            return columns
        names = tuple(dict.fromkeys(itertools.chain(*first)))
        if len(first) < 2 or not 2 <= len(names) <= _MOST_KEYS:
            return None
        lines = [",".join(map(_cell, names))]
        lines += (",".join(_cell(row.get(name, "")) for name in names) for row in _flat_rows(text))
    except (ValueError, RecursionError):
        return None
    return "\n".join(lines) + "\n"


def is_json(text: str) -> bool:
    """Whether a text begins with a JSON object or array."""
    start = text.lstrip()
    if start[:1] not in ("[", "{"):
        return False
    try:
        json.JSONDecoder().raw_decode(start)
    except (ValueError, RecursionError):
        return False
    return True


def objects_of_json(text: str) -> Iterator[dict[str, Any]]:
    """The objects of an array, or of lines.

    Raises
    ------
    ValueError
        For what is no JSON.
    """
    decoder = json.JSONDecoder(parse_float=str, parse_int=str)
    at = _BETWEEN.match(text).end()  # type: ignore[union-attr]
    while at < len(text):
        if text[at] != "{":
            raise ValueError("no object")
        value, at = decoder.raw_decode(text, at)
        yield value
        at = _BETWEEN.match(text, at).end()  # type: ignore[union-attr]


def _flat_rows(text: str) -> Iterator[dict[str, Any]]:
    for value in objects_of_json(text):
        key = next(
            (k for k in _LISTS if isinstance(value.get(k), list) and value[k] and isinstance(value[k][0], dict)), None
        )
        for row in value[key] if key else (value,):
            if isinstance(row, dict):
                yield _flat(row)


def _flat(row: dict[str, Any], before: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in row.items():
        name = f"{before}{key}"
        if isinstance(value, dict):
            out |= _flat(value, before if key in _INNER else f"{name}.")
        elif isinstance(value, list) and 2 <= len(value) <= 4 and not isinstance(value[0], list | dict):
            out |= {f"{name}[{i}]": item for i, item in enumerate(value)}
        else:
            out[name] = value
    return out


def _split(value: dict[str, Any]) -> str | None:
    """Rows under a list of names."""
    names, rows = value.get("columns"), value.get("data")
    if not (isinstance(names, list) and isinstance(rows, list) and len(rows) > 1):
        return None
    if not all(isinstance(row, list) and len(row) == len(names) for row in rows):
        return None
    return "\n".join(",".join(map(_cell, row)) for row in (names, *rows)) + "\n"


def _columns(row: dict[str, Any]) -> str | None:
    """Lists of one length under names."""
    lists = {name: value for name, value in row.items() if isinstance(value, list) and len(value) > 4}
    if len(lists) < 2 or len({len(value) for value in lists.values()}) != 1:
        return None
    rows = zip(*lists.values(), strict=True)
    return "\n".join([",".join(map(_cell, lists)), *(",".join(map(_cell, cells)) for cells in rows)]) + "\n"


def _cell(value: Any) -> str:
    if value is None or isinstance(value, list | dict):
        return ""
    return re.sub(r"[,\s\"]+", " ", str(value)).strip()
