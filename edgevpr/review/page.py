"""The report of a flight (`edgevpr report`): one HTML page with its pictures inside, without network or script.

Functions that return a str return HTML.
"""

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from html import escape
from itertools import product
from pathlib import Path
from statistics import median
from types import MappingProxyType

from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.text import shown
from edgevpr.review.html import foreign, heading, notes, page, picture, section, table
from edgevpr.review.logged import FixOutcome, LoggedFlight, LoggedQuery, text, value
from edgevpr.review.moments import WorstMoment, worst
from edgevpr.review.overhead import MapGround, draw, layers_of
from edgevpr.review.svg import UNKNOWN, Points, Series, clock, figure, lanes, time_chart

_MOST_REMARKS = 200
_NUMBER = re.compile(r"\d+(\.\d+)?")
_COLOURS = {
    FixOutcome.TAKEN: "taken",
    FixOutcome.REFUSED: "refused",
    FixOutcome.UNANSWERED: "unanswered",
    FixOutcome.CONTINUOUS: "taken",
    FixOutcome.KEPT: "places",
}
_CHARTS = (
    ("CPU", "cores busy", "cores", "accepted"),
    ("RAM", "MB", "rss_mb", "accepted"),
    ("Charge", "mAh", "used_mah", "accepted"),
    ("Temperature", "°C", "temperature_c", "refused"),
    ("A query", "ms, encode and match", "wall_ms", "accepted"),
    ("Age of the newest picture", "ms", "latency_ms", "accepted"),
)


class Album:
    """Finds pictures by the names that the log gives them: in `recorded`, the frames of a recording by name, else as
    files in `folders`. The flight and the map have an album each, since their pictures often have equal names. Raises
    UsageError for a folder that does not exist."""

    def __init__(self, folders: Sequence[str | Path], recorded: Mapping[str, Path] = MappingProxyType({})) -> None:
        self._recorded = recorded
        self._folders = [Path(folder).resolve() for folder in folders]
        for given, folder in zip(folders, self._folders, strict=True):
            if not folder.is_dir():
                raise UsageError(f"{given}: there is no such folder: give one that holds pictures.")

    def picture(self, name: str | None) -> bytes | None:
        """Return the picture `name` as a small JPEG; None if there is none that can be read."""
        if not name or not (self._folders or name in self._recorded):
            return None
        from edgevpr.frames.images import EXTENSIONS, read_image, small_jpeg  # a page without pictures needs no OpenCV

        if path := self._recorded.get(name):
            with suppress(ImageError):
                return small_jpeg(read_image(path))
        for folder, ending in product(self._folders, ("", *EXTENSIONS)):
            with suppress(ImageError, OSError, ValueError):  # no picture, or a name that no file can have
                path = (folder / f"{name}{ending}").resolve()
                # A log from somebody else may name any file of this machine: show only files in the folder.
                if path.is_relative_to(folder) and path.is_file():
                    return small_jpeg(read_image(path))
        return None


def page_of(flight: LoggedFlight, ground: MapGround, frames: Album, references: Album) -> str:
    """Return the whole page. `frames` finds the pictures of the flight, `references` those that the map was made of."""
    moments = worst(flight)
    named = [
        (str(number), where)
        for number, moment in enumerate(moments, start=1)
        if (where := moment.query.at or moment.query.autopilot_at or moment.query.gps_at)
    ]
    shown = [_moment(number, moment, frames, references) for number, moment in enumerate(moments, start=1)]
    title = _title(flight)
    body = [
        heading(title, _known(flight)),
        section("", _figures(flight)),
        notes(_notes(flight, ground)),
        section("Over the ground", draw(ground, layers_of(flight), named)),
        section("What became of every query", _lanes(flight)),
        section("Over time", _charts(flight)),
        section("Worst moments", "".join(shown)),
        section("Why matches were refused", _counts(_refusals(flight))),
        section("Why fixes were not sent, or not taken", _counts(_objections(flight))),
        section("What was said", _remarks(flight)),
        section("How it was set", _settings(flight)),
    ]
    return page(title, Path(__file__).with_name("page.css"), body)


