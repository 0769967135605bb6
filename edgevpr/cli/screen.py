"""The way of all output to the terminal: nothing passes that a terminal would act on, and no password."""

import io
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any, TextIO

from edgevpr.core.text import shown

_LAYOUT = "\n\r\t"  # what tables and progress lines are made with


@contextmanager
def guarded_output() -> Iterator[None]:
    """Let all that is printed inside this context pass through `shown`, whoever prints it."""
    with redirect_stdout(_Guarded(sys.stdout)), redirect_stderr(_Guarded(sys.stderr)):
        yield


def erase_lines(count: int) -> None:
    """Go so many lines up on the terminal, and clear all from there."""
    if count and isinstance(sys.stdout, _Guarded):
        sys.stdout.erase(count)


class LineFormatter(logging.Formatter):
    """Makes one line of each message, so that a file name with a line break cannot write a message of its own. The
    traceback that follows an unforeseen error keeps its lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return shown(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:
        return shown(super().formatException(ei), keep="\n")


class _Guarded(io.TextIOBase):
    """A stream of text in front of another. It can be asked all that the programs behind `print` ask of one."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        safe = shown(text, keep=_LAYOUT)
        try:
            self._stream.write(safe)
        except UnicodeEncodeError:  # a terminal that is not set to UTF-8
            self._stream.write(safe.encode("ascii", "backslashreplace").decode("ascii"))
        return len(text)

    def erase(self, lines: int) -> None:
        self._stream.write(f"\x1b[{lines}F\x1b[J")

    def flush(self) -> None:
        self._stream.flush()

    def isatty(self) -> bool:
        return self._stream.isatty()

    def fileno(self) -> int:
        return self._stream.fileno()
