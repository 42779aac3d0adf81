"""``--help``: what a command does, its common options first, then the others by what they are about.

The words are those beside the fields of the commands' classes; nothing is said twice.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import shutil
import sys
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

#: Words for the values of options, where the type alone says too little.
_VALUES = {Path: "PATH", int: "N", float: "NUMBER", str: "TEXT"}
_BY_NAME = {
    "device": "NAME",
    "remember": "NAME",
    "target": "TARGET",
    "model": "N",
    "keep": "PATTERN",
    "colmap": "SECTION.option=value",
}
_WIDEST, _NARROWEST, _COLUMN, _OVERVIEW_COLUMN, _LONG = 100, 40, 28, 18, 120


@dataclass(frozen=True, kw_only=True)
class Option:
    """One option or argument of a command.

    Attributes
    ----------
    names
        As they are typed; for an argument, its place holder.
    group
        What its group is called in front of its name, as ``"mapping"``; empty without one.
    field
        Name of the field.
    value
        What follows the name; empty for a switch.
    text
        What it does.
    default
        In words; empty where there is none to tell.
    positional, required
        Whether it is an argument, and whether it must be there.
    source
        The class that has it.
    """

    names: tuple[str, ...]
    group: str
    field: str
    value: str
    text: str
    default: str
    positional: bool
    required: bool
    source: type[Any]


def options_of(cls: type[Any], prefix: str = "", *, with_text: bool = True) -> list[Option]:
    """All options of a command in the order of its fields, those of nested values in their places.

    Without their texts it takes a quarter of the time: texts are read from the sources.
    """
    options: list[Option] = []
    hints, texts = get_type_hints(cls, include_extras=True), _read_texts(cls) if with_text else {}
    for f in dataclasses.fields(cls):
        hint = hints[f.name]
        kind, *settings = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        named = [setting.name for setting in settings if getattr(setting, "name", None) is not None]
        name = named[0] if named else f.name.replace("_", "-")
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            options += options_of(kind, f"{prefix}{name}." if name else prefix, with_text=with_text)
            continue
        positional = any("POSITIONAL" in str(setting).upper() for setting in settings)
        default = f.default if f.default_factory is dataclasses.MISSING else f.default_factory()
        options.append(
            Option(
                names=(f.name.upper(),) if positional else _spell_names(kind, prefix, name, default),
                group=prefix.rstrip("."),
                field=f.name,
                value="" if positional else _describe_value(kind, name),
                text=texts.get(f.name, ""),
                default=_describe_default(default, texts.get(f.name, "")),
                positional=positional,
                required=default is dataclasses.MISSING,
                source=next(kind for kind in reversed(cls.__mro__) if f.name in vars(kind).get("__annotations__", ())),
            )
        )
    return options


def _spell_names(kind: Any, prefix: str, name: str, default: object) -> tuple[str, ...]:
    if bool not in _list_types(kind):
        return (f"--{prefix}{name}",)
    both = (f"--{prefix}{name}", f"--{prefix}no-{name}")
    return both[:1] if default is False else both


def _list_types(kind: Any) -> tuple[Any, ...]:
    """The types that a value may have, ``None`` left out."""
    if get_origin(kind) in (Union, UnionType):
        return tuple(inner for part in get_args(kind) if part is not NoneType for inner in _list_types(part))
    return (kind,)


def _describe_value(kind: Any, name: str) -> str:
    (single_type,) = _list_types(kind)
    if single_type is bool:
        return ""
    if get_origin(single_type) is Literal:
        return "{" + ",".join(map(str, get_args(single_type))) + "}"
    if get_origin(single_type) is tuple:
        inner = get_args(single_type)
        single = _describe_value(inner[0], name)
        return f"{single} ..." if len(inner) == 2 and inner[1] is Ellipsis else " ".join([single] * len(inner))
    return _BY_NAME.get(name, _VALUES[single_type])


def _describe_default(default: object, text: str) -> str:
    """Text on the default of an option; empty where the option's text has it, or where there is none."""
    if default is dataclasses.MISSING or default is None or default == () or isinstance(default, bool):
        return ""
    if "default" in text.lower():
        return ""
    return f"{default:g}" if isinstance(default, float) else str(default)


