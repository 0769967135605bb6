"""Text for people and programs: what is foreign made fit to be shown, tables, lines of JSON, progress, and the check
that a picture of figures can be drawn."""

import json
import logging
import math
import os
import re
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, is_dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, TypeVar

from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.files import require_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

T = TypeVar("T")
# user:password@ of an address. A password may hold `@` and, wrongly, `/`: all up to the last @ of the word is left out.
# An address that was taken for a path has one `/` only.
_PASSWORD = re.compile(r"(\w:/{1,2}[^\s/:@]*):\S*@")
# Cameras take their secrets in the query of an address, too.
_SECRET = re.compile(r"(?i)([?&](?:password|passwd|passwort|pass|pwd|token|secret|api_?key|key|auth)=)[^&\s#]*")
_COLUMNS, _TERMINAL_COLUMNS = 120, 79
_SOON_S = 10.0  # less is not worth a word, and too short to judge by
_PICTURE_ENDINGS = (".png", ".pdf", ".svg")


def printable(text: str, keep: str = "") -> str:
    """Escape what a terminal would act on or cannot show: control characters, line breaks, marks that turn the
    direction of writing, bytes that are not UTF-8. The characters in `keep` stay."""
    if text.isprintable():  # false for all of these
        return text
    return "".join(char if char.isprintable() or char in keep else _escape(char) for char in text)


def _escape(char: str) -> str:
    if "\udc80" <= char <= "\udcff":  # a byte that is not UTF-8, as Python hands it over
        return f"\\x{ord(char) - 0xDC00:02x}"
    return char.encode("unicode_escape").decode("ascii")


def without_passwords(text: str) -> str:
    """Replace the passwords of the addresses in a text: rtsp://user:***@host/path."""
    if ":/" not in text:
        return text
    return _SECRET.sub(r"\1***", _PASSWORD.sub(r"\1:***@", text))


def shown(text: str, keep: str = "") -> str:
    """Return a text as every message shows it: without passwords, and printable."""
    return printable(without_passwords(text), keep)


def decoded_name(name: str) -> str:
    """Return the name of a file as UTF-8 can hold it: bytes that are not UTF-8 become \\xNN."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def meant(name: str, known: Iterable[str], otherwise: str) -> str:
    """Ask whether the most similar of the `known` names was meant; `otherwise` where none is similar."""
    near = get_close_matches(name, list(known), n=1)
    return f"did you mean `{near[0]}`?" if near else otherwise


def aligned(rows: Sequence[Sequence[str]], left: int = 1) -> list[str]:
    """Lay out rows in columns, one line for each row. The first `left` columns are flush left, the others flush right.
    A short row ends early."""
    columns = range(max(len(row) for row in rows))
    widths = [max(len(row[column]) for row in rows if column < len(row)) for column in columns]
    return [
        "  ".join(
            cell.ljust(width) if column < left else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=False))
        ).rstrip()
        for row in rows
    ]


def markdown(headings: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """Return a Markdown table: the first `left` columns flush left, the others flush right."""
    ruler = ["---"] * left + ["---:"] * (len(headings) - left)
    return "\n".join("| " + " | ".join(line) + " |" for line in (headings, ruler, *rows))


def wrapped(text: str) -> list[str]:
    """Break a sentence into lines of at most 120 columns, between words only."""
    return textwrap.wrap(text, _COLUMNS, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def json_line(value: Any) -> bytes:
    """Write a value as one line of JSON, without passwords. Dataclasses become objects, NaN and infinities null."""
    text = json.dumps(_plain(value), ensure_ascii=False, allow_nan=False)
    # Text that is not UTF-8 (a foreign file name) becomes a \u escape, which JSON reads back unchanged.
    return text.encode("utf-8", "backslashreplace") + b"\n"


def _plain(value: Any) -> Any:
    """Return `value` in JSON's types. Numbers are rounded to seven decimals (a centimetre of latitude, and what MAVLink
    carries) or seven digits, whichever is more."""
    if isinstance(value, str):
        return without_passwords(value)
    if value is None or isinstance(value, (bool, int)):
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            return None
        return round(value, 7) if abs(value) >= 1 else float(f"{value:.7g}")
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    if hasattr(value, "tolist"):  # NumPy's scalars and arrays
        return _plain(value.tolist())
    return without_passwords(str(value))


def progress(
    iterable: Iterable[T],
    total: int,
    label: str,
    stream: TextIO | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[T]:
    """Yield the items of `iterable`; write to `stream` (None: stderr) how many of `total` (0: unknown) are done, and
    how long the others will take if they take as long. On a terminal one line is redrawn; elsewhere a line is written
    for every tenth of the work."""
    stream = stream or sys.stderr
    terminal = stream.isatty()
    last_step, width, began_s = None, 0, clock()
    for done, item in enumerate(iterable, start=1):
        yield item
        if total:
            percent = 100 * done // total
            step = percent if terminal else percent // 10
            text = f"{label}  {done}/{total}  {percent} %" + _time_left(clock() - began_s, done, total)
        else:
            step, text = done // (1 if terminal else 100), f"{label}  {done}"
        if step != last_step:
            last_step = step
            # The cursor goes back to the start of the line, so that an error message is written over it.
            stream.write(f"{text:<{width}}\r" if terminal else f"{text}\n")
            width = len(text)
            stream.flush()
    if terminal and last_step is not None:
        stream.write("\n")


def _time_left(passed_s: float, done: int, total: int) -> str:
    left_s = passed_s / done * (total - done)
    if min(passed_s, left_s) < _SOON_S:
        return ""
    return f", {left_s:.0f} s left" if left_s < 100 else f", {left_s / 60:.0f} min left"


def waiting(text: str, stream: TextIO | None = None) -> None:
    """Show on a terminal what is waited for, in a line that the next call replaces; "" clears it. Elsewhere nothing is
    written: the result says what came of it."""
    stream = stream or sys.stderr
    if stream.isatty():
        stream.write(f"{text[:_TERMINAL_COLUMNS]:<{_TERMINAL_COLUMNS}}\r")
        stream.flush()


def require_picture(path: Path) -> None:
    """Check that a picture of figures can be written to `path`, before the work and not after it.

    Raises UsageError for a wrong file name or a missing folder, EdgevprError where matplotlib is missing.
    """
    if path.suffix.lower() not in _PICTURE_ENDINGS:
        raise UsageError(f"{path}: a picture's name ends in {', '.join(_PICTURE_ENDINGS)}: choose one of these.")
    require_folder(path)
    try:
        figure(1.0, 1.0)
    except ImportError as error:
        raise EdgevprError(f'{error}: pictures need matplotlib; pip install "edgevpr[plots]".') from error


def figure(width_in: float, height_in: float) -> "Figure":
    """Make an empty matplotlib figure; sizes in inches."""
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # its messages about fonts are of no use to the user
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")
