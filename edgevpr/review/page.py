"""The report of a flight (`edgevpr report`): one HTML page with its pictures inside, without network.

Functions that return a str return HTML.
"""

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from itertools import groupby
from statistics import median
from typing import TYPE_CHECKING, Any

from edgevpr.core.text import shown
from edgevpr.core.types import Place
from edgevpr.review.album import Album
from edgevpr.review.html import (
    Points,
    Series,
    chart,
    clock,
    figure,
    figures,
    foreign,
    heading,
    lanes,
    notes,
    picture,
    section,
    table,
    times,
)
from edgevpr.review.logged import FixOutcome, LoggedFlight, LoggedQuery, number, text, value
from edgevpr.review.queries import found, lanes_of, layers_of, steps_of
from edgevpr.review.steps import Explored, Thresholds, counts, stepped

if TYPE_CHECKING:
    from edgevpr.frames.level import Lens

_MOST_REMARKS = 200
_FAR_M = 15.0  # from GPS: less is the error of a receiver, and no danger
_LONG_S = 5.0
_NEAR_S = 5.0  # of two moments that are closer in time only the first is shown
_OF_A_KIND, _MOST = 2, 6  # moments at most, of one kind and in all
_UNSENT = re.compile(r"^not sent( yet)?: ")  # so some reasons begin, and the outcome before them says it already
_KNOWN = (("map", "map"), ("technique", "technique"), ("board", "board"), ("edgevpr", "version"))

Moment = tuple[LoggedQuery, str]  # a query to show, and a sentence on why
_Ranked = tuple[int, float, LoggedQuery, str]  # the kind of a moment and its rank, both the lower the worse; the moment


def page_of(
    flight: LoggedFlight,
    ground: Sequence[Place],
    frames: Album,
    references: Album,
    no_ground: str = "",
    thresholds: Thresholds | None = None,
) -> str:
    """Return the whole page. `frames` finds the pictures of the flight, `references` those that the map was made of.
    `no_ground` is a sentence on why there is no `ground`. `thresholds` are those of other precisions (None: unknown).
    """
    queries, moments = flight.queries, list(enumerate(worst(flight.queries, flight.truth), start=1))
    positions = ((str(at), query.at or query.autopilot_at or query.gps_at) for at, (query, _) in moments)
    time = text(flight.start, "time") or next((text(each.line, "time") for each in queries), None)
    title = f"Flight of {time[:16].replace('T', ' ')} UTC" if time else "Flight at an unknown time"
    start = [f"{name} {known}" for name, key in _KNOWN if (known := text(flight.start, key))]
    refusals = (query.reason.partition(":")[0] for query in queries if not query.accepted)
    fixes = [query.fix for query in queries if query.fix and query.fix.outcome is not FixOutcome.CONTINUOUS]
    above = [
        heading(title, [f"{clock(flight.span_s)} long", *start, str(flight.path)]),
        section("", _figures(flight)),
        notes(_notes(flight, bool(ground), no_ground)),
    ]
    below = [
        section("What became of every query", lanes(lanes_of(flight), flight.span_s)),
        section("Over time", _charts(flight)),
        section("Worst moments", "".join(_moment(at, *each, frames, references) for at, each in moments)),
        section("Why matches were refused", counts(refusals)),
        section(
            "Why fixes were not sent, or not taken",
            counts(f"{fix.outcome.value}: {_UNSENT.sub('', fix.why)}" for fix in fixes if fix.why),
        ),
        section("What was said", _remarks(flight)),
        section("How it was set", _settings(flight)),
    ]
    explored = Explored(
        unit="query",
        ground=ground,
        layers=layers_of(ground, flight),
        steps=steps_of(ground, flight),
        albums={"seen": frames, "place": references},
        lens=lens_of(flight.start),
        named=[(name, at) for name, at in positions if at],
        span_s=flight.span_s,
        thresholds=thresholds,
    )
    return stepped(title, above, explored, below)


def lens_of(start: Mapping[str, Any]) -> "Lens | None":
    """Return the lens of the flight's camera by the first line of its log; None if it is unknown."""
    fov_deg, up_deg, ahead_deg, right_deg = (
        number(start, "config", "source", name) for name in ("fov_deg", "up_deg", "mount_ahead_deg", "mount_right_deg")
    )
    if fov_deg is None or not 0 < fov_deg < 180:
        return None
    from edgevpr.frames.level import Lens, Mount  # with OpenCV

    return Lens(fov_deg, up_deg or 0.0, mount=Mount(ahead_deg or 0.0, right_deg or 0.0))


