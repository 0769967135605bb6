"""Output of `edgevpr match`: the JSON object of a query, and the table and summary for people."""

import math
import textwrap
from collections import Counter
from collections.abc import Iterator, Sequence
from statistics import median
from typing import TYPE_CHECKING, Any

from edgevpr.core.reasons import ReasonCode
from edgevpr.core.text import align_table, format_offset, format_probability, sanitize

if TYPE_CHECKING:
    from edgevpr.runtime.recognise.recognition import Recognition

_NAME_COLUMNS = 17  # keeps a row at about 120 columns
_REASON_COLUMNS = 48
_MIN_OFFSETS = 5
_NEARLY_ALL = 0.9
_FIX_HEADINGS = ("lat", "lon", "± m", "m from its GPS tag")


def format_match(event: "Recognition") -> dict[str, Any]:
    """Return a query for `match --json`: the fields of its event, except that `position` is the fix (null: none) and
    the best place is one object (null: none was found). `of_place`: the fix is the position of the place itself,
    because the offset from it is unknown. `on_map_m`: accuracy relative to the map. `gps_tag_offset_m`: from the GPS
    tag of the query to the fix, east and north, and `from_gps_tag_m` its length; null if either is missing."""
    from edgevpr.core.geodesy import offset_between_m
    from edgevpr.runtime.recognise.recognition import to_fields

    fields = to_fields(event, exact=True)
    place_id, image, position = (fields.pop(name) for name in ("place", "reference_image", "position"))
    accuracy_m, fix, located = fields.pop("accuracy_m"), fields.pop("located"), event.located
    tag, offset_m = event.frame and event.frame.position, None
    if fix and located:
        fix |= {"accuracy_m": accuracy_m, "on_map_m": round(located.accuracy_m, 2), "of_place": not fix["places"]}
        if tag:
            offset_m = [round(metres, 2) for metres in offset_between_m(tag, located.position)]
    unknown = dict.fromkeys(("lat_deg", "lon_deg", "alt_m"))
    first = {
        "query": fields.pop("query"),
        "accepted": fields.pop("accepted"),
        "reason": fields.pop("reason"),
        "position": fix,
        "from_gps_tag_m": offset_m and round(math.hypot(*offset_m), 2),
        "gps_tag_offset_m": offset_m,
        "place": None if place_id is None else {"number": place_id, "image": image, **(position or unknown)},
    }
    return first | fields


def format_matches(matches: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield the table of the queries `matches` (see `format_match`) and its summary."""
    measure = "confidence" if any("confidence" in match for match in matches) else "score"
    rows = align_table(
        [("query", "accepted", measure, "place, picture"), *(_format_place(match, measure) for match in matches)],
        left=4,
    )
    fixes = [match for match in matches if match["position"]]
    headings = _FIX_HEADINGS if any(match["from_gps_tag_m"] is not None for match in fixes) else _FIX_HEADINGS[:3]
    heading, *fix_rows = align_table([headings, *map(_format_fix, fixes)], left=0) if fixes else [""]
    width, remaining = max(map(len, rows)), iter(fix_rows)
    yield f"{rows[0]:<{width}}  {heading}".rstrip()
    for row, match in zip(rows[1:], matches, strict=True):
        yield f"{row:<{width}}  {next(remaining) if match['position'] else _format_refusal(match)}".rstrip()
    yield from _summarise(matches, fixes)


def _format_place(match: dict[str, Any], measure: str) -> tuple[str, ...]:
    """Return the left part of a row: the query and the place found."""
    place, value = match["place"], match.get(measure)
    text = "-" if value is None else format_probability(value) if measure == "confidence" else f"{value:.3f}"
    label = f"{place['number']} {_shorten_name(place['image'])}" if place else "-"
    return _shorten_name(match["query"]), "yes" if match["accepted"] else "no", text, label


def _format_fix(match: dict[str, Any]) -> tuple[str, ...]:
    """Return the right part of a row with a fix; a star marks a fix that is the position of the place itself."""
    fix, from_tag_m = match["position"], match["from_gps_tag_m"]
    accuracy = f"{fix['accuracy_m']:.1f}{'*' if fix['of_place'] else ' '}"
    distance = "-" if from_tag_m is None else f"{from_tag_m:.1f}"
    return f"{fix['lat_deg']:.6f}", f"{fix['lon_deg']:.6f}", accuracy, distance


def _format_refusal(match: dict[str, Any]) -> str:
    """Return the right part of a row without a fix: the reason in a few words."""
    reason = "its place has no position" if match["accepted"] else ReasonCode[match["reason"]["code"]].summary
    return textwrap.shorten(reason, _REASON_COLUMNS, placeholder=" ...")


def _shorten_name(name: str) -> str:
    """Return the name of a picture for the table; only the end of a long name, where names differ."""
    name = sanitize(name)
    return name if len(name) <= _NAME_COLUMNS else f"...{name[3 - _NAME_COLUMNS :]}"


def _summarise(matches: Sequence[dict[str, Any]], fixes: Sequence[dict[str, Any]]) -> Iterator[str]:
    refused = Counter(ReasonCode[match["reason"]["code"]] for match in matches if not match["accepted"])
    counts = ", ".join(f"{count} {code.summary}" for code, count in refused.most_common())
    reasons = f"; refused: {counts}" if refused else ""
    yield f"{len(matches)} queries, {len(matches) - refused.total()} accepted{reasons}"
    if not fixes:
        return
    in_world_m, on_map_m = (median(match["position"][key] for match in fixes) for key in ("accuracy_m", "on_map_m"))
    text = f"± m: 1 sigma of the fix in the world, median {in_world_m:.1f} m; on the map {on_map_m:.1f} m"
    if from_tag_m := [match["from_gps_tag_m"] for match in fixes if match["from_gps_tag_m"] is not None]:
        text += f"; {median(from_tag_m):.1f} m from the GPS tags, which have errors of their own"
    yield text
    offsets_m = [complex(*match["gps_tag_offset_m"]) for match in fixes if match["gps_tag_offset_m"]]
    if offset_m := _find_common_offset(offsets_m, in_world_m):
        yield (
            f"the fixes lie {format_offset(offset_m.real, offset_m.imag)} of the GPS tags, nearly all alike: map or "
            "tags are displaced (or the camera is tilted). A flight with GPS measures it: see edgevpr map move"
        )
    if of_place := sum(match["position"]["of_place"] for match in fixes):
        yield f"*: {of_place} positions are simply those of the matched places: the offset from the place is unknown"


def _find_common_offset(offsets_m: Sequence[complex], claimed_m: float) -> complex | None:
    """Return the median offset (east + north j) if it is larger than `claimed_m` and the scatter of nearly all offsets
    allow; None if it is not, or there are too few."""
    if len(offsets_m) < _MIN_OFFSETS:
        return None
    middle_m = complex(median(each.real for each in offsets_m), median(each.imag for each in offsets_m))
    distances_m = sorted(abs(each - middle_m) for each in offsets_m)
    scatter_m = distances_m[math.ceil(_NEARLY_ALL * len(distances_m)) - 1]
    return middle_m if abs(middle_m) > 2 * max(claimed_m, scatter_m) else None
