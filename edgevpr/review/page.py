"""The report of a flight (`edgevpr report`): one HTML page with its pictures inside, without network or script.

Functions that return a str return HTML.
"""

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from html import escape
from itertools import groupby, product
from pathlib import Path
from statistics import median
from types import MappingProxyType

from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.text import nines, shown
from edgevpr.review.html import (
    UNKNOWN,
    Points,
    Series,
    chart,
    clock,
    figure,
    foreign,
    heading,
    lanes,
    notes,
    page,
    picture,
    section,
    table,
    times,
)
from edgevpr.review.logged import FixOutcome, LoggedFlight, LoggedQuery, text, value
from edgevpr.review.overhead import MapGround, draw, layers_of

_MOST_REMARKS = 200
_FAR_M = 15.0  # from GPS: less is the error of a receiver, and no danger
_LONG_S = 5.0
_NEAR_S = 5.0  # of two moments that are closer in time only the first is shown
_OF_A_KIND, _MOST = 2, 6  # moments at most, of one kind and in all
_NUMBER = re.compile(r"\d+(\.\d+)?")
_COLOURS = {
    FixOutcome.TAKEN: "taken",
    FixOutcome.REFUSED: "refused",
    FixOutcome.UNANSWERED: "unanswered",
    FixOutcome.CONTINUOUS: "taken",
    FixOutcome.KEPT: "places",
}
_KNOWN = (("map", "map"), ("technique", "technique"), ("board", "board"), ("edgevpr", "version"))
_CHARTS = (
    ("CPU", "cores busy", "cores", "accepted"),
    ("RAM", "MB", "rss_mb", "accepted"),
    ("Charge", "mAh", "used_mah", "accepted"),
    ("Temperature", "°C", "temperature_c", "refused"),
    ("A query", "ms, encode and match", "wall_ms", "accepted"),
    ("Age of the newest picture", "ms", "latency_ms", "accepted"),
)

Moment = tuple[LoggedQuery, str]  # a query to show, and a sentence on why

# The kinds of bad moments: so many of the worst come into question (None: all), how bad a query is (None: not at all),
# and why. The first are dangers; `_silences` come after them.
_DANGERS = 3
_WORST: tuple[tuple[int | None, Callable[[LoggedQuery], float | None], str], ...] = (
    (
        None,
        lambda query: query.off_m if (query.off_m or 0.0) > _FAR_M else None,
        "The match lies {0.off_m:.0f} m from GPS: one of both is wrong.",
    ),
    (
        None,
        lambda query: 0.0 if query.fix and query.fix.outcome is FixOutcome.REFUSED else None,
        "The autopilot refused the fix: {0.fix.why}.",
    ),
    (
        None,  # not sent because it contradicts the autopilot
        lambda query: 0.0 if query.fix and (query.fix.why or "").startswith("held back") else None,
        "The fix was {0.fix.why}.",
    ),
    (
        1,
        lambda query: query.accuracy_m if query.accepted else None,
        "Of the accepted matches this is the least exact: good to {0.accuracy_m:.1f} m.",
    ),
    (1, lambda query: query.wall_ms, "The slowest query: it took {0.wall_ms:.0f} ms."),
)


class Album:
    """Finds pictures by the names that the log gives them: in `recorded` (files of a recording by the names of their
    frames) or else as files in `folders`. The flight and the map have an album each, since their pictures often have
    equal names. Raises UsageError for a folder that does not exist."""

    def __init__(self, folders: Sequence[str | Path], recorded: Mapping[str, Path] = MappingProxyType({})) -> None:
        self._recorded = recorded
        self._folders = [Path(folder).resolve() for folder in folders]
        for folder in self._folders:
            if not folder.is_dir():
                raise UsageError(f"{folder}: there is no such folder: give one that holds pictures.")

    def picture(self, name: str | None) -> bytes | None:
        """Return the picture `name` as a small JPEG; None if there is none that can be read."""
        if not name or not (self._folders or name in self._recorded):
            return None
        from edgevpr.frames.images import EXTENSIONS, read_image, small_jpeg  # a page without pictures needs no OpenCV

        files = [(path.parent, path) for path in [self._recorded.get(name)] if path]
        files += [(folder, folder / f"{name}{ending}") for folder, ending in product(self._folders, ("", *EXTENSIONS))]
        for folder, path in files:
            with suppress(ImageError, OSError, ValueError):  # no picture, or a name that no file can have
                # A log from somebody else may name any file of this machine: show only files in the folder.
                if path.resolve().is_relative_to(folder.resolve()) and path.is_file():
                    return small_jpeg(read_image(path))
        return None


