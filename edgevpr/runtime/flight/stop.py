"""The end of a flight by a signal."""

from collections.abc import Iterator
from contextlib import contextmanager


class StopNow(BaseException):
    """Raised by a signal to end a flight at once; a BaseException, so that no handler of errors catches it."""


class Stop:
    """Signal handler that ends a flight: by StopNow before it begins and while a frame is recognised, otherwise after
    the present pass of the loop."""

    def __init__(self) -> None:
        self._asked = self._breakable = self._begins = False

    @property
    def asked(self) -> bool:
        """True if a signal has asked for the end of the flight."""
        return self._asked

    def __call__(self, *_: object) -> None:
        self._asked = True
        if self._begins:
            raise StopNow
        if self._breakable:
            self._breakable = False  # a second signal must not raise again
            self._break_off()

    @contextmanager
    def beginning(self) -> Iterator[None]:
        """Context manager for the start of a flight: a signal, also an earlier one, raises StopNow."""
        self._begins = True
        try:
            if self._asked:
                raise StopNow
            yield
        finally:
            self._begins = False

    @contextmanager
    def breaks_off(self) -> Iterator[None]:
        """Context manager: a signal interrupts the work inside it by StopNow."""
        self._breakable = True
        try:
            yield
        finally:
            self._breakable = False

    def _break_off(self) -> None:
        raise StopNow
