"""What the package's functions return while a test runs, summarised: to be compared with what they returned before.

Of a function that returns nothing, or raises an error, its arguments are summarised as it leaves them.
"""

from __future__ import annotations

import enum
import functools
import hashlib
import importlib.metadata
import json
import os
import re
import sys
import time
from collections import Counter
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

import colmap_inertial
from colmap_inertial.core.facts import Fact

PACKAGE = Path(colmap_inertial.__file__).parent
KEPT = Path(__file__).parent / "references" / "returned_values.json"
LIBRARIES = ("numpy", "scipy", "opencv-contrib-python-headless", "pycolmap", "av")
#: Of each function the first calls are summarised: those of a later iteration depend on the last bit of the one before.
CALLS = 4
#: Of a sequence, so many items; of an array, so many values, drawn at random.
ITEMS, VALUES = 6, 20_000
#: Values in values are followed so far.
DEEPEST = 5
#: Summaries, of six digits, are compared to this share of the values' mean size.
TOLERANCE = 1e-3

_NUMBER = re.compile(r"-?\d+\.?\d*(?:e[-+]?\d+)?")
_PATH = re.compile(r"(?:/[\w.@+-]+){2,}")
#: A test's own folder, which pytest numbers.
_FOLDER = re.compile(r"\btest_\w+\d\b")
#: Functions whose results are kept between tests, as they take seconds.
_SLOW_TO_MAKE = ("_renderer", "_plotly_library")
#: What commands begin with where the program is not on the PATH.
_PROGRAM = str(Path(sys.executable).with_name("colmap-inertial"))


@functools.cache
def _weights(count: int) -> np.ndarray:
    return np.random.default_rng(count).uniform(-1, 1, count)


def _sample(values: np.ndarray) -> np.ndarray:
    # not evenly spaced: of (N, 3) values, that may be those of one column
    few = values.size <= VALUES
    return values if few else values[np.random.default_rng(values.size).integers(0, values.size, VALUES)]


def _leaves(value: Any, path: str, depth: int) -> Iterator[tuple[str, Any]]:
    """Numbers (arrays) and texts of a value, by their place in it."""
    if isinstance(value, np.ndarray | np.generic | bool | int | float | complex) and not isinstance(value, enum.Enum):
        values = np.asarray(value)
        if values.dtype.kind in "biufc":
            yield path, values
        elif values.dtype.kind in "US":
            yield path, " ".join(values.ravel()[:ITEMS].astype(str))
        elif values.dtype.names:
            for name in values.dtype.names:
                yield from _leaves(values[name], f"{path}.{name}", depth)
    elif isinstance(value, str | Fact):
        yield path, str(value)
    elif isinstance(value, bytes):
        yield path, np.frombuffer(value, np.uint8)
    elif isinstance(value, Path):
        yield path, value.name
    elif isinstance(value, Rotation):
        yield path, value.as_matrix()
    elif sparse.issparse(value):
        yield path, value.tocsr().sum(axis=0)
    elif depth == DEEPEST:
        return
    elif isinstance(value, dict):
        for key in list(value)[:40]:
            yield from _leaves(value[key], f"{path}.{key}" if isinstance(key, str) else f"{path}.*", depth + 1)
    elif isinstance(value, set | frozenset):
        yield from _leaves(sorted(value, key=str), path, depth)
    elif isinstance(value, list | tuple):
        if value and all(isinstance(item, int | float) for item in value):
            yield path, np.array(value, float)
        else:
            yield path, np.array(len(value))
            for item in value[:ITEMS]:
                yield from _leaves(item, f"{path}[]", depth + 1)
    elif isinstance(value, enum.Enum):
        yield path, value.name
    elif type(value).__module__.startswith("colmap_inertial"):
        for name, part in list(getattr(value, "__dict__", {}).items()):
            yield from _leaves(part, f"{path}.{name}", depth + 1)
    else:
        yield path, type(value).__name__


def summarise(values: Iterable[Any]) -> dict[str, list[Any]]:
    """What a function returned, by place in it."""
    some: dict[str, list[Any]] = {}
    for value in values:
        for place, leaf in _leaves(value, "", 0):
            some.setdefault(place, []).append(leaf)
    return {place: _summary(leaves) for place, leaves in some.items()}


