"""Options as TOML: read from ``--config``, and written back in full beside every result."""

from __future__ import annotations

import dataclasses
import difflib
import tomllib
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from colmap_inertial.core.choices import check_value
from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.io.files import StrPath, read_bytes, reader
from colmap_inertial.io.toml_section import parse_toml

Options = TypeVar("Options")


def config_as_toml(options: object) -> str:
    """Every option with its value; those that are ``None`` (TOML has none) are left out."""
    import tomli_w

    return tomli_w.dumps(_plain(options))


def _plain(options: Any) -> dict[str, Any]:
    plain: dict[str, Any] = {}
    for f in dataclasses.fields(options):
        value = getattr(options, f.name)
        if dataclasses.is_dataclass(value):
            plain[f.name] = _plain(value)
        elif isinstance(value, Path):
            plain[f.name] = str(value.resolve())
        elif value is not None:
            plain[f.name] = [_plain_item(item) for item in value] if isinstance(value, tuple) else value
    return plain


def _plain_item(item: object) -> object:
    return str(item.resolve()) if isinstance(item, Path) else item


def list_changed_options(earlier: Path, config: str) -> tuple[Fact, ...]:
    """Each option whose value differs in an earlier configuration; none where that file cannot be read."""
    try:
        before = _flatten(read_values(earlier))
    except FormatError:
        return ()
    now = _flatten(tomllib.loads(config))
    return tuple(
        Fact("option-changed", option=name, now=now.get(name), before=before.get(name))
        for name in sorted(before.keys() | now.keys())
        if before.get(name) != now.get(name)
    )


def _flatten(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values by their dotted names; empty lists are left out, as what is not given."""
    flat: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, Mapping):
            flat |= _flatten(value, f"{prefix}{key}.")
        elif value != []:
            flat[prefix + key] = value
    return flat


@reader("options")
def read_config(path: StrPath, cls: type[Options]) -> Options:
    """Options of type ``cls`` from a TOML file; what it does not name keeps its default.

    Raises
    ------
    FormatError
        For a file that is no TOML, an unknown key (the nearest known one is named), or a value of the wrong type.
    """
    path = Path(path)
    return _replace(cls(), read_values(path), path)


def read_values(path: Path) -> dict[str, Any]:
    """Content of a TOML file, unchecked; a :class:`FormatError` for another file."""
    try:
        return parse_toml(path, read_bytes(path).decode())
    except UnicodeDecodeError as error:
        raise FormatError(path, Fact("invalid-toml", detail=str(error))) from error


def override_options(options: Options, values: Mapping[str, Any], path: Path) -> Options:
    """``options``, where ``values`` (nested as in TOML) go before its own.

    Parameters
    ----------
    path
        The file that the values come from: named by errors, and its folder is where relative paths count from.

    Raises
    ------
    FormatError
        As :func:`read_config`.
    """
    return _replace(options, values, path, folder=path.parent)


def _replace(
    options: Any, values: Mapping[str, Any], path: Path, *, folder: Path | None = None, prefix: str = ""
) -> Any:
    """Replace some values, checked by their annotations; paths are resolved from ``folder`` where one is given."""
    known = [f.name for f in dataclasses.fields(options)]
    hints = typing.get_type_hints(type(options))
    tables: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            nearest = f"{prefix}{near[0]}" if near else None
            raise FormatError(path, Fact("unknown-option", option=name, nearest=nearest, known=known))
        if dataclasses.is_dataclass(getattr(options, key)):
            if not isinstance(value, Mapping):
                raise FormatError(path, Fact("option-is-a-table", option=name))
            tables[key] = _replace(getattr(options, key), value, path, folder=folder, prefix=f"{name}.")
    plain = {key: value for key, value in values.items() if key not in tables}
    try:
        checked = {key: check_value(f"{prefix}{key}", value, hints[key]) for key, value in plain.items()}
        resolved = {key: _resolve(value, folder) for key, value in checked.items()}
        return dataclasses.replace(options, **tables, **resolved)
    except ValueError as error:
        raise FormatError(path, Fact("invalid-values", detail=str(error))) from error


def _resolve(value: object, folder: Path | None) -> object:
    if folder is None:
        return value
    if isinstance(value, tuple):
        return tuple(_resolve(item, folder) for item in value)
    return (folder / value).resolve() if isinstance(value, Path) else value
