"""A flight as one page that needs nothing else: no network, no script, in the colours that the reader's machine has."""

import json
import re
from collections import Counter
from collections.abc import Sequence
from html import escape
from pathlib import Path
from statistics import median

from edgevpr.core.text import shown
from edgevpr.review.charts import chart, clock, lanes
from edgevpr.review.flight import Flight, Outcome, Query
from edgevpr.review.ground import Ground, draw, layers_of
from edgevpr.review.html import foreign, page, section, table
from edgevpr.review.moments import Moment, worst
from edgevpr.review.pictures import Album
from edgevpr.review.svg import UNKNOWN, Points, Series, figure
from edgevpr.review.values import text, value

_MOST_REMARKS = 200
_NUMBER = re.compile(r"\d+(\.\d+)?")


def page_of(flight: Flight, ground: Ground, frames: Album, references: Album) -> str:
    """Return the page: HTML with all that it shows inside. `frames` has the pictures of the flight, `references` those
    that the map was made of."""
    moments = worst(flight)
    body = [
        _head(flight),
        section("", _figures(flight)),
        _notes(flight, ground),
        section("Over the ground", _ground(flight, ground, moments)),
        section("What became of every query", _lanes(flight)),
        section("Over time", _charts(flight)),
        section(
            "Worst moments", "".join(_moment(at, each, frames, references) for at, each in enumerate(moments, start=1))
        ),
        section("Why matches were refused", _counts(_refusals(flight))),
        section("Why fixes were not sent, or not taken", _counts(_objections(flight))),
        section("What was said", _remarks(flight)),
        section("How it was set", _settings(flight)),
    ]
    style = Path(__file__).with_name("page.css").read_text("utf-8")
    return page(_title(flight), style, "".join(body))


def _title(flight: Flight) -> str:
    time = text(flight.start, "time") or next((each.time for each in flight.queries), "")
    return f"Flight of {time[:16].replace('T', ' ')} UTC" if time else "Flight at an unknown time"


def _head(flight: Flight) -> str:
    known = [
        f"{clock(flight.span_s)} long",
        flight.map_path and f"map {flight.map_path}",
        (name := text(flight.start, "technique")) and f"technique {name}",
        (board := text(flight.start, "board")) and f"board {board}",
        (version := text(flight.start, "version")) and f"edgevpr {version}",
        f"{flight.path}, flight {flight.number} of {flight.flights}",
    ]
    return f'<h1>{foreign(_title(flight))}</h1><p class="soft">{foreign(", ".join(filter(None, known)))}</p>'


def _figures(flight: Flight) -> str:
    queries = flight.queries
    outcomes = Counter(each.fix.outcome for each in queries if each.fix)
    sent = sum(outcomes[each] for each in (Outcome.TAKEN, Outcome.REFUSED, Outcome.UNANSWERED))
    accepted = sum(each.accepted for each in queries)
    share = f"{accepted / len(queries):.0%}" if queries else ""
    off_m = [each.off_m for each in queries if each.off_m is not None]
    figures = [
        ("queries", str(len(queries)), ""),
        ("accepted", str(accepted), share),
        ("fixes sent", str(sent), ""),
        ("fixes taken", str(outcomes[Outcome.TAKEN]), ""),
        ("fixes refused", str(outcomes[Outcome.REFUSED]), ""),
        ("fixes not answered", str(outcomes[Outcome.UNANSWERED]), ""),
        *([("in continuous position", str(outcomes[Outcome.CONTINUOUS]), "")] if outcomes[Outcome.CONTINUOUS] else []),
        ("from GPS, median", figure(median(off_m) if off_m else None, "m"), ""),
        ("from GPS, most", figure(max(off_m, default=None), "m"), ""),
        ("charge", figure(max(_all(queries, "used_mah"), default=None), "mAh"), ""),
        ("RAM, most", figure(max(_all(queries, "rss_mb"), default=None), "MB"), ""),
        ("a query, median", figure(median(times) if (times := _all(queries, "wall_ms")) else None, "ms"), ""),
        ("hottest", figure(max(_all(queries, "temperature_c"), default=None), "°C"), ""),
    ]
    tiles = "".join(
        f"<div><dt>{name}</dt><dd>{said} <small>{more}</small></dd></div>"
        for name, said, more in figures
        if said != UNKNOWN
    )
    return f'<dl class="figures">{tiles}</dl>'


def _notes(flight: Flight, ground: Ground) -> str:
    queries = flight.queries
    has_places = any(each.place_at for each in queries) or bool(ground.at)
    nowhere = ground.places - len(ground.at)
    notes = [
        not flight.start and "The log lacks the first line of this flight: how it was set is not known.",
        not flight.end
        and "The log of this flight has no last line: it was cut off (power, full disk), or the flight still goes on.",
        not queries and "No picture became a query in this flight: there is nothing to show of one.",
        queries and not any(each.accepted for each in queries) and "No match was accepted in this flight.",
        queries
        and not has_places
        and "No place has a position: nothing can be drawn over ground, and no fix was sent.",
        queries
        and not any(each.has_link for each in queries)
        and "The log has no report of the autopilot's position: its track and the distance from GPS are not known.",
        ground.trouble,
        nowhere and f"{nowhere} of {ground.places} places of the map have no position and are not drawn.",
    ]
    items = "".join(f"<li>{foreign(note)}</li>" for note in notes if note)
    return f'<section class="notes"><ul>{items}</ul></section>' if items else ""


def _ground(flight: Flight, ground: Ground, moments: Sequence[Moment]) -> str:
    named = [
        (str(at), where)
        for at, moment in enumerate(moments, start=1)
        if (where := moment.query.at or moment.query.autopilot_at or moment.query.gps_at)
    ]
    return draw(ground, layers_of(flight), named)


