"""Progress of a long loop: one line that is redrawn on a terminal, elsewhere a line for every tenth of the work."""

import sys
from collections.abc import Iterable, Iterator
from typing import TextIO, TypeVar

T = TypeVar("T")
_LINE = 79


def progress(iterable: Iterable[T], total: int, label: str, stream: TextIO | None = None) -> Iterator[T]:
    """Yield the items of `iterable`; write to `stream` (None: stderr) how many of `total` (0: unknown) are done."""
    stream = stream or sys.stderr
    terminal = stream.isatty()
    shown = None
    for done, item in enumerate(iterable, start=1):
        yield item
        if total:
            percent = 100 * done // total
            step, text = percent if terminal else percent // 10, f"{label}  {done}/{total}  {percent} %"
        else:
            step, text = done // (1 if terminal else 100), f"{label}  {done}"
        if step != shown:
            shown = step
            # The cursor goes back to the start of the line, so that an error message is written over it.
            stream.write(text + ("\r" if terminal else "\n"))
            stream.flush()
    if terminal and shown is not None:
        stream.write("\n")


def waiting(text: str, stream: TextIO | None = None) -> None:
    """Show on a terminal what is waited for, in a line that the next call replaces; "" clears it. Elsewhere nothing is
    written: the result says what came of it."""
    stream = stream or sys.stderr
    if stream.isatty():
        stream.write(f"{text[:_LINE]:<{_LINE}}\r")
        stream.flush()
