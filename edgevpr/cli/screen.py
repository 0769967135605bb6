"""Guards the output of all commands: removes passwords, and control characters that a terminal would interpret."""

import io
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import TextIO

from edgevpr.core.text import sanitize

_LAYOUT_CHARACTERS = "\n\r\t"  # control characters that are kept: tables and progress lines need them


@contextmanager
def guard_output() -> Iterator[None]:
    """Context manager that passes everything written to stdout and stderr through `core.text.sanitize`."""
    with redirect_stdout(_GuardedStream(sys.stdout)), redirect_stderr(_GuardedStream(sys.stderr)):
        yield


class LineFormatter(logging.Formatter):
    """Formats each log message as one line, so a file name with a line break cannot fake a second message."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return sanitize(super().formatMessage(record))


class _GuardedStream(io.TextIOBase):
    """Text stream for `print` and progress lines that passes all text through `sanitize` to `stream`."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        safe = sanitize(text, keep=_LAYOUT_CHARACTERS)
        try:
            self._stream.write(safe)
        except UnicodeEncodeError:  # a terminal that is not set to UTF-8
            self._stream.write(safe.encode("ascii", "backslashreplace").decode("ascii"))
        return len(text)

    def flush(self) -> None:
        self._stream.flush()

    def isatty(self) -> bool:
        return self._stream.isatty()

    def fileno(self) -> int:
        return self._stream.fileno()
