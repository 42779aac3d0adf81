"""Our own values as JSON records: written by a run, and read back by the one that continues it."""

from __future__ import annotations

import functools
import typing
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from colmap_inertial.core.errors import FormatError
from colmap_inertial.io.files import read_json, write_json

if TYPE_CHECKING:
    from cattrs import Converter

T = TypeVar("T")


def write_record(path: Path, value: object) -> None:
    """Write a frozen value for :func:`read_record`; raises as ``io.files.write_json``."""
    write_json(path, value, indent=None)


def read_record(path: Path, kind: type[T]) -> T:
    """The value that :func:`write_record` wrote.

    Raises
    ------
    FormatError
        Where the file was changed since.
    """
    values = read_json(path)
    try:
        return structured(kind, values)
    except Exception as error:  # whatever a changed file makes of a value's own checks
        raise FormatError(path, f"was damaged since it was written ({error}); remove it and start again") from None


def structured(kind: type[T], values: Any) -> T:
    """A value of type ``kind`` from JSON types, by the annotations of its fields."""
    return _converter().structure(values, kind)


@functools.cache
def _converter() -> Converter:
    import cattrs

    converter = cattrs.Converter()
    converter.register_structure_hook_func(_is_array, lambda value, kind: np.array(value, _dtype(kind)))
    converter.register_structure_hook(Path, lambda value, _: Path(value))
    converter.register_structure_hook_func(lambda kind: kind is object or kind == int | float, lambda value, _: value)
    return converter


def _is_array(kind: Any) -> bool:
    return typing.get_origin(kind) is np.ndarray


def _dtype(kind: Any) -> Any:
    """The element type that ``NDArray[...]`` names."""
    return typing.get_args(typing.get_args(kind)[1])[0]