def _figures(flight: LoggedFlight) -> str:
    queries, between = flight.queries, len(flight.between)
    outcomes = Counter(query.fix.outcome for query in queries if query.fix)
    sent = sum(outcomes[outcome] for outcome in (FixOutcome.TAKEN, FixOutcome.REFUSED, FixOutcome.UNANSWERED))
    accepted = sum(query.accepted for query in queries)
    share = f" <small>{accepted / len(queries):.0%}</small>" if queries else ""
    off_m = [query.off_m for query in queries if query.off_m is not None]
    known = {
        "queries": str(len(queries)),
        "accepted": f"{accepted}{share}",
        "fixes sent": f"{sent} <small>and {between} between matches</small>" if between else str(sent),
        "fixes taken": str(outcomes[FixOutcome.TAKEN]),
        f"from {flight.truth}, median": figure(median(off_m) if off_m else None, "m"),
        f"from {flight.truth}, most": figure(max(off_m, default=None), "m"),
        "charge": figure(_most(queries, "totals", "used_mah"), "mAh"),
        "RAM, most": figure(_most(queries, "costs", "rss_mb"), "MB"),
        "hottest": figure(_most(queries, "board", "temperature_c"), "°C"),
    }
    return figures(known)


def _most(queries: Sequence[LoggedQuery], *keys: str) -> float | None:
    return max((value for _, value in _over(queries, *keys)), default=None)


def _notes(flight: LoggedFlight, has_ground: bool, no_ground: str) -> list[str]:
    queries = flight.queries
    has_places = has_ground or any(query.place_at for query in queries)
    known = [
        (flight.start, "The log lacks the first line of this flight: how it was set is not known."),
        (flight.end, "The log has no last line: it was cut off (power, full disk), or the flight still goes on."),
        (queries, "No picture became a query in this flight: there is nothing to show of one."),
        (not queries or has_places, "No place has a position: nothing can be drawn over ground, and no fix was sent."),
        (
            not queries or any(query.has_link for query in queries),
            "The log has no report of the autopilot's position: its track and the distance from GPS are not known.",
        ),
        (not no_ground, no_ground),
    ]
    return [*flight.notes, *(sentence for is_there, sentence in known if not is_there)]


def _charts(flight: LoggedFlight) -> str:
    queries = flight.queries

    def over(name: str, colour: str, factor: float, *keys: str) -> Series:
        return Series(name, colour, [(t_s, factor * value) for t_s, value in _over(queries, *keys)])

    confidences = [
        Series(name, name, _points((query, query.confidence) for query in queries if query.accepted is accepted), True)
        for name, accepted in (("accepted", True), ("refused", False))
    ]
    off_gps = Series(f"from {flight.truth}", "gps", _points((query, query.off_m) for query in queries), True)
    accuracy = Series("accuracy, 1 sigma", "accepted", _points((query, query.accuracy_m) for query in queries), True)
    took = [
        over("encode", "gps", 1e3, "costs", "t_encode_s"),
        over("match", "accepted", 1e3, "costs", "t_match_s"),
        over("CPU", "taken", 1e3, "costs", "cpu_s"),
    ]
    charts = (
        ("Confidence", "", confidences),
        ("Position", "m", [off_gps, accuracy]),
        ("A query", "ms", took),
        ("RAM", "MB", [over("", "accepted", 1, "costs", "rss_mb")]),
        ("Charge", "mAh", [over("", "accepted", 1, "totals", "used_mah")]),
        ("Temperature", "°C", [over("", "refused", 1, "board", "temperature_c")]),
        ("Age of the newest picture", "ms", [over("", "accepted", 1e3, "totals", "latency_s")]),
    )
    axis = times(flight.span_s)
    drawn = [chart(title, unit, series, axis, top=0.0 if unit else 1.0) for title, unit, series in charts]
    return f'<div class="charts">{"".join(drawn)}</div>' if any(drawn) else ""