def page_of(flight: LoggedFlight, ground: MapGround, frames: Album, references: Album) -> str:
    """Return the whole page. `frames` finds the pictures of the flight, `references` those that the map was made of."""
    queries, moments = flight.queries, list(enumerate(worst(flight.queries), start=1))
    positions = [(str(number), query.at or query.autopilot_at or query.gps_at) for number, (query, _) in moments]
    time = text(flight.start, "time") or next((each.time for each in queries), "")
    title = f"Flight of {time[:16].replace('T', ' ')} UTC" if time else "Flight at an unknown time"
    start = [f"{name} {known}" for name, key in _KNOWN if (known := text(flight.start, key))]
    refusals = (query.reason.partition(":")[0] for query in queries if not query.accepted)
    fixes = [query.fix for query in queries if query.fix and query.fix.outcome is not FixOutcome.CONTINUOUS]
    body = [
        heading(title, [f"{clock(flight.span_s)} long", *start, str(flight.path)]),
        section("", _figures(queries)),
        notes(_notes(flight, ground)),
        section("Over the ground", draw(ground, layers_of(flight), [(name, at) for name, at in positions if at])),
        section("What became of every query", _lanes(flight)),
        section("Over time", _charts(flight)),
        section("Worst moments", "".join(_moment(number, *each, frames, references) for number, each in moments)),
        section("Why matches were refused", _counts(refusals)),
        section(
            "Why fixes were not sent, or not taken",
            _counts(f"{fix.outcome.value}: {fix.why}" for fix in fixes if fix.why),
        ),
        section("What was said", _remarks(flight)),
        section("How it was set", _settings(flight)),
    ]
    return page(title, Path(__file__).with_name("page.css"), body)


