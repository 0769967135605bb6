"""The tape of a flight: what it takes in from its world, in order, so that the same flight can be run again."""

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

T = TypeVar("T")


class Tape(Protocol):
    """Takes note of what comes in, or gives it back. All values are those of JSON, or bytes."""

    def read(self, kind: str, look: Callable[[], T]) -> T:
        """Return what `look` finds; or, of a flight that is run again, what it found then."""
        ...

    def note(self, kind: str, *values: Any) -> None:
        """Take note of what has happened without being asked for, in another thread."""
        ...


class NoTape:
    """Stands in for a `Tape` where nothing is recorded."""

    def read(self, kind: str, look: Callable[[], T]) -> T:
        """Return what `look` finds."""
        return look()

    def note(self, kind: str, *values: Any) -> None:
        """Take note of nothing."""


NO_TAPE = NoTape()
