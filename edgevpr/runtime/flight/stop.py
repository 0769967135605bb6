"""Ends a flight on a signal."""

from collections.abc import Iterator
from contextlib import contextmanager


class StopNow(BaseException):
    """Raised by a signal to end a flight at once; a BaseException, so that no error handler catches it."""


class Stop:
    """Signal handler that ends a flight: with StopNow during startup and while a frame is recognised, otherwise after
    the current pass of the loop."""

    def __init__(self) -> None:
        self._is_requested = self._is_interruptible = self._is_starting = False

    @property
    def is_requested(self) -> bool:
        """True if a signal has requested the end of the flight."""
        return self._is_requested

    def __call__(self, *_: object) -> None:
        self._is_requested = True
        if self._is_starting:
            raise StopNow
        if self._is_interruptible:
            self._is_interruptible = False  # a second signal must not raise again
            self._interrupt()

    @contextmanager
    def interrupt_start(self) -> Iterator[None]:
        """Context manager for the start of a flight: a signal, even an earlier one, raises StopNow."""
        self._is_starting = True
        try:
            if self._is_requested:
                raise StopNow
            yield
        finally:
            self._is_starting = False

    @contextmanager
    def allow_interrupt(self) -> Iterator[None]:
        """Context manager: a signal interrupts the enclosed code with StopNow."""
        self._is_interruptible = True
        try:
            yield
        finally:
            self._is_interruptible = False

    def _interrupt(self) -> None:
        raise StopNow
