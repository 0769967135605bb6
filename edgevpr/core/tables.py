"""Tables as plain text for a terminal and as Markdown for a page, and text wrapped to 120 columns."""

import textwrap
from collections.abc import Sequence

_WIDTH = 120


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
    return textwrap.wrap(text, _WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