def _summary(some: list[Any]) -> list[Any]:
    """Of the values at one place of a result: how many, how many not finite, mean size, a weighted sum; and texts."""
    texts = [item for item in some if isinstance(item, str)]
    numbers = [np.asarray(item).ravel() for item in some if not isinstance(item, str)]
    masked = ""
    for text in texts:
        plain = text.replace(_PROGRAM, "colmap-inertial")
        plain = _FOLDER.sub("test", _PATH.sub("/", plain))
        numbers.append(np.array([float(number) for number in _NUMBER.findall(plain)][:200]))
        masked += _NUMBER.sub("#", plain)[: 240 // len(texts)]
    every = np.concatenate(numbers) if numbers else np.zeros(0)
    if np.iscomplexobj(every):
        every = np.concatenate([every.real, every.imag])
    with np.errstate(all="ignore"):
        values = _sample(every).astype(float)
        finite = np.isfinite(values)
        values = np.where(finite, values, 0.0)
        mean = float(np.abs(values).mean()) if values.size else 0.0
        turned = float(_weights(values.size) @ values) / max(1.0, values.size**0.5)
    out: list[Any] = [every.size, int(np.count_nonzero(~finite)), _rounded(mean), _rounded(turned)]
    return [*out, masked] if masked else out


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


class Recorder:
    """Notes what functions of the package return in this thread while it is on: all, or the wanted places of some."""

    def __init__(self, wanted: Mapping[str, Container[str]] | None = None) -> None:
        self._wanted = wanted
        self._root = str(PACKAGE) + os.sep
        #: By code object: its function's name, or ``None`` of what is not noted; and how often it has returned.
        self._names: dict[CodeType, str | None] = {}
        self._calls: Counter[CodeType] = Counter()
        self._leaves: dict[str, dict[str, list[Any]]] = {}
        self._error: Exception | None = None
        self.seconds = 0.0

    def __enter__(self) -> Recorder:
        for name, module in list(sys.modules.items()):
            for thing in vars(module).values() if name.startswith(PACKAGE.name) else ():
                if isinstance(thing, functools._lru_cache_wrapper) and thing.__name__ not in _SLOW_TO_MAKE:
                    thing.cache_clear()
        self.seconds = time.perf_counter()
        sys.setprofile(self._note)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)
        self.seconds = time.perf_counter() - self.seconds

    def _note(self, frame: FrameType, event: str, value: Any) -> None:
        if event != "return":
            return
        code = frame.f_code
        if code not in self._names:
            self._names[code] = self._name(code)
        name = self._names[code]
        if name is None or self._calls[code] == CALLS:
            return
        self._calls[code] += 1
        into = self._leaves.setdefault(name, {})
        places = None if self._wanted is None else self._wanted[name]
        try:
            if value is None:  # what it left in its arguments, or wrote
                arguments = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
                value = {argument: frame.f_locals[argument] for argument in arguments if argument in frame.f_locals}
            for place, leaf in _leaves(value, "", 0):
                if places is None or place in places:
                    into.setdefault(place, []).append(leaf.copy() if isinstance(leaf, np.ndarray) else leaf)
        except Exception as error:  # not to be met by the function that returns
            self._error = self._error or error

    def _name(self, code: CodeType) -> str | None:
        # neither templates nor comprehensions
        if not code.co_filename.startswith(self._root) or code.co_filename[-3:] != ".py" or code.co_name[0] == "<":
            return None
        name = f"{code.co_filename[len(self._root) : -3]}:{code.co_qualname}"
        return name if self._wanted is None or name in self._wanted else None

    def summaries(self) -> dict[str, dict[str, list[Any]]]:
        """By function and place in its result."""
        if self._error is not None:
            raise self._error
        return {name: {path: _summary(some) for path, some in leaves.items()} for name, leaves in self._leaves.items()}


def differences(seen: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """What differs from a kept summary, each with function and place."""
    out = []
    for name, places in wanted.items():
        for place, kept in places.items():
            found = seen.get(name, {}).get(place)
            if not same(found, kept):
                out.append(f"{name}{place}: {found} instead of {kept}")
    return out


def same(found: list[Any] | None, kept: list[Any], share: float = TOLERANCE) -> bool:
    """Whether a summary is the kept one: numbers to a share of their mean size."""
    if found is None or len(found) != len(kept) or found[:2] != kept[:2] or found[4:] != kept[4:]:
        return False
    room = share * abs(kept[2]) + 1e-12
    return abs(found[2] - kept[2]) <= room and abs(found[3] - kept[3]) <= room


def read_kept() -> dict[str, dict[str, Any]]:
    """What is kept, by test, function and place."""
    return json.loads(KEPT.read_text())["tests"] if KEPT.exists() else {}


def versions() -> dict[str, str]:
    """Of the libraries that calculate."""
    found = {each.metadata["Name"]: each.version for each in importlib.metadata.distributions()}
    return {name: found.get(name, "not installed") for name in LIBRARIES}


def explain(changed: Sequence[str]) -> str:
    """A failed comparison in words."""
    before, now = json.loads(KEPT.read_text())["versions"], versions()
    words = ["functions return other values than before (if that is meant: scripts/record_values.py renew)"]
    words += [f"{name} is {now[name]}, was {before.get(name)}" for name in now if before.get(name) != now[name]]
    return "\n".join([*words, *changed])


def write_seen(folder: Path, test: str, recorder: Recorder) -> None:
    """Write what functions returned in a test into a file of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    seen = {"test": test, "seconds": recorder.seconds, "returned": recorder.summaries()}
    (folder / f"{hashlib.sha256(test.encode()).hexdigest()}.json").write_text(json.dumps(seen))