def _points(values: Iterable[tuple[LoggedQuery, float | None]]) -> Points:
    """Return (time, value) of the queries whose value is known."""
    return [(query.t_s, value) for query, value in values if value is not None]


def _over(queries: Sequence[LoggedQuery], *keys: str) -> Points:
    """Return (time, number at `keys` in the line of the query), as far as it is known."""
    return _points((query, number(query.line, *keys)) for query in queries)


def worst(queries: Sequence[LoggedQuery], truth: str = "GPS") -> list[Moment]:
    """Return the worst moments, at most `_MOST`, each (query, sentence on why it is shown). The kinds that could have
    been dangerous come first, and of each kind the worst moments. `truth` names the positions by which matches are
    judged."""
    chosen: list[Moment] = []
    shown_of = Counter[int]()
    for kind, _, query, sentence in sorted([*_dangers(queries, truth), *_silences(queries)], key=lambda each: each[:2]):
        if shown_of[kind] < _OF_A_KIND and all(abs(query.t_s - other.t_s) > _NEAR_S for other, _ in chosen):
            shown_of[kind] += 1
            chosen.append((query, sentence))
    return chosen[:_MOST]


def _dangers(queries: Sequence[LoggedQuery], truth: str) -> Iterator[_Ranked]:
    """Yield the queries that may be worth a look: those of kind 0 to 2 could have been dangerous."""
    doubt = ": one of both is wrong" if truth == "GPS" else ""
    for query in queries:
        why = query.fix.why if query.fix else None
        if query.off_m is not None and query.off_m > _FAR_M:
            yield 0, -query.off_m, query, f"The match lies {query.off_m:.0f} m from {truth}{doubt}."
        elif query.fix and query.fix.outcome is FixOutcome.REFUSED:
            yield 1, 0.0, query, f"The autopilot refused the fix: {why}."
        elif why and why.startswith("held back"):  # not sent because it contradicts the autopilot
            yield 2, 0.0, query, f"The fix was {why}."
        elif query.accepted and query.accuracy_m is not None:
            said = f"Of the accepted matches this is one of the least exact: good to {query.accuracy_m:.1f} m."
            yield 4, -query.accuracy_m, query, said


def _silences(queries: Sequence[LoggedQuery]) -> Iterator[_Ranked]:
    """Yield a query in the middle of each long time without an accepted match."""
    for accepted, several in groupby(queries, lambda each: each.accepted):
        run = list(several)
        length_s = run[-1].t_s - run[0].t_s
        if not accepted and length_s >= _LONG_S:
            since = f"{clock(run[0].t_s)} to {clock(run[-1].t_s)}"
            said = f"Nothing was recognised from {since}, in {len(run)} queries."
            yield 3, -length_s, run[len(run) // 2], said


def _moment(at: int, query: LoggedQuery, why: str, frames: Album, references: Album) -> str:
    verdict = f"{'accepted' if query.accepted else 'refused'}: {query.reason}"
    pictures = [("seen", query.name, frames), ("place found", query.reference_image, references)]
    pair = "".join(
        picture(name, f"{what}: {name}", jpeg)
        for what, name, album in pictures
        if name and (jpeg := album.picture(name))
    )
    return (
        f'<div class="moment" id="moment-{at}"><h3><i>{at}</i>{clock(query.t_s)} – {foreign(why)}</h3>'
        f'<p class="soft">{foreign(f"{query.name}: {found(query)}; {verdict}")}</p>'
        + (f'<div class="pair">{pair}</div></div>' if pair else "</div>")
    )


def _remarks(flight: LoggedFlight) -> str:
    rows = [(clock(t_s), kind, said) for t_s, kind, said in flight.remarks[:_MOST_REMARKS]]
    left_out = f'<p class="soft">and {len(flight.remarks) - len(rows)} more lines</p>'
    return (table(("time", "of", "said"), rows) if rows else "") + left_out * (len(flight.remarks) > len(rows))


def _settings(flight: LoggedFlight) -> str:
    reason, config = text(flight.start, "decided", "reason"), value(flight.start, "config")
    if not isinstance(config, dict):
        return ""
    said = f"<p>{foreign(reason)}</p>" if reason else ""
    dumped = escape(shown(json.dumps(config, indent=1, ensure_ascii=False), keep="\n"))
    return f"{said}<details><summary>configuration</summary><pre>{dumped}</pre></details>"