def _read_texts(cls: type[Any]) -> dict[str, str]:
    """The text below each field of a class and of those that it is made of."""
    texts: dict[str, str] = {}
    for base in filter(dataclasses.is_dataclass, reversed(cls.__mro__)):
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(tree, ast.ClassDef)
        for field, text in zip(tree.body, tree.body[1:], strict=False):
            match field, text:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(words))):
                    texts[name] = " ".join(words.split())
    return texts


def print_help(
    name: str,
    cls: type[Any],
    common: Sequence[str],
    titles: Mapping[type[Any], str],
    everywhere: type[Any],
    *,
    everything: bool = False,
) -> None:
    """Print one command's page: its common options on one screen, or ``everything`` by topic.

    Parameters
    ----------
    name, cls
        The command.
    common
        Fields whose options come first, in this order.
    titles
        Of groups that have no name to type, by the class that has their options.
    everywhere
        The class with the options of all commands, which come last.
    """
    page = _Page()
    options = options_of(cls)
    # the overview has the limits, which are the same for every command
    shown = [option for option in options if option.group not in (*_SPECIAL, "limits")]
    sections = _sort_into_sections(shown, common, titles, everywhere)
    arguments = "".join(f" {argument.names[0]}" for argument in sections[_ARGUMENTS])
    page.line(f"usage: colmap-inertial {name}{arguments} [OPTIONS]")
    paragraphs = inspect.cleandoc(cls.__doc__ or "").split("\n\n")
    rest = [title for title in sections if sections[title] and title not in (_ARGUMENTS, _OPTIONS, _EVERYWHERE)]
    if not everything and rest:
        paragraphs = [paragraphs[0], paragraphs[-1]] if sections[_OPTIONS] else paragraphs
        sections = {title: _shorten(entries) for title, entries in sections.items() if title not in rest}
    for paragraph in paragraphs:
        page.paragraph(paragraph)
    pages = [("-h, --help", "The common options."), ("--help-all", "All options, by topic.")]
    for title, entries in sections.items():
        page.group(title, entries, more=pages if title == _EVERYWHERE else ())
    if everything and not {option.group for option in options}.isdisjoint(_SPECIAL):
        page.paragraph(_SPECIAL_CAMERAS)


def _shorten(options: Iterable[Option]) -> list[Option]:
    """The options with the first sentences of long texts."""
    texts = ((option, option.text.partition(". ")[0].rstrip(".") + ".") for option in options)
    return [option if len(option.text) <= _LONG else dataclasses.replace(option, text=first) for option, first in texts]


_ARGUMENTS, _OPTIONS, _REST, _EVERYWHERE = "Arguments", "Options", "Less common", "Of every command"


def _sort_into_sections(
    options: Sequence[Option], common: Sequence[str], titles: Mapping[type[Any], str], everywhere: type[Any]
) -> dict[str, list[Option]]:
    """The options of a page by the titles of its sections, both in the order in which they are shown."""
    plain = [option for option in options if not option.positional and not option.group]
    first = [option for wanted in common for option in plain if option.field == wanted]
    first = [option for option in plain if option.required and option not in first] + first

    def choose_title(option: Option) -> str:
        if option.positional:
            return _ARGUMENTS
        if option.group:
            return _TITLES.get(option.group, option.group.capitalize())
        if option in first:
            return _OPTIONS
        rest = _TOPICS.get(option.field, _REST) if first else _OPTIONS
        return _EVERYWHERE if option.source is everywhere else titles.get(option.source, rest)

    order = (_ARGUMENTS, _OPTIONS, _REST, *titles.values(), *dict.fromkeys(_TITLES.values()))
    sections: dict[str, list[Option]] = {title: [] for title in (*order, *_TOPICS.values(), _EVERYWHERE)}
    for option in (*first, *(option for option in options if option not in first)):
        sections[choose_title(option)].append(option)
    return sections


