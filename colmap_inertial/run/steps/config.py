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
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat |= _flatten(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {prefix + key: value}
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
    return _build(path, cls, read_values(path), "")


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
    stated = _build(path, type(options), values, "")  # by themselves first: a wrong one is named as it was written
    plain = _merged(_plain(options), _resolve_paths(stated, values, path.parent))
    return _build(path, type(options), plain, "")


def _resolve_paths(stated: Any, values: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    absolute: dict[str, Any] = {}
    for key, value in values.items():
        built = getattr(stated, key)
        if dataclasses.is_dataclass(built):
            absolute[key] = _resolve_paths(built, value, folder)
        else:
            absolute[key] = _absolute(built, value, folder)
    return absolute


def _absolute(built: object, value: object, folder: Path) -> object:
    if isinstance(built, tuple):
        return [_absolute(item, item, folder) for item in built]
    return str((folder / built).resolve()) if isinstance(built, Path) else value


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(below)
    for key, value in above.items():
        deeper = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = _merged(merged[key], value) if deeper else value
    return merged


def _build(path: Path, cls: type[Options], values: Mapping[str, Any], prefix: str) -> Options:
    hints = typing.get_type_hints(cls)
    known = [f.name for f in dataclasses.fields(cls)]  # type: ignore[arg-type]
    built: dict[str, Any] = {}
    for key, value in values.items():
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            raise FormatError(
                path,
                Fact(
                    "unknown-option",
                    option=f"{prefix}{key}",
                    nearest=f"{prefix}{near[0]}" if near else None,
                    known=known,
                ),
            )
        hint_type = hints[key]
        if dataclasses.is_dataclass(hint_type):
            if not isinstance(value, Mapping):
                raise FormatError(path, Fact("option-is-a-table", option=f"{prefix}{key}"))
            built[key] = _build(path, typing.cast(type, hint_type), value, f"{prefix}{key}.")
        else:
            built[key] = value
    try:
        return cls(**{key: check_value(f"{prefix}{key}", value, hints[key]) for key, value in built.items()})
    except ValueError as error:
        raise FormatError(path, Fact("invalid-values", detail=str(error))) from error