def _lanes(flight: Flight) -> str:
    queries = flight.queries
    rows = [
        ("match accepted", "accepted", [each.t_s for each in queries if each.accepted]),
        ("match refused", "refused", [each.t_s for each in queries if not each.accepted]),
        ("frame not usable", "unusable", flight.unusable),
        *((each.value, colour, _times(queries, each)) for each, colour in _OUTCOMES.items()),
        ("autopilot heard", "autopilot", heard := [each.t_s for each in queries if each.has_link]),
        ("autopilot silent", "refused", [each.t_s for each in queries if heard and each.has_link is False]),
    ]
    rows = [row for row in rows if row[2]]
    return lanes(rows, flight.span_s) if rows else ""


_OUTCOMES = {
    Outcome.TAKEN: "taken",
    Outcome.REFUSED: "refused",
    Outcome.UNANSWERED: "unanswered",
    Outcome.CONTINUOUS: "taken",
    Outcome.KEPT: "places",
}


def _times(queries: Sequence[Query], outcome: Outcome) -> list[float]:
    return [each.t_s for each in queries if each.fix and each.fix.outcome is outcome]


def _charts(flight: Flight) -> str:
    queries, span_s = flight.queries, flight.span_s
    accepted = [each for each in queries if each.accepted]
    refused = [each for each in queries if not each.accepted]
    answered = [(each.t_s, each.fix.latency_ms) for each in queries if each.fix and each.fix.latency_ms is not None]
    charts = [
        chart(
            "Confidence",
            "",
            [
                Series("accepted", "accepted", _over(accepted, "confidence"), are_dots=True),
                Series("refused", "refused", _over(refused, "confidence"), are_dots=True),
            ],
            span_s,
            top=1.0,
        ),
        chart(
            "Position",
            "m",
            [
                Series("from GPS", "gps", _over(queries, "off_m"), are_dots=True),
                Series("accuracy, 1 sigma", "accepted", _over(queries, "accuracy_m")),
            ],
            span_s,
        ),
        _one("CPU", "cores busy", flight, "cores", "accepted"),
        _one("RAM", "MB", flight, "rss_mb", "accepted"),
        _one("Charge", "mAh", flight, "used_mah", "accepted"),
        _one("Temperature", "°C", flight, "temperature_c", "refused"),
        _one("A query", "ms, encode and match", flight, "wall_ms", "accepted"),
        _one("Age of the newest picture", "ms", flight, "latency_ms", "accepted"),
        chart("Answer to a fix", "ms", [Series("", "taken", answered, are_dots=True)], span_s),
    ]
    return f'<div class="charts">{"".join(charts)}</div>' if any(charts) else ""


def _one(title: str, unit: str, flight: Flight, field: str, colour: str) -> str:
    return chart(title, unit, [Series("", colour, _over(flight.queries, field))], flight.span_s)


def _over(queries: Sequence[Query], field: str) -> Points:
    return [(each.t_s, known) for each in queries if (known := getattr(each, field)) is not None]


def _all(queries: Sequence[Query], field: str) -> list[float]:
    return [known for _, known in _over(queries, field)]


def _moment(at: int, moment: Moment, frames: Album, references: Album) -> str:
    query = moment.query
    found = "no place was found"
    if query.place is not None:
        found = f"place {query.place} ({query.reference_image or 'without a name'}), score {figure(query.score)}"
    sure = "" if query.confidence is None else f", confidence {query.confidence:.4f}"
    pictures = [("seen", query.name, frames), ("place found", query.reference_image, references)]
    pair = "".join(
        f'<figure><img alt="{foreign(name)}" src="{data}"><figcaption>{foreign(f"{what}: {name}")}</figcaption>'
        "</figure>"
        for what, name, album in pictures
        if name and (data := album.picture(name))
    )
    return (
        f'<div class="moment" id="moment-{at}"><h3><i>{at}</i>{clock(query.t_s)} – {foreign(moment.why)}</h3>'
        f'<p class="soft">{foreign(query.name)}: {foreign(found + sure)}; '
        f"{'accepted' if query.accepted else 'refused'}: {foreign(query.reason)}</p>"
        + (f'<div class="pair">{pair}</div></div>' if pair else "</div>")
    )


def _refusals(flight: Flight) -> Counter[str]:
    """Count why matches were refused; figures, which differ every time, are left out."""
    return Counter(_NUMBER.sub("…", each.reason.partition(":")[0]) for each in flight.queries if not each.accepted)


def _objections(flight: Flight) -> Counter[str]:
    fixes = [each.fix for each in flight.queries if each.fix and each.fix.outcome is not Outcome.CONTINUOUS]
    return Counter(f"{fix.outcome.value}: {_NUMBER.sub('…', fix.why)}" for fix in fixes if fix.why)


def _counts(counter: Counter[str]) -> str:
    if not counter:
        return ""
    return table(("times", "why"), [(str(count), said) for said, count in counter.most_common(20)])


def _remarks(flight: Flight) -> str:
    remarks = flight.remarks[:_MOST_REMARKS]
    if not remarks:
        return ""
    more = len(flight.remarks) - len(remarks)
    rows = [(clock(each.t_s), each.kind, each.said) for each in remarks]
    left_out = f'<p class="soft">and {more} more lines</p>' if more else ""
    return table(("time", "of", "said"), rows) + left_out


def _settings(flight: Flight) -> str:
    reason = text(flight.start, "decided", "reason")
    config = value(flight.start, "config")
    if not isinstance(config, dict):
        return ""
    said = f"<p>{foreign(reason)}</p>" if reason else ""
    dumped = escape(shown(json.dumps(config, indent=1, ensure_ascii=False), keep="\n"))
    return f"{said}<details><summary>configuration</summary><pre>{dumped}</pre></details>"
