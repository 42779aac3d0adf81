"""Mistakes in a command's arguments, found before they are parsed, in words like those of all other errors."""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Iterator, Sequence
from typing import Any, Literal, get_origin

from colmap_inertial.cli.help import PAGES, Option
from colmap_inertial.core.choices import check_value

#: Options that exclude each other.
_EXCLUSIVE = ("--quiet", "--verbose")


def check_arguments(prog: str, options: Sequence[Option], args: Sequence[str]) -> None:
    """Refuse what the options and arguments of a command do not allow.

    Raises
    ------
    ValueError
        For an option that does not exist, a value that is missing or impossible, an argument that is missing or one
        too many, and options that exclude each other.
    """
    positional = [option for option in options if option.positional]
    given, arguments = [], []
    for option, name, values in _read(options, args):
        if option is None:
            arguments += values
        else:
            given.append(name)
            _check_values(option, name, values)
    excluding = [name for name in _EXCLUSIVE if name in given]
    if len(excluding) > 1:
        raise ValueError(f"{' and '.join(excluding)} exclude each other")
    missing = [option.label for option in positional[len(arguments) :]]
    missing += [option.label for option in options if option.names and option.required and option.names[0] not in given]
    if missing:
        usage = " ".join([prog, *(option.label for option in positional), "[OPTIONS]"])
        raise ValueError(f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing; usage: {usage}")
    if len(arguments) > len(positional) and not any(option.several for option in positional):
        raise ValueError(
            f"{arguments[len(positional)]!r} is one argument too many; an option that may be repeated is given once "
            "for each value"
        )


def _read(options: Sequence[Option], args: Sequence[str]) -> Iterator[tuple[Option | None, str, list[str]]]:
    """Each option with its name and values as typed, and each argument with no option.

    Raises
    ------
    ValueError
        For an option that does not exist, or has too few values.
    """
    by_name = {name: option for option in options for name in option.names}
    left = list(args)
    while left:
        word = left.pop(0)
        if word == "--":
            yield None, "", left
            return
        if not _is_name(word):
            yield None, "", [word]
            continue
        typed, equals, value = word.partition("=")
        name = typed.replace("_", "-")
        if name not in by_name:
            raise ValueError(f"{typed}: no such option{_suggest(name, options)}")
        option = by_name[name]
        values = [value] if equals else []
        while len(values) < len(option.values):
            if not left or left[0] == "--" or _is_name(left[0]):
                raise ValueError(f"{typed}: a value is missing ({option.label})")
            values.append(left.pop(0))
        if len(values) > len(option.values):
            raise ValueError(f"{typed}: takes no value")
        yield option, name, values


def _is_name(word: str) -> bool:
    """Whether a word is meant as an option's name: not a path, a negative number or ``-``."""
    if not word.startswith("-") or not word.lstrip("-")[:1].isalpha():
        return False
    with contextlib.suppress(ValueError):
        float(word)  # -inf
        return False
    return True


def _suggest(name: str, options: Sequence[Option]) -> str:
    """The options of nearly this name, or of this end of a name, with what follows them; as the end of a sentence."""
    labels = {page: [page] for page in PAGES}
    for option in options:
        for known in option.names:
            for typed in {known, f"--{known.rpartition('.')[2].lstrip('-')}"}:
                labels.setdefault(typed, []).append(option.label)
    near = dict.fromkeys(
        label for known in difflib.get_close_matches(name, labels, n=3, cutoff=0.75) for label in labels[known]
    )
    return f"; did you mean {' or '.join(near)}?" if near else ""


def _check_values(option: Option, name: str, values: Sequence[str]) -> None:
    for value, kind in zip(values, option.values, strict=True):
        number: Any = value
        if kind in (int, float):
            with contextlib.suppress(ValueError):
                number = kind(value)
        if kind in (int, float) or get_origin(kind) is Literal:
            check_value(name, number, kind)
