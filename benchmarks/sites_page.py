"""Page and picture of `sites.py`: recall, what is accepted, times and memory as the map grows."""

from pathlib import Path

import numpy as np
from run_sets import write_rows

from edgevpr.core.text import markdown

TITLES = {"nadir": "Looking straight down", "forward": "Looking ahead"}


def write(out: Path, rows: list[dict], text: str) -> None:
    """Write what has been measured so far as sites.json, sites.md and sites.png; `text` says how."""
    write_rows(out, "sites", rows, lambda content: _page(content, text), _draw)


def _page(content: dict, text: str) -> str:
    heading = (
        "places",
        "of the sites",
        "recall@1",
        "95 %",
        "accepted right",
        "beside",
        "wrong",
        "best place wrong: where",
    )
    costs = (
        "places",
        "encode ms",
        "scan ms",
        "query ms",
        "90 % of queries, ms",
        "bytes a place in RAM",
        "peak RAM MB",
        "map MB",
    )
    parts = [f"# One map out of many sites\n\n{text.partition(chr(10) * 2)[2].partition('What is measured')[0]}"]
    for camera, title in TITLES.items():
        flown, exact, unlike = _by_how(content["rows"], camera)
        if not flown:
            continue
        parts.append(f"## {title}: {flown[0]['queries']} queries\n")
        parts.append(markdown(heading, [_found(row) for row in flown]))
        parts.append(markdown(costs, [_cost(row) for row in flown]))
        if exact:
            parts.append(f"All places compared in full, {exact[0]['queries']} of the queries:")
            also = ("flown, the same queries", "query ms")
            lines = [[*_found(row), _as_flown(row, flown), f"{row['t_query_ms']:.0f}"] for row in exact]
            parts.append(markdown((*heading, *also), lines))
        if unlike:
            parts.append("Without mirrored ground:")
            parts.append(markdown(heading, [_found(row) for row in unlike]))
    machine = content["machine"]
    parts.append("![recall, what is accepted, times and memory as the map grows](sites.png)")
    parts.append(f"Commit {content['commit']}, {content['date']}, {machine['cpu']}. Made by `make sites`.")
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _as_flown(exact: dict, flown: list[dict]) -> str:
    """Return recall@1 as flown of the queries that were asked with all places compared."""
    hits = next((row.get("hits", "") for row in flown if row["places"] == exact["places"]), "")
    same = hits[:: round(len(hits) / exact["queries"])] if hits else ""
    return f"{same.count('+') / len(same):.3f}" if same else "-"


def _by_how(rows: list[dict], camera: str) -> list[list[dict]]:
    """Return the rows of a camera that were flown, exact, and unlike (see `sites.Row`), by places."""
    mine = sorted((row for row in rows if row["camera"] == camera), key=lambda row: row["places"])
    return [[row for row in mine if row["how"] == how] for how in ("flown", "exact", "unlike")]


def _found(row: dict) -> list[str]:
    low, high = row["recall_at_1_interval"] or (float("nan"),) * 2
    where = ", ".join(f"{count} {kind}" for kind, count in sorted(row["wrong_by"].items()))
    accepted = (row["accepted_right"], row["accepted_beside"], row["accepted_wrong"])
    return [
        str(row["places"]),
        str(row["of_sites"]),
        f"{row['recall_at_1']:.3f}",
        f"{low:.3f} to {high:.3f}",
        *map(str, accepted),
        where or "-",
    ]


def _cost(row: dict) -> list[str]:
    times = [f"{row[key]:.1f}" for key in ("t_encode_ms", "t_scan_ms", "t_query_ms", "t_query_p90_ms")]
    each = f"{row['row_bytes']}, with id and position {row['bytes_per_place']}"
    return [str(row["places"]), *times, each, f"{row['peak_mb']:.0f}", f"{row['map_mb']:.0f}"]


def _draw(path: Path, rows: list[dict]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(14, 4.2), layout="constrained")
    for camera, colour in zip(TITLES, ("tab:orange", "tab:blue"), strict=True):
        flown, exact, unlike = _by_how(rows, camera)
        if not flown:
            continue
        title, places = TITLES[camera].lower(), [row["places"] for row in flown]
        recall = [row["recall_at_1"] for row in flown]
        intervals = np.array([row["recall_at_1_interval"] or (np.nan, np.nan) for row in flown])
        axes[0].plot(places, recall, "o-", color=colour, label=f"{title}, {flown[0]['queries']} queries")
        axes[0].fill_between(places, *intervals.T, color=colour, alpha=0.15, linewidth=0)
        for beside, mark, what in ((exact, "x:", "all compared"), (unlike, "s:", "no mirrored ground")):
            if beside:
                label = f"{title}, {what} ({beside[0]['queries']})"
                at = [(row["places"], row["recall_at_1"]) for row in beside]
                axes[0].plot(*zip(*at, strict=True), mark, color=colour, label=label)
        share = [row["accepted_right"] / row["queries"] for row in flown]
        axes[1].plot(places, share, "o-", color=colour, label=f"{title}, right")
        axes[1].plot(
            places, [row["accepted_wrong"] / row["queries"] for row in flown], "x--", color=colour, label="wrong"
        )
        axes[2].loglog(places, [row["t_query_ms"] for row in flown], "o-", color=colour, label=f"{title}, query")
        axes[2].loglog(places, [row["t_scan_ms"] for row in flown], "x--", color=colour, label="scan")
        for axis in axes[:2]:
            axis.axvline(max(row["of_sites"] for row in flown), color=colour, linestyle=":", linewidth=1)
    axes[0].set(title="recall@1 (dotted upright: all sites are in)", ylim=(0.5, 1.01))
    axes[1].set(title="share of the queries accepted", ylim=(-0.02, 1.01))
    axes[2].set(title="time of the processor, ms")
    for axis in axes:
        axis.set(xscale="log", xlabel="places in the map")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)
