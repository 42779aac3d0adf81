"""Values of options against the annotations of their fields, wherever they come from. Loading this costs nothing."""

from __future__ import annotations

import difflib
import numbers
import types
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, kw_only=True)
class CheckedOptions:
    """Options whose values are those that their annotations allow; what is nearly one of a choice is suggested."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises
        ------
        ValueError
            For a value of another type, or one that is not among the choices.
        """
        for name, hint in typing.get_type_hints(type(self)).items():
            object.__setattr__(self, name, check_value(name, getattr(self, name), hint))


def check_value(name: str, value: Any, hint: Any) -> Any:
    """A value as an annotation wants it: numbers as its type, lists as tuples, texts as paths.

    Raises
    ------
    ValueError
        Where it is none of what the annotation allows.
    """
    kinds = typing.get_args(hint) if typing.get_origin(hint) in (types.UnionType, typing.Union) else (hint,)
    for kind in kinds:
        origin, arguments = typing.get_origin(kind), typing.get_args(kind)
        if origin is typing.Literal:
            if any(value is choice or (isinstance(value, str) and value == choice) for choice in arguments):
                return value
        elif kind is Path:
            if isinstance(value, str | Path):
                if "\0" in str(value):
                    raise ValueError(f"{name}: holds a NUL character")
                return Path(value)
        elif origin is tuple:
            items = [value] if arguments[0] is Path and isinstance(value, str | Path) else value
            if isinstance(items, list | tuple) and (arguments[-1] is ... or len(items) == len(arguments)):
                of_items = arguments if arguments[-1] is not ... else arguments[:1] * len(items)
                return tuple(check_value(name, item, of) for item, of in zip(items, of_items, strict=True))
        elif kind in (int, float):
            if isinstance(value, numbers.Integral if kind is int else numbers.Real) and not isinstance(value, bool):
                return kind(value)
        elif isinstance(value, kind):
            return value
    raise ValueError(f"{name}: {_shorten(value)} is not {_describe(kinds)}{_suggest(value, kinds)}")


def check_kind(name: str, value: object, kind: type, **elsewhere: type) -> None:
    """Refuse an argument of another type; ``elsewhere`` says by which name what was given would be taken.

    Raises
    ------
    TypeError
    """
    if isinstance(value, kind):
        return
    meant = next((f"; give it as {other}=..." for other, of in elsewhere.items() if isinstance(value, of)), "")
    raise TypeError(f"{name} must be a {kind.__name__}, not {_shorten(value)}{meant}")


def _shorten(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"a {type(value).__name__}"


def _describe(kinds: tuple[Any, ...]) -> str:
    words = []
    for kind in kinds:
        if typing.get_origin(kind) is typing.Literal:
            words.append("one of " + ", ".join(map(repr, typing.get_args(kind))))
        elif typing.get_origin(kind) is tuple:
            arguments = typing.get_args(kind)
            words.append("a list of texts" if arguments[-1] is ... else f"{len(arguments)} of {arguments[0].__name__}")
        elif kind is not type(None):
            words.append(f"a {getattr(kind, '__name__', kind)}")
    return " or ".join(words)


def _suggest(value: object, kinds: tuple[Any, ...]) -> str:
    """The choice that is spelled nearly the same."""
    choices = [word for kind in kinds if typing.get_origin(kind) is typing.Literal for word in typing.get_args(kind)]
    near = difflib.get_close_matches(value, choices, n=1) if isinstance(value, str) else []
    return f"; did you mean {near[0]!r}?" if near else ""
