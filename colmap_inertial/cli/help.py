"""``--help`` and ``--help-all``: what a command does, its common options, and all of them by topic.

The words are those beside the fields of the commands' classes; nothing is said twice.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from tyro.conf import Positional

from colmap_inertial.cli.command import Command
from colmap_inertial.core.printing import open_console

if TYPE_CHECKING:
    from rich.console import Console

_TYPES = {Path: "PATH", int: "INT", float: "FLOAT", str: "TEXT"}
_WIDEST, _LABEL_WIDTH, _LONG = 100, 30, 120
_ARGUMENTS, _OPTIONS, _REST, _EVERYWHERE = "Arguments", "Options", "Less common", "Options of every command"
_PAGES = (("-h, --help", "The common options."), ("--help-all", "All options, by topic."))
#: Groups of options that special cameras have; commands of their own explain them.
_SPECIAL = ("apertures", "exposures")
_SPECIAL_CAMERAS = (
    "Special cameras have options of their own, in the file of --config: [apertures] as of `fuse-apertures`, "
    "[exposures] as of `fuse-exposures`."
)


@dataclass(frozen=True, kw_only=True)
class Option:
    """One option or argument of a command.

    Attributes
    ----------
    label
        As it is typed, and what follows it.
    text
        What it does, and its default.
    field
        Name of its field.
    group
        The field that holds it, as ``"mapping"`` of ``--mapping.pairing``; empty without one.
    positional, required
        Whether it is an argument, and whether it must be there.
    source
        The class that has it.
    choices
        The values that it takes; empty where they are not listed.
    """

    label: str
    text: str
    field: str
    group: str
    positional: bool
    required: bool
    source: type[Any]
    choices: tuple[str, ...]


def list_options(cls: type[Any], group: str = "") -> Iterator[Option]:
    """All options of a command in the order of its fields, those of nested values in their places."""
    hints, texts = get_type_hints(cls, include_extras=True), read_texts(cls)
    for f in dataclasses.fields(cls):
        kind, *settings = get_args(hints[f.name]) if get_origin(hints[f.name]) is Annotated else (hints[f.name],)
        names = [setting.name for setting in settings if getattr(setting, "name", None) is not None]
        name = names[0] if names else f.name.replace("_", "-")
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            yield from list_options(kind, f.name if name else group)
            continue
        positional = Positional in settings
        default = f.default if f.default_factory is dataclasses.MISSING else f.default_factory()
        required = default is dataclasses.MISSING
        prefix = f"--{group.replace('_', '-')}." if group else "--"
        value = "" if positional else _describe_value(kind)
        may_be_on = not value and default is not False
        flag = f"{prefix}{name}, {prefix}no-{name}" if may_be_on else f"{prefix}{name}"
        text = texts.get(f.name, "")
        marks = ["(required)"] if required and not positional else []
        marks += ["(may be repeated)"] if default == () else []
        marks += [] if "default" in text.lower() else [_describe(default)]
        yield Option(
            label=f.name.upper() if positional else f"{flag} {value}".rstrip(),
            text=" ".join(filter(None, [text, *marks])),
            field=f.name,
            group=group,
            positional=positional,
            required=required,
            source=next(base for base in reversed(cls.__mro__) if f.name in vars(base).get("__annotations__", ())),
            choices=get_args(_leave_out_none(kind)) if get_origin(_leave_out_none(kind)) is Literal else (),
        )


def _leave_out_none(kind: Any) -> Any:
    """The type of an option's value where it is given."""
    if get_origin(kind) in (Union, UnionType):
        (kind,) = (part for part in get_args(kind) if part is not NoneType)
    return kind


def _describe_value(kind: Any) -> str:
    """What follows an option of a type; nothing follows a switch."""
    kind = _leave_out_none(kind)
    if get_origin(kind) is Literal:
        choices = f"{{{','.join(map(str, get_args(kind)))}}}"
        return choices if len(choices) <= _LABEL_WIDTH else choices.replace(",", ", ")
    if get_origin(kind) is tuple:
        return " ".join(_describe_value(part) for part in get_args(kind) if part is not Ellipsis)
    return "" if kind is bool else _TYPES[kind]


