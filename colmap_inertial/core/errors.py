"""The exceptions that a user's data or environment can cause.

Every one of them is a sentence for the user: what is wrong, where, and what to do. A programmer's mistake stays a
``ValueError`` or ``TypeError``.
"""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any, ClassVar

from colmap_inertial.core.facts import Fact, as_fact

#: Libraries that open3d and pycolmap-cuda12 take from the system, and their packages on Debian.
_SYSTEM_LIBRARIES = {
    "libusb-1.0": "libusb-1.0-0",
    "libGL.so": "libgl1",
    "libEGL.so": "libegl1",
    "libgomp.so": "libgomp1",
    "libX11.so": "libx11-6",
    "libudev.so": "libudev1",
    "libSM.so": "libsm6",
    "libICE.so": "libice6",
    "libXext.so": "libxext6",
}


class InertialError(Exception):
    """Base class of all errors that the command line shows as one line.

    Parameters
    ----------
    fact
        What is wrong; its message is shown with its advice. Formats and stages of users may give words.
    shown
        What is shown in its place.

    Attributes
    ----------
    fact
        What is wrong, without the place or the quantity.
    code
        Stable name of what is wrong: the fact's.
    """

    exit_code: ClassVar[int] = 2

    def __init__(self, fact: Fact | str, *, shown: str = "") -> None:
        self.fact = as_fact(fact)
        super().__init__(shown or self.fact.with_advice)

    def __reduce__(self) -> tuple[object, ...]:
        # by fields: a worker's errors come to another process, and the constructors take other arguments
        return _restore, (type(self), self.args, vars(self))

    @property
    def code(self) -> str:
        return self.fact.code


def _restore(kind: type[InertialError], args: tuple[str, ...], fields: dict[str, Any]) -> InertialError:
    error = kind.__new__(kind, *args)
    vars(error).update(fields)
    return error


def fact_of(error: InertialError) -> Fact:
    """An error as a fact, whose message is that of the error: with the place, the quantity and what to do."""
    fact = error.fact
    if isinstance(error, NotObservableError):
        return Fact("quantity-not-observable", quantity=error.quantity, why=fact, sigma=error.sigma)
    if isinstance(error, FormatError):
        return Fact("wrong-in-file", path=str(error.path), line=error.line, why=fact)
    return Fact("noted-with-advice", found=fact) if fact.advice and str(error) != str(fact) else fact


class FormatError(InertialError):
    """A file or folder cannot be read as what it should be.

    Parameters
    ----------
    path
        The file or folder.
    reason
        What is wrong and what to do.
    line
        One-based line number, where the file has lines.
    """

    def __init__(self, path: Path | str, reason: Fact | str, *, line: int | None = None) -> None:
        self.path = Path(path)
        fact = as_fact(reason)
        self.reason = fact.with_advice
        self.line = line
        place = f"{path}{'' if line is None else f', line {line}'}"
        super().__init__(fact, shown=f"{place}: {self.reason}")


class TimingError(InertialError):
    """Timestamps are missing, out of order, or do not fit together."""


class OutputError(InertialError):
    """An output cannot be written where it was asked for."""


class OutputExistsError(OutputError):
    """Something that would be overwritten is already there."""


class MissingExtraError(InertialError):
    """Something needs an optional package that is not installed.

    Parameters
    ----------
    extra
        Its name in ``pyproject.toml``.
    what
        What needs it.
    """

    def __init__(self, extra: str, what: Fact) -> None:
        self.extra = extra
        super().__init__(Fact("extra-missing", what=what, extra=extra, packages=_list_packages(extra)))


def _list_packages(extra: str) -> list[str]:
    """Requirements of an extra, by this package's own metadata: the package itself need not be on an index."""
    from importlib.metadata import requires

    stated = (line.partition(";") for line in requires("colmap-inertial") or ())
    marks = (f'extra == "{extra}"', f"extra == '{extra}'")
    return [name.strip() for name, _, when in stated if any(mark in when for mark in marks)]


class AlreadyMetricError(InertialError):
    """A model that already holds a metric scale would be scaled again."""


class NotObservableError(InertialError):
    """The data cannot give the quantity that was asked for.

    Parameters
    ----------
    quantity
        What cannot be given, for example ``"scale"``.
    hint
        Why, and what to record instead.
    sigma
        Relative standard deviation, where one was computed.
    """

    exit_code = 3

    def __init__(self, quantity: str, hint: Fact | str, *, sigma: float | None = None) -> None:
        self.quantity = quantity
        fact = as_fact(hint)
        self.hint = fact.with_advice
        self.sigma = sigma
        spread = "" if sigma is None else f" (standard deviation {100 * sigma:.1f} %)"
        super().__init__(fact, shown=f"{quantity} is not observable{spread}: {self.hint}")


class MappingError(InertialError):
    """COLMAP could not build a model from the images."""

    exit_code = 4


class TargetNotFoundError(InertialError):
    """The calibration target was not found in the images."""

    exit_code = 5


def describe_environment_fault(error: BaseException) -> Fact | None:
    """What is wrong for an exception that memory, files or a package that cannot be loaded have led to.

    ``None`` for any other. pycolmap says only that it cannot be imported, and how it is installed.
    """
    return _describe_exhausted(error) or _describe_unloadable(error)


def _describe_exhausted(error: BaseException | None) -> Fact | None:
    while error is not None:
        number = error.errno if isinstance(error, OSError) else None
        if isinstance(error, MemoryError) or number == errno.ENOMEM or "failed to map segment" in str(error):
            return Fact("memory-used-up")
        if number in (errno.EMFILE, errno.ENFILE):
            return Fact("too-many-files-open")
        error = error.__cause__ or error.__context__
    return None


def advise_library(why: str, distribution: str) -> Fact:
    """What to do where a library of a package (by its name for pip) is missing, by what the loader said."""
    package = next((package for library, package in _SYSTEM_LIBRARIES.items() if library in why), None)
    # other libraries come with the package, or with those that it needs
    return (
        Fact("install-again", package=distribution) if package is None else Fact("install-on-debian", package=package)
    )


def _describe_unloadable(error: BaseException | None) -> Fact | None:
    while error is not None and not isinstance(error, ImportError):
        error = error.__cause__
    is_compiled = error is not None and str(error.path).endswith(".so")
    # a name that a module lacks, or a module of ours, is a programmer's mistake
    if error is None or not (is_compiled or isinstance(error, ModuleNotFoundError)):
        return None
    if str(error.name).startswith("colmap_inertial") and not is_compiled:
        return None
    from importlib.metadata import packages_distributions

    known = packages_distributions()
    # a compiled module may lie deep in its package
    folders = Path(str(error.path)).parents if is_compiled else ()
    package = next((folder.name for folder in folders if folder.name in known), None)
    if package is None or package == "colmap_inertial":
        return Fact("module-missing", detail=str(error))
    mend = advise_library(str(error), known[package][0])
    return Fact("package-not-loaded", package=package, detail=str(error), mend=mend)
