"""What flights.py found: its figures and its page."""

from collections.abc import Callable, Sequence

import base
import numpy as np
from base import Row, use_of
from where import honest, spread

_COLUMNS = {
    "flights": "{name}",
    "mode": "{mode}",
    "number": "{flights}",
    **{title.replace("_", " "): f"{{{title}}}" for title in ("queries", "over_the_map", "right", "wrong", "far_off")},
    "lost": "{lost:.0%}",
    "gap s": "{longest_gap_s[median]} / {longest_gap_s[worst]}",
    "error m": "{error[median_m]:.1f} / {error[p95_m]:.1f}",
    "claimed sd m": "{claimed_sd_m:.1f}",
    "within 1, 2 sigma": "{within[one_sigma]:.2f} / {within[two_sigma]:.2f}",
}


def summary(rows: Sequence[Row], modes: Sequence[str]) -> dict:
    """Return the figures of every mode, by what the flights have in common."""
    groups: dict[str, Callable[[Row], object]] = {
        "all": lambda row: "all",
        "use": lambda row: use_of(row["site"]),
        "site": lambda row: row["site"],
        "kind": lambda row: row["kind"],
        "odometry": lambda row: row["odometry"],
        "flight": lambda row: f"{row['flight']:02d} {row['site']}, {row['kind']}, odometry {row['odometry']}",
    }
    found: dict[str, dict] = {}
    for group, of in groups.items():
        names = dict.fromkeys(of(row) for row in rows)
        found[group] = {
            name: {mode: _figures([row for row in rows if row["mode"] == mode and of(row) == name]) for mode in modes}
            for name in names
        }
    return found


def _figures(rows: Sequence[Row]) -> dict:
    flights = {number: [row for row in rows if row["flight"] == number] for number in {row["flight"] for row in rows}}
    lost = [_lost(each) for each in flights.values()]
    fixes = [row for row in rows if row["fix"]]
    right = [row for row in fixes if row["fix"] == "right"]
    own = [row for row in fixes if row["over"] == row["site"]]
    gaps_s = [max(each) for _, _, each in lost if each]
    return {
        "flights": len(flights),
        "queries": len(rows),
        "over_the_map": sum(row["is_mapped"] for row in rows),
        "right": len(right),
        "wrong": len(fixes) - len(right),
        "far_off": sum(row["is_far"] for row in fixes),
        "wrong_over_other_ground": sum(row["over"] != row["site"] for row in fixes),
        "over_the_map_s": round(sum(each[0] for each in lost)),
        "lost_s": round(sum(each[1] for each in lost)),
        "longest_gap_s": {"median": round(np.median(gaps_s), 1), "worst": round(max(gaps_s), 1)} if gaps_s else None,
        "error": spread([row["off_m"] for row in right]) if right else None,
        "claimed_sd_m": round(float(np.median([row["sd_m"] for row in right])), 2) if right else None,
        "within": honest([row["off_m"] for row in own], [row["variances_m2"] for row in own], 0.0) if own else None,
    }


def _lost(rows: Sequence[Row]) -> tuple[float, float, list[float]]:
    """Return, of one flight, the seconds over the map, those of queries without a fix that is right, and the times
    between one such fix, or the begin, and the next, or the end. Each stretch over the map counts by itself."""
    over_s = lost_s = 0.0
    gaps_s: list[float] = []
    since = None
    for before, row in zip([None, *rows[:-1]], rows, strict=True):
        if not row["is_mapped"]:
            since = None
            continue
        if since is None:
            since = row["t_s"]
        elif before is not None:
            took_s = row["t_s"] - before["t_s"]
            over_s += took_s
            lost_s += took_s * (row["fix"] != "right")
        gaps_s.append(row["t_s"] - since)
        if row["fix"] == "right":
            since = row["t_s"]
    return over_s, lost_s, gaps_s


def page(result: Row, text: str) -> str:
    """Return the results as Markdown."""
    tables = []
    for group in ("all", "use", "site", "kind", "odometry"):
        rows = [
            each | {"name": name, "mode": mode, "lost": over_s and each["lost_s"] / over_s}
            for name, modes in result[group].items()
            for mode, each in modes.items()
            for over_s in [each["over_the_map_s"] or None]
        ]
        tables.append((f"By {group}:\n\n" if group != "all" else "") + base.table(rows, _COLUMNS))
    return f"""# Flights over real aerial pictures

{text}

Right, wrong, far off: fixes. Lost: share of the time over the map. Gap: the longest without a right fix over the map,
median and worst of the flights. Errors: median / 95th percentile of right fixes. Within: shares of errors, axis by
axis, within one and two standard deviations that the fix claims (asked: .68 and .95), of all fixes over the site's own
ground.

{tables[0]}

Constants of edgevpr were chosen on {" and ".join(name for name in base.TUNED_ON if name in result["site"])} (use
*tune*), of the sites here; on none of these flights.

{(chr(10) * 2).join(tables[1:])}

Commit {result["commit"]}, {result["date"]}, {result["machine"]["cpu"]}; {result["took_s"]} s.
`python benchmarks/flights.py` makes this page; flights.json has every flight.
"""
