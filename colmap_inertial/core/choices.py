"""Values of options against the annotations of their fields, wherever they come from. Loading this costs nothing."""

from __future__ import annotations

import difflib
import numbers
import types
import typing
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Self


@dataclass(frozen=True, kw_only=True)
class CheckedOptions:
    """Options whose values are those that their annotations allow; what is nearly one of a choice is suggested."""

    def __new__(cls, *_: object, **values: object) -> Self:
        """Refuse a field that there is not.

        Raises
        ------
        TypeError
            With the field that is spelled nearly the same.
        """
        known_fields = cls.__dataclass_fields__
        for name in values:
            if name not in known_fields:
                raise TypeError(f"{cls.__name__} has no field {name!r}{suggest_nearest(name, known_fields)}")
        return super().__new__(cls)

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
        if typing.get_origin(kind) is tuple:
            items = [value] if _is_path(typing.get_args(kind)[0]) and _is_pathlike(value) else value
            hints = _hints_of_items(kind, items)
            if hints is not None:
                return tuple(check_value(name, item, of) for item, of in zip(items, hints, strict=True))
        elif _allows(kind, value):
            if _is_path(kind) and "\0" in str(value):
                raise ValueError(f"{name}: holds a NUL character")
            return kind(value) if kind in (int, float) or _is_path(kind) else value
    raise ValueError(f"{name}: {_shorten(value)} is not {_describe(kinds)}{_suggest(value, kinds)}")


def _is_path(kind: Any) -> bool:
    return hasattr(kind, "__fspath__")


def _is_pathlike(value: object) -> bool:
    return isinstance(value, str) or hasattr(value, "__fspath__")


def _hints_of_items(kind: Any, items: object) -> Sequence[Any] | None:
    """The annotations of a tuple's items; ``None`` where there are no items, or too many."""
    hints = typing.get_args(kind)
    if not isinstance(items, list | tuple):
        return None
    if hints[-1] is ...:
        return hints[:1] * len(items)
    return hints if len(items) == len(hints) else None


def _allows(kind: Any, value: object) -> bool:
    if typing.get_origin(kind) is typing.Literal:
        return any(type(value) is type(choice) and value == choice for choice in typing.get_args(kind))
    if kind in (int, float):
        wanted = numbers.Integral if kind is int else numbers.Real
        return isinstance(value, wanted) and not isinstance(value, bool)
    return _is_pathlike(value) if _is_path(kind) else isinstance(value, kind)


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


_KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "a string"}


def _describe(kinds: tuple[Any, ...]) -> str:
    words = []
    for kind in kinds:
        if typing.get_origin(kind) is typing.Literal:
            words.append("one of " + ", ".join(map(repr, typing.get_args(kind))))
        elif typing.get_origin(kind) is tuple:
            arguments = typing.get_args(kind)
            words.append(
                "a list of strings" if arguments[-1] is ... else f"{len(arguments)} of {arguments[0].__name__}"
            )
        elif kind is not type(None):
            words.append(_KINDS.get(kind, f"a {getattr(kind, '__name__', kind)}"))
    return " or ".join(words)


def _suggest(value: object, kinds: tuple[Any, ...]) -> str:
    """The choice that is spelled nearly the same."""
    choices = [word for kind in kinds if typing.get_origin(kind) is typing.Literal for word in typing.get_args(kind)]
    return suggest_nearest(value, choices) if isinstance(value, str) else ""


def suggest_nearest(word: str, choices: Iterable[str]) -> str:
    """The known word that is spelled nearly the same, as the end of a sentence; empty where there is none."""
    near = difflib.get_close_matches(word, list(choices), n=1)
    return f"; did you mean {near[0]!r}?" if near else ""
