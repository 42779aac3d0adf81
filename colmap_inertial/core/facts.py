"""Facts: what was found, decided or done, as a code with values.

Code that decides looks at codes and values. Their words are in ``messages``, and nowhere else.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from colmap_inertial import messages


@dataclass(frozen=True, init=False)
class Fact:
    """One thing that was found, decided or done.

    Parameters
    ----------
    code
        Its stable name, of ``messages``.
    values
        What its message is made of: numbers (units are in the names), names, other facts, and tuples of them.

    Raises
    ------
    LookupError
        Where no message has this code.
    TypeError
        Where the message needs other values.
    """

    code: str
    values: Mapping[str, Any]

    def __init__(self, code: str, /, **values: Any) -> None:
        object.__setattr__(self, "code", code)
        object.__setattr__(self, "values", {name: _freeze(value) for name, value in values.items()})
        messages.check(code, self.values)

    def __str__(self) -> str:
        return messages.render(self.code, self.values)

    def __hash__(self) -> int:
        return hash((self.code, tuple(self.values)))

    @property
    def advice(self) -> str:
        """What to do about it; empty where there is nothing to do."""
        return messages.advise(self.code, self.values)

    @property
    def with_advice(self) -> str:
        """The message, and what to do about it."""
        return f"{self}{messages.join(self.code, self.values)}{self.advice}" if self.advice else str(self)

    def as_json(self) -> dict[str, object]:
        """Code and values."""
        return {"code": self.code, "values": {name: _plain(value) for name, value in self.values.items()}}

    @classmethod
    def stated(cls, text: str) -> Fact:
        """Words from outside: of a user's own stage, or of a file by an earlier version."""
        return cls("stated", text=text)


def as_fact(of: Fact | str) -> Fact:
    """A fact, or words from outside as one."""
    return of if isinstance(of, Fact) else Fact.stated(of)


def sentences(facts: Iterable[Fact]) -> tuple[str, ...]:
    """The message of each fact."""
    return tuple(str(fact) for fact in facts)


#: What the key of codes and values adds to that of the sentences beside them.
DETAILS = "_details"


def with_sentences(fields: Mapping[str, object]) -> dict[str, object]:
    """Fields with the sentences of those that are facts, and their codes and values beside them (``reasons_details``).

    Parameters
    ----------
    fields
        Any values; facts and tuples of facts become words, the rest stays.
    """
    out: dict[str, object] = {}
    for name, value in fields.items():
        if isinstance(value, Fact):
            out |= {name: str(value), name + DETAILS: value.as_json()}
        elif isinstance(value, tuple | list) and value and all(isinstance(item, Fact) for item in value):
            out |= {name: [str(item) for item in value], name + DETAILS: details(value)}
        else:
            out[name] = value
    return out


def read_facts(fields: Mapping[str, Any], name: str) -> tuple[Fact, ...]:
    """Facts that :func:`with_sentences` wrote; where it wrote no codes, or none that are known here, their sentences.

    Parameters
    ----------
    fields, name
        The JSON object, and which of its fields.
    """
    texts, coded = fields.get(name) or (), fields.get(name + DETAILS)
    if isinstance(coded, list) and len(coded) == len(texts):
        try:
            return tuple(Fact(one["code"], **one["values"]) for one in coded)
        except (KeyError, TypeError, LookupError):
            pass
    return tuple(Fact.stated(str(text)) for text in texts)


def details(facts: Iterable[Fact]) -> list[dict[str, object]]:
    """Code and values of each fact, as JSON has them beside the sentences."""
    return [fact.as_json() for fact in facts]


def _freeze(value: Any) -> Any:
    """Plain values, with tuples for sequences, numbers for those of arrays, and facts for what JSON has of them."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping) and value.keys() == {"code", "values"}:
        return Fact(value["code"], **value["values"])
    if isinstance(value, list | tuple):
        return tuple(_freeze(item) for item in value)
    return value


def _plain(value: Any) -> Any:
    """JSON types: facts by code and values, numbers that JSON lacks by their names."""
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value.as_json() if isinstance(value, Fact) else value
