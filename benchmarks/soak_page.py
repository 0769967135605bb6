"""The verdict over a soak, and its page. A sample is a look at the process `t_s` after its first query:
`away` names what is not there, `is_calm` says that all has been there for a while."""

import base
import numpy as np
from base import Row

GROWTH_MB = 2.0  # asked for: less than that after the first five minutes
_SETTLED_S = 300.0
_SETTLED_PART = 0.1  # of a short run


def growth(samples: list[Row]) -> Row:
    """Compute how memory (RSS) has grown since the flight has settled: the median of the last tenth (`last_mb`) less
    that of as long after settling (`first_mb`)."""
    t_s, values = (np.array([each[name] for each in samples], float) for name in ("t_s", "rss_mb"))
    settled_s = min(_SETTLED_S, _SETTLED_PART * float(t_s[-1]))
    after = t_s >= settled_s
    early = after & (t_s < 2 * settled_s)
    late = t_s >= 0.9 * t_s[-1]
    first_mb = float(np.median(values[early if early.any() else after]))
    last_mb = float(np.median(values[late]))
    return {"settled_s": settled_s, "first_mb": first_mb, "last_mb": last_mb, "grown_mb": last_mb - first_mb}


def verdict(soak: Row) -> list[str]:
    """List what is not as it should be, a sentence each."""
    broken = []
    grown_mb = growth(soak["samples"])["grown_mb"]
    if grown_mb >= GROWTH_MB:
        broken.append(f"memory has grown by {grown_mb:.1f} MB; less than {GROWTH_MB:g} MB are allowed.")
    calm = [each for each in soak["samples"] if each["is_calm"]]
    for name in ("descriptors", "threads"):
        counts = {each[name] for each in calm}
        if len(counts) != 1:
            broken.append(f"the number of {name} is not constant while all is there: {sorted(counts)}.")
    most_mb = max(each["log_mb"] for each in soak["samples"])
    if most_mb > soak["log_limit_mb"]:
        broken.append(f"the flight log took {most_mb:.2f} MB; {soak['log_limit_mb']:g} MB are allowed.")
    if soak["tracebacks"] or soak["exit_code"] not in (0, 1):  # 1: a picture could not be used
        broken.append(f"the flight ended with code {soak['exit_code']} and {soak['tracebacks']} tracebacks.")
    if not soak["statuses"] or not soak["end"].get("accepted"):
        broken.append("no status was read, or no match was accepted: that was no flight.")
    return broken


def page(soak: Row) -> str:
    """Return the page for people."""
    samples, broken = soak["samples"], verdict(soak)
    calm = [each for each in samples if each["is_calm"]]
    memory = growth(samples)
    counts = [
        {"name": name, "calm": _range([each[name] for each in calm]), "all": _range([each[name] for each in samples])}
        for name in ("descriptors", "threads")
    ]
    settled = memory["settled_s"] / 60
    events = "; ".join(f"{name}: {count}" for name, count in soak["events"].items())
    cores = (samples[-1]["cpu_s"] - samples[0]["cpu_s"]) / (samples[-1]["t_s"] - samples[0]["t_s"])
    return f"""# A long flight

Made by `make soak` on {soak["date"]}, commit {soak["commit"]}, {soak["machine"]["cores"]} cores of an
{soak["machine"]["cpu"]}: `edgevpr run` for {samples[-1]["t_s"] / 60:.1f} minutes, {len(samples)} looks from outside.
The camera is an RTSP stream (H.264, 640x480), the autopilot a process of its own over UDP; there are a second link, a
status file, a tlog, and a flight log limited to {soak["log_limit_mb"]:g} MB.

**{"As it should be." if not broken else " ".join(broken)}**

Memory (RSS): {memory["first_mb"]:.2f} MB in the {settled:.1f} minutes after the first {settled:.1f},
{memory["last_mb"]:.2f} MB in the last tenth (medians), {memory["grown_mb"]:+.2f} MB.

What is counted while all is there ({len(calm)} looks), and at any time:

{base.table(counts, {"": "{name}", "all there": "{calm}", "at any time": "{all}"})}

Went away and came back: {events}.
Statuses read: {soak["statuses"]}.

The flight: {soak["end"].get("queries", 0):g} queries, {soak["end"].get("accepted", 0):g} accepted; {cores:.2f} cores;
flight log at most {max(each["log_mb"] for each in samples):.2f} MB, tlog {samples[-1]["tlog_mb"]:.1f} MB;
{soak["tracebacks"]} tracebacks, exit code {soak["exit_code"]}.
"""


def _range(counts: list[int]) -> str:
    if not counts:
        return "-"
    return f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
