"""The words of all facts: one message for each code, by subject in the modules of this package.

A message is a function whose name is the code and whose parameters are the values:

    @message(advice="...", example={"count": 3})
    def wrong_cameras(count: int) -> str:
        return f"{count} cameras contradict the gyroscope"

is the message of ``Fact("wrong-cameras", count=3)``. ``example`` is shown in the list of all messages
(``docs/reference/messages.md``). Terminal, report, JSON and log show what these functions return.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar


class Said(Protocol):
    """A fact within another one's values: its code, its message, and what to do about it."""

    @property
    def code(self) -> str: ...

    @property
    def advice(self) -> str: ...

    @property
    def with_advice(self) -> str: ...


@dataclass(frozen=True)
class Message:
    """How a fact is said.

    Attributes
    ----------
    text
        The sentence by the fact's values.
    advice
        What to do about it, in words or by the values; empty where there is nothing to do.
    joint
        What stands between both where they are one sentence.
    example
        Values to show it with.
    """

    text: Callable[..., str]
    advice: Callable[..., str] | str = ""
    joint: Callable[..., str] | str = "; "
    example: Mapping[str, Any] = field(default_factory=dict)

    @functools.cached_property
    def signature(self) -> inspect.Signature:
        return inspect.signature(self.text)


_MESSAGES: dict[str, Message] = {}

Text = TypeVar("Text", bound=Callable[..., str])


def message(
    *,
    advice: Callable[..., str] | str = "",
    joint: Callable[..., str] | str = "; ",
    example: Mapping[str, Any] | None = None,
    code: str = "",
) -> Callable[[Text], Text]:
    """Register a function as the message of a code, by default that of its name with dashes."""

    def register(text: Text) -> Text:
        name = code or text.__name__.replace("_", "-")
        if name in _MESSAGES:
            raise ValueError(f"two messages have the code {name}")
        _MESSAGES[name] = Message(text=text, advice=advice, joint=joint, example=example or {})
        return text

    return register


def state(code: str, text: str, *, advice: str = "", joint: str = "; ") -> None:
    """Register a sentence that has no values."""
    message(code=code, advice=advice, joint=joint)(lambda: text)


def render(code: str, values: Mapping[str, Any]) -> str:
    """The sentence of a fact."""
    return _of(code).text(**values)


def advise(code: str, values: Mapping[str, Any]) -> str:
    """What to do about a fact."""
    advice = _of(code).advice
    return advice if isinstance(advice, str) else advice(**values)


def join(code: str, values: Mapping[str, Any]) -> str:
    """What stands between a fact's sentence and what to do about it."""
    joint = _of(code).joint
    return joint if isinstance(joint, str) else joint(**values)


def check(code: str, values: Mapping[str, Any]) -> None:
    """Raise ``LookupError`` for a code without a message, ``TypeError`` for values that its message does not take."""
    try:
        _of(code).signature.bind(**values)
    except TypeError as error:
        raise TypeError(f"{code}: {error}") from None


def all_messages() -> Mapping[str, Message]:
    """Every message by its code."""
    _load()
    return dict(sorted(_MESSAGES.items()))


def _of(code: str) -> Message:
    _load()
    if code not in _MESSAGES:
        raise LookupError(f"no message has the code {code}: add one to messages")
    return _MESSAGES[code]


@functools.cache
def _load() -> None:
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")


@message(example={"text": "words of a user's own stage"})
def stated(text: str) -> str:
    return text
