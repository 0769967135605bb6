"""Text output of all commands: escaping of untrusted text, tables, JSON lines, and progress."""

import json
import logging
import math
import os
import re
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from difflib import get_close_matches
from enum import Enum
from itertools import zip_longest
from threading import Event, Thread
from typing import Any, TextIO, TypeVar

T = TypeVar("T")
# Called with items, their number (0: unknown) and a label; yields the items unchanged and shows progress.
Progress = Callable[[Iterable[Any], int, str], Iterable[Any]]
# user:password@ in an address. A password may contain `@` and, although invalid, `/`: everything up to the last @ of
# the word is replaced. An address that was handled as a path has only one `/` after the colon.
_PASSWORD = re.compile(r"(\w:/{1,2}[^\s/:@]*):\S*@")
# Passwords and keys in the query part of an address, such as ?token=abc; cameras use these too.
_SECRET = re.compile(r"(?i)([?&](?:password|passwd|passwort|pass|pwd|token|secret|api_?key|key|auth)=)[^&\s#]*")
_LINE_COLUMNS = 120
_TERMINAL_COLUMNS = 79
_MAX_P_WRONG_AS_ODDS = 1e-3  # smaller error probabilities are shown as odds, because they would look equal in per cent
_MIN_P_WRONG = 1e-6
_MAX_SILENCE_S = 5.0  # a progress line is written at least this often
_MIN_ESTIMATE_S = 10.0  # the remaining time is shown only if it and the time since the start are at least this long


def escape_unprintable(text: str, keep: str = "") -> str:
    """Escape characters that a terminal interprets or cannot show: control characters, line breaks, marks that change
    the writing direction, bytes that are not UTF-8. The characters in `keep` are left unchanged."""
    if text.isprintable():  # False if the text has any such character
        return text
    return "".join(char if char.isprintable() or char in keep else _escape_character(char) for char in text)


def _escape_character(character: str) -> str:
    if "\udc80" <= character <= "\udcff":  # Python's surrogate for a byte that is not UTF-8
        return f"\\x{ord(character) - 0xDC00:02x}"
    return character.encode("unicode_escape").decode("ascii")


def redact_passwords(text: str) -> str:
    """Replace passwords and keys in the addresses in a text with ***: rtsp://user:***@host/path?token=***."""
    return text if ":/" not in text else _SECRET.sub(r"\1***", _PASSWORD.sub(r"\1:***@", text))


def sanitize(text: str, keep: str = "") -> str:
    """Make a text safe for messages: apply `redact_passwords` and `escape_unprintable`, which explains `keep`."""
    return escape_unprintable(redact_passwords(text), keep)


