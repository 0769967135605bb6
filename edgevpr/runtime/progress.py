"""Progress of a long loop: one line that is redrawn on a terminal, a line for every tenth elsewhere."""

import sys
from collections.abc import Iterable, Iterator
from typing import TextIO, TypeVar

T = TypeVar("T")


def progress(iterable: Iterable[T], total: int, label: str, stream: TextIO | None = None) -> Iterator[T]:
    """Yield what `iterable` yields, and say on `stream` (None: stderr) how many of `total` are done."""
    stream = stream or sys.stderr
    terminal = stream.isatty()
    shown = None
    for done, item in enumerate(iterable, start=1):
        yield item
        percent = 100 * done // max(total, 1)
        step = percent if terminal else percent // 10
        if step != shown:
            shown = step
            # The cursor goes back to the start of the line, so that an error message is written over it.
            stream.write(f"{label}  {done}/{total}  {percent} %" + ("\r" if terminal else "\n"))
            stream.flush()
    if terminal and shown is not None:
        stream.write("\n")