#: Titles of groups by what stands in front of their options, in the order in which they are shown.
_TITLES = {
    "frames": "Choice of frames",
    "mapping": "How COLMAP builds the model",
    "scale": "How metres come from the IMU",
    "join-options": "Joining, refinement and place",
    "dense-options": "Dense reconstruction",
}
#: The same for options without a group, by field.
_TOPICS = {
    **dict.fromkeys(
        ("workers", "scheduler", "colmap", "colmap_project", "colmap_executable", "database", "database_images"),
        _TITLES["mapping"],
    ),
    **dict.fromkeys(("join", "fragments", "refine", "georeference"), _TITLES["join-options"]),
    **dict.fromkeys(("device", "remembered"), "Calibrations kept of a device"),
    **dict.fromkeys(("deterministic", "seed"), "Runs that can be repeated"),
}
#: Groups of special cameras, whose options have commands that explain them.
_SPECIAL = ("apertures", "exposures")
_SPECIAL_CAMERAS = (
    "Special cameras have options of their own, in the file of --config: [apertures] as of `fuse-apertures`, "
    "[exposures] as of `fuse-exposures`."
)


def print_overview(about: str, groups: Mapping[str, Mapping[str, type[Any]]], limits: type[Any]) -> None:
    """Print the page of all commands, by what they begin with, and the limits of files that all of them have."""
    page = _Page(column=_OVERVIEW_COLUMN)
    page.line("usage: colmap-inertial COMMAND ... (colmap-inertial COMMAND --help explains it)")
    for paragraph in inspect.cleandoc(about).split("\n\n"):
        page.paragraph(paragraph)
    for title, commands in groups.items():
        page.heading(title)
        for name, cls in commands.items():
            page.entry(name, inspect.cleandoc(cls.__doc__ or "").partition("\n\n")[0])
    stated = (f"{option.names[0]} {option.value} [{option.default}]" for option in options_of(limits, "limits."))
    page.paragraph(f"How large files may be that any command reads: {', '.join(stated)}.")


class _Page:
    """Lines that fit the terminal, headings bold where it can."""

    def __init__(self, column: int = _COLUMN) -> None:
        self._column = column
        self._width = max(_NARROWEST, min(shutil.get_terminal_size().columns, _WIDEST))
        self._bold = ("\033[1m", "\033[0m") if sys.stdout.isatty() else ("", "")

    def line(self, text: str) -> None:
        print(textwrap.fill(text, self._width, subsequent_indent="       ", break_on_hyphens=False))

    def paragraph(self, text: str) -> None:
        print()
        print(textwrap.fill(" ".join(text.split()), self._width, break_on_hyphens=False, break_long_words=False))

    def heading(self, text: str) -> None:
        print(f"\n{self._bold[0]}{text}:{self._bold[1]}")

    def entry(self, name: str, text: str) -> None:
        indent = " " * self._column
        lines = textwrap.wrap(
            " ".join(text.split()), self._width - self._column, break_on_hyphens=False, break_long_words=False
        )
        label = f"  {name}"
        if len(label) >= self._width:  # choices, which are many
            print(textwrap.fill(label.replace(",", ", "), self._width, subsequent_indent=" " * 6))
        elif len(label) >= self._column:
            print(label)
        else:
            print(f"{label:<{self._column}}{lines.pop(0) if lines else ''}".rstrip())
        for text_line in lines:
            print(f"{indent}{text_line}")

    def group(self, title: str, options: Iterable[Option], more: Sequence[tuple[str, str]] = ()) -> None:
        entries = [(_label(option), _describe(option)) for option in options]
        if not entries:
            return
        self.heading(title)
        for label, text in [*entries, *more]:
            self.entry(label, text)


def _label(option: Option) -> str:
    return " ".join(filter(None, [", ".join(option.names), option.value]))


def _describe(option: Option) -> str:
    marks = ["(required)"] if option.required and not option.positional else []
    marks += [f"[{option.default}]"] if option.default else []
    return " ".join([option.text, *marks])
