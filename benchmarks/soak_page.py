"""The verdict over a soak, and its page: soak.json, soak.md and soak.png."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.text import markdown

GROWTH_MB = 2.0  # asked for: less than that after the first five minutes
_SETTLED_S = 300.0
_SETTLED_PART = 0.1  # of a short run


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """A look at the process `t_s` after its first query. `away` names what is not there, `is_calm` says that all has
    been there for a while."""

    t_s: float
    rss_mb: float
    pss_mb: float
    uss_mb: float
    descriptors: int
    threads: int
    cpu_s: float
    log_mb: float
    tlog_mb: float
    away: str
    is_calm: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Soak:
    """A whole run: how often each thing went away (`events`), how many `statuses` were read, how the flight ended,
    and the numbers of the log's last line (`end`)."""

    samples: list[Sample]
    events: dict[str, int]
    statuses: int
    exit_code: int
    tracebacks: int
    warnings: int
    log_limit_mb: float
    end: dict[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Growth:
    """How memory has grown since the flight has settled: the median of the last tenth less that of as long after
    settling (`grown_mb`), and the slope of all in between (Theil and Sen)."""

    settled_s: float
    first_mb: float
    last_mb: float
    slope_mb_h: float

    @property
    def grown_mb(self) -> float:
        return self.last_mb - self.first_mb


def growth(samples: list[Sample], what: str = "rss_mb") -> Growth:
    """Compute the growth of one of the figures in MB."""
    t_s, values = (np.array([getattr(each, name) for each in samples], float) for name in ("t_s", what))
    settled_s = min(_SETTLED_S, _SETTLED_PART * float(t_s[-1]))
    after = t_s >= settled_s
    early = after & (t_s < 2 * settled_s)
    late = t_s >= 0.9 * t_s[-1]
    return Growth(
        settled_s=settled_s,
        first_mb=float(np.median(values[early if early.any() else after])),
        last_mb=float(np.median(values[late])),
        slope_mb_h=3600 * _slope(t_s[after], values[after]),
    )


def verdict(soak: Soak) -> list[str]:
    """List what is not as it should be, a sentence each."""
    broken = []
    grown = growth(soak.samples)
    if grown.grown_mb >= GROWTH_MB:
        broken.append(f"memory has grown by {grown.grown_mb:.1f} MB; less than {GROWTH_MB:g} MB are allowed.")
    calm = [each for each in soak.samples if each.is_calm]
    for name in ("descriptors", "threads"):
        counts = {getattr(each, name) for each in calm}
        if len(counts) != 1:
            broken.append(f"the number of {name} is not constant while all is there: {sorted(counts)}.")
    most_mb = max(each.log_mb for each in soak.samples)
    if most_mb > soak.log_limit_mb:
        broken.append(f"the flight log took {most_mb:.2f} MB; {soak.log_limit_mb:g} MB are allowed.")
    if soak.tracebacks or soak.exit_code not in (0, 1):  # 1: a picture could not be used
        broken.append(f"the flight ended with code {soak.exit_code} and {soak.tracebacks} tracebacks.")
    if not soak.statuses or not soak.end.get("accepted"):
        broken.append("no status was read, or no match was accepted: that was no flight.")
    return broken


def write_page(out: Path, soak: Soak, made: dict[str, Any]) -> None:
    """Write the figures, the page and the picture into a folder."""
    broken = verdict(soak)
    result = {
        **made,
        "broken": broken,
        **{name: asdict(growth(soak.samples, name)) for name in _MEMORY},
        **asdict(soak),
    }
    (out / "soak.json").write_text(json.dumps(result, indent=1) + "\n")
    page = _page(soak, made, broken)
    (out / "soak.md").write_text(page)
    draw(out / "soak.png", soak)
    print(page)


_MEMORY = {"rss_mb": "RSS", "pss_mb": "PSS", "uss_mb": "USS"}


def _page(soak: Soak, made: dict[str, Any], broken: list[str]) -> str:
    samples, minutes = soak.samples, soak.samples[-1].t_s / 60
    grown = {name: growth(samples, name) for name in _MEMORY}
    calm = [each for each in samples if each.is_calm]
    memory = [
        [title, f"{one.first_mb:.2f}", f"{one.last_mb:.2f}", f"{one.grown_mb:+.2f}", f"{one.slope_mb_h:+.2f}"]
        for title, one in zip(_MEMORY.values(), grown.values(), strict=True)
    ]
    counts = [
        [name, _range([getattr(each, name) for each in calm]), _range([getattr(each, name) for each in samples])]
        for name in ("descriptors", "threads")
    ]
    settled = grown["rss_mb"].settled_s / 60
    events = "; ".join(f"{name}: {count}" for name, count in soak.events.items())
    cores = (samples[-1].cpu_s - samples[0].cpu_s) / (samples[-1].t_s - samples[0].t_s)
    return f"""# A long flight

Made by `make soak` on {made["date"]}, commit {made["commit"]}, {made["machine"]["cores"]} cores of an
{made["machine"]["cpu"]}: `edgevpr run` for {minutes:.1f} minutes, {len(samples)} looks from outside. The camera is an
RTSP stream (H.264, 640x480), the autopilot a process of its own over UDP; there are a second link, a status socket, a
tlog, and a flight log limited to {soak.log_limit_mb:g} MB.

**{"As it should be." if not broken else " ".join(broken)}**

Memory: medians of the {settled:.1f} minutes after the first {settled:.1f}, and of the last tenth.

{markdown(("", "first, MB", "last, MB", "grown, MB", "slope, MB/h"), memory)}

RSS is what was asked about; PSS and USS also change with other programs that use the same libraries.

What is counted while all is there ({len(calm)} looks), and at any time:

{markdown(("", "all there", "at any time"), counts)}

Went away and came back: {events}.
Statuses read: {soak.statuses}.

The flight: {soak.end.get("queries", 0):g} queries, {soak.end.get("accepted", 0):g} accepted; {cores:.2f} cores; flight
log at most {max(each.log_mb for each in samples):.2f} MB, tlog {samples[-1].tlog_mb:.1f} MB; {soak.tracebacks}
tracebacks, exit code {soak.exit_code}.

![memory, descriptors and threads, and files over time](soak.png)
"""


def draw(path: Path, soak: Soak) -> None:
    """Draw the figures over time; what is away is shaded."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    samples = soak.samples
    t_min = np.array([each.t_s for each in samples]) / 60
    figure, all_axes = pyplot.subplots(4, 1, figsize=(10, 9), sharex=True, height_ratios=(2, 1.2, 1.2, 1))
    resident, shared, counts, files = all_axes
    for name, axes, colour in zip(_MEMORY, (resident, shared, shared), ("#1f5fa8", "#d97a1c", "#3f8f4f"), strict=True):
        one = growth(samples, name)
        label = _MEMORY[name]
        if name == "rss_mb":
            label += f": {one.grown_mb:+.2f} MB since the first minutes (less than {GROWTH_MB:g} are allowed)"
            axes.axhspan(one.first_mb, one.first_mb + GROWTH_MB, color="#1f5fa8", alpha=0.08, linewidth=0)
            axes.axvline(one.settled_s / 60, color="grey", linestyle=":", linewidth=1)
        axes.plot(t_min, [getattr(each, name) for each in samples], color=colour, linewidth=1.2, label=label)
    for axes in (resident, shared):
        axes.set_ylabel("memory, MB")
        axes.legend(loc="lower right", fontsize=9)
    counts.step(t_min, [each.descriptors for each in samples], where="mid", color="#1f5fa8", label="descriptors")
    counts.step(t_min, [each.threads for each in samples], where="mid", color="#a83232", label="threads")
    counts.set_ylabel("count")
    counts.set_ylim(bottom=0)
    counts.legend(loc="lower right", fontsize=9)
    files.plot(t_min, [each.log_mb for each in samples], color="#1f5fa8", linewidth=1.2, label="flight log")
    files.plot(t_min, [each.tlog_mb for each in samples], color="#777777", linewidth=1.2, label="tlog")
    files.axhline(soak.log_limit_mb, color="#1f5fa8", linestyle=":", linewidth=1)
    files.set_ylabel("files, MB")
    files.set_xlabel("minutes of flight (shaded: something is away)")
    files.legend(loc="upper left", fontsize=9)
    is_away = np.array([bool(each.away) for each in samples])
    for axes in all_axes:
        axes.fill_between(t_min, 0, 1, is_away, transform=axes.get_xaxis_transform(), color="#eeeeee", zorder=0)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xlim(0, t_min[-1])
    figure.align_ylabels()
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _slope(t_s: np.ndarray, values: np.ndarray) -> float:
    """Return the median of the slopes of all pairs, per second; of many, of the pairs of every few samples."""
    step = max(1, len(t_s) // 400)
    t_s, values = t_s[::step], values[::step]
    before, after = np.triu_indices(len(t_s), 1)
    if not len(before):
        return 0.0
    return float(np.median((values[after] - values[before]) / (t_s[after] - t_s[before])))


def _range(counts: list[int]) -> str:
    if not counts:
        return "-"
    return f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