def _title(flight: LoggedFlight) -> str:
    time = text(flight.start, "time") or next((each.time for each in flight.queries), "")
    return f"Flight of {time[:16].replace('T', ' ')} UTC" if time else "Flight at an unknown time"


def _known(flight: LoggedFlight) -> Iterator[str]:
    yield f"{clock(flight.span_s)} long"
    for name, known in (
        ("map", flight.map_path),
        ("technique", text(flight.start, "technique")),
        ("board", text(flight.start, "board")),
        ("edgevpr", text(flight.start, "version")),
    ):
        if known:
            yield f"{name} {known}"
    yield str(flight.path)


def _figures(flight: LoggedFlight) -> str:
    queries = flight.queries
    outcomes = Counter(query.fix.outcome for query in queries if query.fix)
    sent = sum(outcomes[outcome] for outcome in (FixOutcome.TAKEN, FixOutcome.REFUSED, FixOutcome.UNANSWERED))
    accepted = sum(query.accepted for query in queries)
    off_m, wall_ms = _all(queries, "off_m"), _all(queries, "wall_ms")
    figures = {
        "queries": str(len(queries)),
        "accepted": str(accepted),
        "fixes sent": str(sent),
        "fixes taken": str(outcomes[FixOutcome.TAKEN]),
        "fixes refused": str(outcomes[FixOutcome.REFUSED]),
        "fixes not answered": str(outcomes[FixOutcome.UNANSWERED]),
        "in continuous position": str(outcomes[FixOutcome.CONTINUOUS] or UNKNOWN),
        "from GPS, median": figure(median(off_m) if off_m else None, "m"),
        "from GPS, most": figure(max(off_m, default=None), "m"),
        "charge": figure(max(_all(queries, "used_mah"), default=None), "mAh"),
        "RAM, most": figure(max(_all(queries, "rss_mb"), default=None), "MB"),
        "a query, median": figure(median(wall_ms) if wall_ms else None, "ms"),
        "hottest": figure(max(_all(queries, "temperature_c"), default=None), "°C"),
    }
    more = {"accepted": f"{accepted / len(queries):.0%}"} if queries else {}
    tiles = "".join(
        f"<div><dt>{name}</dt><dd>{known} <small>{more.get(name, '')}</small></dd></div>"
        for name, known in figures.items()
        if known != UNKNOWN
    )
    return f'<dl class="figures">{tiles}</dl>'


def _notes(flight: LoggedFlight, ground: MapGround) -> Iterator[str]:
    queries = flight.queries
    if not flight.start:
        yield "The log lacks the first line of this flight: how it was set is not known."
    if not flight.end:
        yield "The log of this flight has no last line: it was cut off (power, full disk), or the flight still goes on."
    if not queries:
        yield "No picture became a query in this flight: there is nothing to show of one."
    else:
        if not any(query.accepted for query in queries):
            yield "No match was accepted in this flight."
        if not ground.at and not any(query.place_at for query in queries):
            yield "No place has a position: nothing can be drawn over ground, and no fix was sent."
        if not any(query.has_link for query in queries):
            yield (
                "The log has no report of the autopilot's position: its track and the distance from GPS are not known."
            )
    if ground.trouble:
        yield ground.trouble
    if nowhere := ground.places - len(ground.at):
        yield f"{nowhere} of {ground.places} places of the map have no position and are not drawn."


def _lanes(flight: LoggedFlight) -> str:
    queries = flight.queries
    heard = [query.t_s for query in queries if query.has_link]
    rows = [
        ("match accepted", "accepted", [query.t_s for query in queries if query.accepted]),
        ("match refused", "refused", [query.t_s for query in queries if not query.accepted]),
        ("frame not usable", "unusable", flight.unusable),
        *(
            (outcome.value, colour, [query.t_s for query in queries if query.fix and query.fix.outcome is outcome])
            for outcome, colour in _COLOURS.items()
        ),
        ("autopilot heard", "autopilot", heard),
        ("autopilot silent", "refused", [query.t_s for query in queries if heard and query.has_link is False]),
    ]
    rows = [row for row in rows if row[2]]
    return lanes(rows, flight.span_s) if rows else ""