def decode_name(name: str) -> str:
    """Return a file name as valid UTF-8 text: bytes that are not UTF-8 become \\xNN."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def suggest(name: str, names: Iterable[str], otherwise: str) -> str:
    """Return "did you mean `X`?" with the member of `names` most similar to `name`; `otherwise` if none is similar."""
    matches = get_close_matches(name, list(names), n=1)
    return f"did you mean `{matches[0]}`?" if matches else otherwise


def align_table(rows: Sequence[Sequence[str]], left: int = 1) -> list[str]:
    """Format rows of cells as a table, one line per row. The first `left` columns are left-aligned."""
    widths = [max(map(len, cells)) for cells in zip_longest(*rows, fillvalue="")]
    lines = ([f"{cell:{'<' if i < left else '>'}{widths[i]}}" for i, cell in enumerate(row)] for row in rows)
    return ["  ".join(line).rstrip() for line in lines]


def wrap_sentence(text: str) -> list[str]:
    """Break a sentence into lines of at most 120 columns, between words only."""
    return textwrap.wrap(text, _LINE_COLUMNS, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def format_json_line(value: Any) -> bytes:
    """Encode a value as one line of JSON, without passwords. Enum members become names, NaN and infinities null."""
    text = json.dumps(_to_json(value), ensure_ascii=False, allow_nan=False)
    # Text that is not UTF-8 (a file name) becomes a \u escape, which JSON reads back unchanged.
    return text.encode("utf-8", "backslashreplace") + b"\n"


def _to_json(value: Any) -> Any:
    """Convert `value` to JSON types. Numbers keep 7 decimals (1 cm of latitude) or, below 1, 7 significant digits."""
    if isinstance(value, str):
        return redact_passwords(value)
    if value is None or isinstance(value, (bool, int)):
        return value
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, float):
        if not math.isfinite(value):
            return None
        return round(value, 7) if abs(value) >= 1 else float(f"{value:.7g}")
    if isinstance(value, dict):
        return {str(key): _to_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_to_json(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return _to_json(asdict(value))
    if hasattr(value, "tolist"):  # NumPy scalars and arrays
        return _to_json(value.tolist())
    return redact_passwords(str(value))


def is_quiet() -> bool:
    """Return True if edgevpr logs only warnings; it then shows no progress either."""
    return logging.getLogger("edgevpr").level > logging.INFO


def progress(
    iterable: Iterable[T],
    total: int,
    label: str,
    stream: TextIO | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[T]:
    """Yield the items of `iterable` and write progress to `stream` (None: stderr): `label`, how many of `total` (0:
    unknown) are done, and the estimated remaining time. On a terminal the line is redrawn. Elsewhere a new line is
    written for every tenth of the work (every 100 items if the total is unknown), and at least every 5 s."""
    if is_quiet():
        yield from iterable
        return
    stream = stream or sys.stderr
    is_terminal = stream.isatty()
    last_step, width, began_s = None, 0, clock()
    last_s = began_s
    for done, item in enumerate(iterable, start=1):
        yield item
        if total:
            percent = 100 * done // total
            step = percent if is_terminal else percent // 10
            text = f"{label}  {done}/{total}  {percent} %" + _format_time_left(clock() - began_s, done, total)
        else:
            step, text = done // (1 if is_terminal else 100), f"{label}  {done}"
        if step != last_step or clock() - last_s >= _MAX_SILENCE_S:
            last_step, last_s = step, clock()
            # The cursor returns to the start of the line, so an error message overwrites it.
            stream.write(f"{text:<{width}}\r" if is_terminal else f"{text}\n")
            width = len(text)
            stream.flush()
    if is_terminal and last_step is not None:
        stream.write("\n")


def iterate_silently(items: Iterable[Any], total: int, label: str) -> Iterable[Any]:
    """Return `items` unchanged: a `Progress` that shows nothing."""
    return items


@contextmanager
def show_elapsed(text: str) -> Iterator[None]:
    """Write `text` and the elapsed seconds to stderr every 5 s until the `with` block ends."""
    stream, ended, began_s = sys.stderr, Event(), time.monotonic()

    def report() -> None:
        while not (is_quiet() or ended.wait(_MAX_SILENCE_S)):
            print(f"{text}, {time.monotonic() - began_s:.0f} s so far", file=stream, flush=True)

    reporter = Thread(target=report, daemon=True)
    reporter.start()
    try:
        yield
    finally:
        ended.set()
        reporter.join()


def _format_time_left(elapsed_s: float, done: int, total: int) -> str:
    left_s = elapsed_s / done * (total - done)
    if min(elapsed_s, left_s) < _MIN_ESTIMATE_S:
        return ""
    return f", {left_s:.0f} s left" if left_s < 100 else f", {left_s / 60:.0f} min left"


def show_progress(text: str, stream: TextIO | None = None) -> None:
    """Show on a terminal what the program is doing, on a line that the next call replaces; "" clears it."""
    stream = stream or sys.stderr
    if stream.isatty():
        stream.write(f"{text[:_TERMINAL_COLUMNS]:<{_TERMINAL_COLUMNS}}\r")
        stream.flush()


def format_probability(probability: float) -> str:
    """Format the probability of being right: "98.1 %" or, from 99.9 %, "1 in 3,000 wrong" (at most 1 in 1,000,000)."""
    p_wrong = max(1 - probability, _MIN_P_WRONG)
    if not p_wrong <= _MAX_P_WRONG_AS_ODDS:  # NaN as well
        return f"{100 * probability:.1f} %"
    return f"1 in {float(f'{1 / p_wrong:.1g}'):,.0f} wrong"


def format_offset(east_m: float, north_m: float) -> str:
    """Format an offset on the ground: "3.1 m east and 1.2 m south"."""
    east_west, north_south = "east" if east_m > 0 else "west", "north" if north_m > 0 else "south"
    return f"{abs(east_m):.1f} m {east_west} and {abs(north_m):.1f} m {north_south}"
