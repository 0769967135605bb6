"""A page that needs nothing else: no network, no script, in the colours that the reader's machine has."""

import base64
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path

from edgevpr.core.text import shown

# The browser is told to load nothing from anywhere, whatever a foreign name looks like.
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


def page(title: str, style: str, body: str) -> str:
    """Return a whole page. `style` is what it needs beside the style that all pages have; `body` is HTML."""
    common = Path(__file__).with_name("common.css").read_text("utf-8")
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark"><link rel="icon" href="data:,">'
        f"<title>{foreign(title)}</title><style>{common}{style}</style></head>\n<body>{body}</body></html>\n"
    )


def foreign(said: str) -> str:
    """Return foreign text fit for a page."""
    return escape(shown(said))


def section(title: str, content: str) -> str:
    """Return a section, "" where it has no content. `title` and `content` are HTML."""
    if not content:
        return ""
    return f"<section>{f'<h2>{title}</h2>' if title else ''}{content}</section>\n"


def table(headings: Sequence[str], rows: Sequence[Sequence[str]], cell: Callable[[str], str] = foreign) -> str:
    """Return a table that scrolls where there is no room for it. `cell` makes HTML of what stands in a cell."""
    head = "".join(f"<th>{each}</th>" for each in headings)
    lines = "".join(f"<tr>{''.join(f'<td>{cell(each)}</td>' for each in row)}</tr>" for row in rows)
    return f'<div class="scroll"><table><tr>{head}</tr>{lines}</table></div>'


def address_of(jpeg: bytes) -> str:
    """Return a picture as an address that holds all of it (data:)."""
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()
