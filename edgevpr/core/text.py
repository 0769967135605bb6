"""Text of foreign origin made fit to be shown: control characters escaped, passwords left out, and names that are
not known answered by those that are."""

import os
import re
from collections.abc import Iterable
from difflib import get_close_matches

# user:password@ of an address. A password may hold `@` and, wrongly, `/`: all up to the last @ of the word is left out.
# An address that was taken for a path has one `/` only.
_PASSWORD = re.compile(r"(\w:/{1,2}[^\s/:@]*):\S*@")
# Cameras take their secrets in the query of an address, too.
_SECRET = re.compile(r"(?i)([?&](?:password|passwd|passwort|pass|pwd|token|secret|api_?key|key|auth)=)[^&\s#]*")


def printable(text: str, keep: str = "") -> str:
    """Escape what a terminal would act on or cannot show: control characters, line breaks, marks that turn the
    direction of writing, bytes that are not UTF-8. The characters in `keep` stay."""
    if text.isprintable():  # false for all of these
        return text
    return "".join(each if each.isprintable() or each in keep else _escape(each) for each in text)


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


def _escape(each: str) -> str:
    if "\udc80" <= each <= "\udcff":  # a byte that is not UTF-8, as Python hands it over
        return f"\\x{ord(each) - 0xDC00:02x}"
    return each.encode("unicode_escape").decode("ascii")
