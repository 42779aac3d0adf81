"""Values as JSON types, from which the key of a step is hashed."""

from __future__ import annotations

import dataclasses
import enum
import functools
import hashlib
import types
import uuid
from collections.abc import Mapping
from pathlib import Path

import numpy as np


def as_json_types(value: object) -> object:
    """A value in JSON types that differ where anything in it differs that decides a result.

    Dataclasses go by their fields, without those declared with ``compare=False``; arrays by their content; paths as
    text, however they were spelt; functions of a user by their name, code, closure and defaults. Of anything else it
    cannot be told whether two are the same: each time it is another one.
    """
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if value is ...:
        return "..."
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
    if isinstance(value, Path):
        return str(value.resolve())
    if isinstance(value, Mapping):
        return {str(key): as_json_types(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_json_types(item) for item in value]
    if isinstance(value, (set, frozenset)):
        return sorted((as_json_types(item) for item in value), key=repr)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _describe_instance(value)
    if isinstance(value, functools.partial):
        return ["partial", *map(as_json_types, (value.func, value.args, value.keywords))]
    if isinstance(value, types.FunctionType):
        return _describe_function(value)
    if isinstance(value, types.MethodType):
        return [as_json_types(value.__func__), as_json_types(value.__self__)]
    return f"{_name(type(value))} {uuid.uuid4()}"


def _name(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


def _describe_instance(value: object) -> dict[str, object]:
    """Class, methods and fields of a dataclass's instance. Our own methods are known by our version."""
    kind = type(value)
    methods = {}
    if kind.__module__.split(".")[0] != __package__.split(".")[0]:
        functions = {name: value for name, value in vars(kind).items() if isinstance(value, types.FunctionType)}
        own = {name for name in functions if name == "__call__" or not name.startswith("__")}
        methods = {name: as_json_types(function) for name, function in functions.items() if name in own}
    compared = [f.name for f in dataclasses.fields(value) if f.compare]  # type: ignore[arg-type]
    fields = {name: as_json_types(getattr(value, name)) for name in compared}
    return {"type": _name(kind), "methods": methods, **fields}


def _describe_function(function: types.FunctionType) -> list[object]:
    closure = [as_json_types(cell.cell_contents) for cell in function.__closure__ or ()]
    defaults = as_json_types([function.__defaults__, function.__kwdefaults__])
    return [f"{function.__module__}.{function.__qualname__}", _describe_code(function.__code__), closure, defaults]


def _describe_code(code: types.CodeType) -> list[object]:
    """A function's body, without names of files and numbers of lines."""
    constants = [_describe_code(c) if isinstance(c, types.CodeType) else _describe_constant(c) for c in code.co_consts]
    return [code.co_code.hex(), list(code.co_names), constants]


def _describe_constant(value: object) -> object:
    """A constant of a function, the same in every process: the order of a set is not."""
    if isinstance(value, tuple):
        return tuple(map(_describe_constant, value))
    if isinstance(value, frozenset):
        return sorted(map(_describe_constant, value), key=repr)
    return repr(value)
