"""Progress of a long loop: one line that is redrawn on a terminal, elsewhere a line for every tenth of the work."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import TextIO, TypeVar

T = TypeVar("T")
_LINE = 79
_SOON_S = 10.0  # less is not worth a word, and too short to judge by


def progress(
    iterable: Iterable[T],
    total: int,
    label: str,
    stream: TextIO | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[T]:
    """Yield the items of `iterable`; write to `stream` (None: stderr) how many of `total` (0: unknown) are done, and
    how long the others will take if they take as long."""
    stream = stream or sys.stderr
    terminal = stream.isatty()
    shown, wide, began_s = None, 0, clock()
    for done, item in enumerate(iterable, start=1):
        yield item
        if total:
            percent = 100 * done // total
            step, text = percent if terminal else percent // 10, f"{label}  {done}/{total}  {percent} %"
            text += _left(clock() - began_s, done, total)
        else:
            step, text = done // (1 if terminal else 100), f"{label}  {done}"
        if step != shown:
            shown = step
            # The cursor goes back to the start of the line, so that an error message is written over it.
            stream.write(f"{text:<{wide}}\r" if terminal else f"{text}\n")
            wide = len(text)
            stream.flush()
    if terminal and shown is not None:
        stream.write("\n")


def _left(passed_s: float, done: int, total: int) -> str:
    left_s = passed_s / done * (total - done)
    if min(passed_s, left_s) < _SOON_S:
        return ""
    return f", {left_s:.0f} s left" if left_s < 100 else f", {left_s / 60:.0f} min left"


def waiting(text: str, stream: TextIO | None = None) -> None:
    """Show on a terminal what is waited for, in a line that the next call replaces; "" clears it. Elsewhere nothing is
    written: the result says what came of it."""
    stream = stream or sys.stderr
    if stream.isatty():
        stream.write(f"{text[:_LINE]:<{_LINE}}\r")
        stream.flush()