def _figures(queries: Sequence[LoggedQuery]) -> str:
    outcomes = Counter(query.fix.outcome for query in queries if query.fix)
    sent = sum(outcomes[outcome] for outcome in (FixOutcome.TAKEN, FixOutcome.REFUSED, FixOutcome.UNANSWERED))
    accepted = sum(query.accepted for query in queries)
    share = f" <small>{accepted / len(queries):.0%}</small>" if queries else ""
    off_m, wall_ms = _all(queries, "off_m"), _all(queries, "wall_ms")
    figures = {
        "queries": str(len(queries)),
        "accepted": f"{accepted}{share}",
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
    known = [f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in figures.items() if value != UNKNOWN]
    return f'<dl class="figures">{"".join(known)}</dl>'


def _notes(flight: LoggedFlight, ground: MapGround) -> list[str]:
    queries, nowhere = flight.queries, ground.places - len(ground.at)
    has_places = bool(ground.at) or any(query.place_at for query in queries)
    known = [
        (flight.start, "The log lacks the first line of this flight: how it was set is not known."),
        (flight.end, "The log has no last line: it was cut off (power, full disk), or the flight still goes on."),
        (queries, "No picture became a query in this flight: there is nothing to show of one."),
        (not queries or any(query.accepted for query in queries), "No match was accepted in this flight."),
        (not queries or has_places, "No place has a position: nothing can be drawn over ground, and no fix was sent."),
        (
            not queries or any(query.has_link for query in queries),
            "The log has no report of the autopilot's position: its track and the distance from GPS are not known.",
        ),
        (not ground.trouble, ground.trouble or ""),
        (not nowhere, f"{nowhere} of {ground.places} places of the map have no position and are not drawn."),
    ]
    return [sentence for is_there, sentence in known if not is_there]


def _lanes(flight: LoggedFlight) -> str:
    queries = flight.queries
    is_heard = any(query.has_link for query in queries)
    rows = [
        ("match accepted", "accepted", [query.t_s for query in queries if query.accepted]),
        ("match refused", "refused", [query.t_s for query in queries if not query.accepted]),
        ("frame not usable", "unusable", flight.unusable),
        *(
            (outcome.value, colour, [query.t_s for query in queries if query.fix and query.fix.outcome is outcome])
            for outcome, colour in _COLOURS.items()
        ),
        ("autopilot heard", "autopilot", [query.t_s for query in queries if query.has_link]),
        ("autopilot silent", "refused", [query.t_s for query in queries if is_heard and query.has_link is False]),
    ]
    return lanes([row for row in rows if row[2]], flight.span_s)


def _charts(flight: LoggedFlight) -> str:
    queries = flight.queries
    accepted = _over([query for query in queries if query.accepted], "confidence")
    refused = _over([query for query in queries if not query.accepted], "confidence")
    answered = [
        (query.t_s, query.fix.latency_ms) for query in queries if query.fix and query.fix.latency_ms is not None
    ]
    confidences = [Series("accepted", "accepted", accepted, True), Series("refused", "refused", refused, True)]
    positions = [
        Series("from GPS", "gps", _over(queries, "off_m"), True),
        Series("accuracy, 1 sigma", "accepted", _over(queries, "accuracy_m")),
    ]
    charts = [
        ("Confidence", "", confidences),
        ("Position", "m", positions),
        *((title, unit, [Series("", colour, _over(queries, field))]) for title, unit, field, colour in _CHARTS),
        ("Answer to a fix", "ms", [Series("", "taken", answered, True)]),
    ]
    axis = times(flight.span_s)
    drawn = [chart(title, unit, series, axis, top=0.0 if unit else 1.0) for title, unit, series in charts]
    return f'<div class="charts">{"".join(drawn)}</div>' if any(drawn) else ""


def _over(queries: Sequence[LoggedQuery], field: str) -> Points:
    return [(query.t_s, known) for query in queries if (known := getattr(query, field)) is not None]


def _all(queries: Sequence[LoggedQuery], field: str) -> list[float]:
    return [known for _, known in _over(queries, field)]


def worst(queries: Sequence[LoggedQuery]) -> list[Moment]:
    """Return the worst moments, at most `_MOST`, each (query, sentence on why it is shown). The kinds that could have
    been dangerous come first, and of each kind the worst moments."""
    kinds = []
    for first, badness, why in _WORST:
        bad = [(known, query) for query in queries if (known := badness(query)) is not None]
        kinds.append([(query, why.format(query)) for _, query in sorted(bad, key=lambda pair: -pair[0])[:first]])
    kinds.insert(_DANGERS, _silences(queries))
    chosen: list[Moment] = []
    for moments in kinds:
        most = len(chosen) + _OF_A_KIND
        for query, sentence in moments:
            if len(chosen) < most and all(abs(query.t_s - other.t_s) > _NEAR_S for other, _ in chosen):
                chosen.append((query, sentence))
    return chosen[:_MOST]


def _silences(queries: Sequence[LoggedQuery]) -> list[Moment]:
    """Return a moment in the middle of each long time without an accepted match, the longest time first."""
    moments = []
    runs = [list(several) for accepted, several in groupby(queries, lambda each: each.accepted) if not accepted]
    for run in sorted(runs, key=lambda run: run[0].t_s - run[-1].t_s):
        if run[-1].t_s - run[0].t_s >= _LONG_S:
            since = f"{clock(run[0].t_s)} to {clock(run[-1].t_s)}"
            moments.append((run[len(run) // 2], f"Nothing was recognised from {since}, in {len(run)} queries."))
    return moments


def _moment(number: int, query: LoggedQuery, why: str, frames: Album, references: Album) -> str:
    found = "no place was found"
    if query.place is not None:
        found = f"place {query.place} ({query.reference_image or 'without a name'}), score {figure(query.score)}"
    sure = "" if query.confidence is None else f", confidence {nines(query.confidence)}"
    verdict = f"{'accepted' if query.accepted else 'refused'}: {query.reason}"
    pictures = [("seen", query.name, frames), ("place found", query.reference_image, references)]
    pair = "".join(
        picture(name, f"{what}: {name}", jpeg)
        for what, name, album in pictures
        if name and (jpeg := album.picture(name))
    )
    return (
        f'<div class="moment" id="moment-{number}"><h3><i>{number}</i>{clock(query.t_s)} – {foreign(why)}</h3>'
        f'<p class="soft">{foreign(f"{query.name}: {found}{sure}; {verdict}")}</p>'
        + (f'<div class="pair">{pair}</div></div>' if pair else "</div>")
    )


def _counts(reasons: Iterable[str]) -> str:
    """Return a table of how often each reason was given. Numbers in reasons become "…", so that equal ones count
    together."""
    counted = Counter(_NUMBER.sub("…", reason) for reason in reasons)
    return table(("times", "why"), [(str(count), why) for why, count in counted.most_common(20)]) if counted else ""


def _remarks(flight: LoggedFlight) -> str:
    rows = [(clock(each.t_s), each.kind, each.said) for each in flight.remarks[:_MOST_REMARKS]]
    left_out = f'<p class="soft">and {len(flight.remarks) - len(rows)} more lines</p>'
    return (table(("time", "of", "said"), rows) if rows else "") + left_out * (len(flight.remarks) > len(rows))


def _settings(flight: LoggedFlight) -> str:
    reason, config = text(flight.start, "decided", "reason"), value(flight.start, "config")
    if not isinstance(config, dict):
        return ""
    said = f"<p>{foreign(reason)}</p>" if reason else ""
    dumped = escape(shown(json.dumps(config, indent=1, ensure_ascii=False), keep="\n"))
    return f"{said}<details><summary>configuration</summary><pre>{dumped}</pre></details>"
