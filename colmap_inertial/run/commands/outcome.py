"""What a step finds for one model, or why it finds nothing, as a record of the step holds it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from colmap_inertial.core.errors import NotObservableError, TargetNotFoundError
from colmap_inertial.core.facts import Fact

Found = TypeVar("Found")


@dataclass(frozen=True, eq=False, kw_only=True)
class Outcome(Generic[Found]):
    """What was found, or the error in its parts.

    Attributes
    ----------
    found
        ``None`` where there was an error.
    unobservable
        The quantity of a ``NotObservableError``; ``None`` for a ``TargetNotFoundError``.
    why_not
        What the error says.
    """

    found: Found | None = None
    unobservable: str | None = None
    why_not: Fact | None = None

    @classmethod
    def of_error(cls, error: NotObservableError | TargetNotFoundError) -> Outcome[Found]:
        """Take an error into its parts."""
        quantity = error.quantity if isinstance(error, NotObservableError) else None
        return cls(unobservable=quantity, why_not=error.fact)

    def result(self) -> Found | NotObservableError | TargetNotFoundError:
        """What was found, or the error."""
        if self.found is not None:
            return self.found
        assert self.why_not is not None
        if self.unobservable is None:
            return TargetNotFoundError(self.why_not)
        return NotObservableError(self.unobservable, self.why_not)