def _describe(default: object) -> str:
    """A default; empty where there is none to tell."""
    if default is dataclasses.MISSING or default is None or default == () or isinstance(default, bool):
        return ""
    return f"[{default:g}]" if isinstance(default, float) else f"[{default}]"


def read_texts(cls: type[Any]) -> dict[str, str]:
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


def print_help(name: str, cls: type[Command], *, everything: bool) -> None:
    """Print one command's page: its common options on one screen, or ``everything`` by topic."""
    options = list(list_options(cls))
    sections = _sort_into_sections(options, cls)
    paragraphs = inspect.cleandoc(cls.__doc__ or "").split("\n\n")
    if not everything and cls.common:
        paragraphs = [paragraphs[0], paragraphs[-1]]
        shown = (_ARGUMENTS, _OPTIONS, _EVERYWHERE)
        sections = {title: [_shorten(option) for option in sections[title]] for title in shown}
    arguments = "".join(f" {argument.label}" for argument in sections[_ARGUMENTS])
    console = _open_page()
    console.print(f"usage: colmap-inertial {name}{arguments} [OPTIONS]", markup=False)
    _print_paragraphs(console, paragraphs)
    for title, entries in sections.items():
        rows = [(option.label, option.text) for option in entries]
        _print_section(console, title, [*rows, *(_PAGES if title == _EVERYWHERE else ())])
    if everything and any(option.group in _SPECIAL for option in options):
        _print_paragraphs(console, [_SPECIAL_CAMERAS])


def _sort_into_sections(options: Iterable[Option], cls: type[Command]) -> dict[str, list[Option]]:
    """The options of a page by the titles of its sections, both in the order in which they are shown."""
    topics = {field: title for title, fields in cls.topics.items() for field in fields}
    sections: dict[str, list[Option]] = {title: [] for title in (_ARGUMENTS, _OPTIONS, _REST, *cls.topics, _EVERYWHERE)}
    for option in options:
        if option.group in (*_SPECIAL, "limits"):  # the overview has the limits, which are the same for every command
            continue
        if option.positional:
            title = _ARGUMENTS
        elif not option.group and (option.required or not cls.common or option.field in cls.common):
            title = _OPTIONS
        elif option.source is Command:
            title = _EVERYWHERE
        else:
            title = topics.get(option.group or option.field, _REST)
        sections[title].append(option)
    sections[_OPTIONS].sort(key=lambda option: cls.common.index(option.field) if option.field in cls.common else -1)
    return sections


def _shorten(option: Option) -> Option:
    """The option with the first sentence of a long text."""
    first = option.text.partition(". ")[0].rstrip(".") + "."
    return option if len(option.text) <= _LONG else dataclasses.replace(option, text=first)


def print_overview(description: str, groups: Mapping[str, Mapping[str, type[Command]]], limits: type[Any]) -> None:
    """Print the page of all commands, by what they begin with, and the limits of files that all of them have."""
    console = _open_page()
    console.print("usage: colmap-inertial COMMAND ... (colmap-inertial COMMAND --help explains it)")
    _print_paragraphs(console, description.split("\n\n"))
    for title, commands in groups.items():
        first = {name: inspect.cleandoc(cls.__doc__ or "").partition("\n\n")[0] for name, cls in commands.items()}
        _print_section(console, title, first.items())
    _print_section(
        console,
        "Limits on files that any command reads",
        [(option.label, option.text) for option in list_options(limits, "limits")],
    )


def _open_page() -> Console:
    console = open_console(highlight=False)
    console.width = min(console.width, _WIDEST)
    return console


def _print_paragraphs(console: Console, paragraphs: Iterable[str]) -> None:
    for paragraph in paragraphs:
        console.print(f"\n{' '.join(paragraph.split())}", markup=False)


def _print_section(console: Console, title: str, rows: Iterable[tuple[str, str]]) -> None:
    """A heading, and below it what there is with what it means; nothing where there is nothing."""
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(max_width=_LABEL_WIDTH, overflow="fold")
    table.add_column()
    for label, text in rows:
        table.add_row(Text(label), Text(text))
    if table.row_count:
        console.print(Text(f"\n{title}:", "bold"))
        console.print(Padding(table, (0, 0, 0, 2)))
