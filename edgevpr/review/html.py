"""Parts of HTML pages that need no network and no script, in the light or dark colours that the reader has chosen.

The reports of flights (`review.page`) and of evaluations (`lab.evaluate.page`) are made of them.
"""

import base64
from collections.abc import Callable, Iterable, Sequence
from html import escape
from pathlib import Path

from edgevpr.core.text import shown

# Content security policy: the browser loads nothing from anywhere, even if a file name in the page contains HTML.
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


def page(title: str, style: Path, body: Iterable[str]) -> str:
    """Return a whole page. `style` is a CSS file that is added to the style of all pages; `body` is HTML."""
    common = Path(__file__).with_name("common.css").read_text("utf-8")
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark"><link rel="icon" href="data:,">'
        f"<title>{foreign(title)}</title><style>{common}{style.read_text('utf-8')}</style></head>\n"
        f"<body>{''.join(body)}</body></html>\n"
    )


def foreign(text: str) -> str:
    """Return `text`, which may come from anywhere, as HTML: escaped, without passwords and control characters."""
    return escape(shown(text))


def heading(title: str, known: Iterable[str]) -> str:
    """Return the title of a page, and below it the texts `known`, separated by commas."""
    return f'<h1>{foreign(title)}</h1><p class="soft">{foreign(", ".join(known))}</p>'


def section(title: str, content: str) -> str:
    """Return a section; "" if `content` is empty. `title` (may be empty) and `content` are HTML."""
    if not content:
        return ""
    return f"<section>{f'<h2>{title}</h2>' if title else ''}{content}</section>\n"


def notes(sentences: Iterable[str]) -> str:
    """Return a box with a list of `sentences` that a reader must know; "" if there are none."""
    items = "".join(f"<li>{foreign(sentence)}</li>" for sentence in sentences)
    return f'<section class="notes"><ul>{items}</ul></section>' if items else ""


def table(headings: Sequence[str], rows: Sequence[Sequence[str]], cell: Callable[[str], str] = foreign) -> str:
    """Return a table, which scrolls sideways on a narrow screen. `cell` turns the text of each cell into HTML."""
    head = "".join(f"<th>{text}</th>" for text in headings)
    lines = "".join(f"<tr>{''.join(f'<td>{cell(text)}</td>' for text in row)}</tr>" for row in rows)
    return f'<div class="scroll"><table><tr>{head}</tr>{lines}</table></div>'


def picture(name: str, caption: str, jpeg: bytes) -> str:
    """Return a picture with a caption. The JPEG is stored inside the page, as a data: address."""
    data = base64.b64encode(jpeg).decode()
    return (
        f'<figure><img alt="{foreign(name)}" src="data:image/jpeg;base64,{data}">'
        f"<figcaption>{foreign(caption)}</figcaption></figure>"
    )