def _charts(flight: LoggedFlight) -> str:
    queries, span_s = flight.queries, flight.span_s
    accepted = [query for query in queries if query.accepted]
    refused = [query for query in queries if not query.accepted]
    confidences = [
        Series("accepted", "accepted", _over(accepted, "confidence"), are_dots=True),
        Series("refused", "refused", _over(refused, "confidence"), are_dots=True),
    ]
    positions = [
        Series("from GPS", "gps", _over(queries, "off_m"), are_dots=True),
        Series("accuracy, 1 sigma", "accepted", _over(queries, "accuracy_m")),
    ]
    answered = [
        (query.t_s, query.fix.latency_ms) for query in queries if query.fix and query.fix.latency_ms is not None
    ]
    charts = [
        time_chart("Confidence", "", confidences, span_s, top=1.0),
        time_chart("Position", "m", positions, span_s),
        *(
            time_chart(title, unit, [Series("", colour, _over(queries, field))], span_s)
            for title, unit, field, colour in _CHARTS
        ),
        time_chart("Answer to a fix", "ms", [Series("", "taken", answered, are_dots=True)], span_s),
    ]
    return f'<div class="charts">{"".join(charts)}</div>' if any(charts) else ""


def _over(queries: Sequence[LoggedQuery], field: str) -> Points:
    return [(query.t_s, known) for query in queries if (known := getattr(query, field)) is not None]


def _all(queries: Sequence[LoggedQuery], field: str) -> list[float]:
    return [known for _, known in _over(queries, field)]


def _moment(number: int, moment: WorstMoment, frames: Album, references: Album) -> str:
    query = moment.query
    found = "no place was found"
    if query.place is not None:
        found = f"place {query.place} ({query.reference_image or 'without a name'}), score {figure(query.score)}"
    sure = "" if query.confidence is None else f", confidence {query.confidence:.4f}"
    pictures = [("seen", query.name, frames), ("place found", query.reference_image, references)]
    pair = "".join(
        picture(name, f"{what}: {name}", jpeg)
        for what, name, album in pictures
        if name and (jpeg := album.picture(name))
    )
    return (
        f'<div class="moment" id="moment-{number}"><h3><i>{number}</i>{clock(query.t_s)} – {foreign(moment.why)}</h3>'
        f'<p class="soft">{foreign(query.name)}: {foreign(found + sure)}; '
        f"{'accepted' if query.accepted else 'refused'}: {foreign(query.reason)}</p>"
        + (f'<div class="pair">{pair}</div></div>' if pair else "</div>")
    )


def _refusals(flight: LoggedFlight) -> Iterator[str]:
    return (query.reason.partition(":")[0] for query in flight.queries if not query.accepted)


def _objections(flight: LoggedFlight) -> Iterator[str]:
    for query in flight.queries:
        if query.fix and query.fix.why and query.fix.outcome is not FixOutcome.CONTINUOUS:
            yield f"{query.fix.outcome.value}: {query.fix.why}"


def _counts(reasons: Iterable[str]) -> str:
    """Return a table of how often each reason was given. Numbers in reasons become "…", so that equal ones count
    together."""
    counted = Counter(_NUMBER.sub("…", reason) for reason in reasons)
    return table(("times", "why"), [(str(count), why) for why, count in counted.most_common(20)]) if counted else ""


def _remarks(flight: LoggedFlight) -> str:
    remarks = flight.remarks[:_MOST_REMARKS]
    if not remarks:
        return ""
    more = len(flight.remarks) - len(remarks)
    rows = [(clock(each.t_s), each.kind, each.said) for each in remarks]
    left_out = f'<p class="soft">and {more} more lines</p>' if more else ""
    return table(("time", "of", "said"), rows) + left_out


def _settings(flight: LoggedFlight) -> str:
    reason = text(flight.start, "decided", "reason")
    config = value(flight.start, "config")
    if not isinstance(config, dict):
        return ""
    said = f"<p>{foreign(reason)}</p>" if reason else ""
    dumped = escape(shown(json.dumps(config, indent=1, ensure_ascii=False), keep="\n"))
    return f"{said}<details><summary>configuration</summary><pre>{dumped}</pre></details>"
