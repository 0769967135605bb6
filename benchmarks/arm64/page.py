"""The page of edgevpr on ARM, and what is wrong there."""

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

from arm64.compare import CAMERAS
from arm64.glibc import RELEASES
from arm64.suite import CORE, LEFT_OUT

from edgevpr.core.tables import markdown

_OTHER = ("other_decision", "other_place", "other_refused", "other_words")  # columns of flights
_NOT_PASSED = ("failed", "skipped")
_SAME_MM = 2.0  # positions are told in steps of 1.1 mm
_FEW = 1e-5  # of the values of the fine part and of the landmarks may differ by their last bit, for other roundings


def wrongs(found: dict[str, Any]) -> list[str]:
    """List what is not as on x86-64, a sentence each."""
    said = []
    for each in found.get("tests", {"rows": []})["rows"]:
        said += [f"{each['file']}: {name} failed." for name in each["failed"]]
    flights = found.get("flights", {"maps": [], "flights": []})
    for each in flights["maps"]:
        most = 0 if each["part"] == "coarse" else _FEW * each["numbers"]
        if each["differ"] > most:
            said.append(f"{each['camera']}, seed {each['seed']}: {each['differ']} values of {each['part']} differ.")
    for each in flights["flights"]:
        if each["other_place"] or each["other_decision"] or each["located_mm"] > _SAME_MM:
            said.append(
                f"{each['camera']}, seed {each['seed']}, map made on {each['map_made_on']}: "
                f"{each['other_place']} other places accepted, {each['other_decision']} other decisions, "
                f"{each['located_mm']:.3f} mm apart."
            )
    if (demo := found.get("demo", {}).get("aarch64")) and demo["accepted_wrong"]:
        said.append(f"{demo['accepted_wrong']} matches of the demonstration were wrong.")
    return said


def page(found: dict[str, Any]) -> str:
    """Return the page for people."""
    return "\n\n".join([_head(found), *(show(found[name]) for name, show in _SHOWN.items() if name in found)]) + "\n"


def _head(found: dict[str, Any]) -> str:
    system = found["system"]
    machine = system["machine"]
    packages = ", ".join(f"{name} {version}" for name, version in system["packages"].items())
    tried = ", ".join(f"{name} ({made['date']}, commit {made['commit']})" for name, made in found["made"].items())
    missing = [name for name in _SHOWN if name not in found]
    judged = wrongs(found) or ["Nothing differs in what was tried."]
    if missing:
        judged.append(f"Not tried: {', '.join(missing)}.")
    if "flights" in found:
        flown = {each["camera"] for each in found["flights"]["flights"]}
        judged += [f"Not flown: {camera}." for camera in CAMERAS if camera not in flown]
    if "tests" in found and (files := not_run(found["tests"])):
        judged.append(f"Not run: {len(files)} of {len(found['tests']['files'])} files of tests.")
    return f"""# edgevpr on 64-bit ARM

Made by `make test-arm64` with {system["qemu"]}, emulating a
{system["cpu"]}, on {machine["cores"]} cores of an {machine["cpu"]}. The emulated system is Debian {system["release"]}:
Python {system["python"]}, glibc {system["glibc"]}. edgevpr is installed from its wheel, and all that it needs from
deploy/requirements.lock, with hashes: {packages}.
Here: Python {machine["python"]}, NumPy {machine["numpy"]}, OpenCV {machine["opencv"]}. Tried: {tried}.

**{" ".join(judged)}**"""


def _wheels(found: dict[str, Any]) -> str:
    needed = {
        machine: {python: max(map(tuple, of_python.values())) for python, of_python in of_machine.items()}
        for machine, of_machine in found["named"].items()
    }
    pythons = next(iter(needed.values()))
    rows = [[machine, *(_dotted(least) for least in each.values())] for machine, each in needed.items()]
    oldest = max(least for each in needed.values() for least in each.values())
    first = next(name for version, name in RELEASES.items() if version >= oldest)
    asked = {name: tuple(version) for name, version in found["asked"].items() if tuple(version) >= (2, 24)}
    said = ", ".join(f"{name} {_dotted(version)}" for name, version in sorted(asked.items()))
    return f"""## The oldest system

The least glibc that the names of the locked wheels allow, by processor and Python:

{markdown(("", *pythons), rows)}

So the oldest system is {first}, with a Python of at least {next(iter(pythons))}. The first ones whose own Python will
do are Debian 12, Raspberry Pi OS 12 and Ubuntu 22.04. What the libraries in the wheels for aarch64 ask for themselves,
beyond 2.17: {said}."""


def _flights(found: dict[str, Any]) -> str:
    maps = [
        [
            f"{each['camera']}, seed {each['seed']}: {each['part']}",
            *(str(each[key]) for key in ("numbers", "differ", "most")),
        ]
        for each in found["maps"]
    ]
    flights = [
        [
            f"{each['camera']}, seed {each['seed']}, map made on {each['map_made_on']}",
            *(str(each[key]) for key in ("queries", "accepted", *_OTHER)),
            *(f"{each[key]:.1e}" for key in ("score", "confidence")),
            f"{each['located_mm']:.4f}",
        ]
        for each in found["flights"]
    ]
    heads = (
        "",
        "queries",
        "accepted",
        "other decision",
        "other place accepted",
        "other place refused by both",
        "other words",
        "score",
        "confidence",
        "located, mm",
    )
    return f"""## The same pictures on both

A map of the same 70 pictures made on each: numbers of all places, how many differ, and by how much at most (of
landmarks, which are bits, 2^n is one bit).

{markdown(("", "numbers", "differ", "most"), maps)}

Flights of the same pictures (one of {found["every"]} of the flight) over each map, here and there: how often something
else was decided or told, and the largest differences of score, confidence and accepted position. Decisions are the same
where each query is accepted by both or by none, with the same place and position. Which place a query found that both
refuse is no decision: it is counted apart.

{markdown(heads, flights)}"""


def not_run(found: dict[str, Any]) -> list[str]:
    """List the files of tests that were not run."""
    run = {each["file"] for each in found["rows"]}
    return [file for file in found["files"] if file not in run]


def _briefly(files: list[str], folders: dict[str, int]) -> Iterator[str]:
    """Yield files, and instead of all files of a folder its name."""
    for folder, count in folders.items():
        inside = [file for file in files if _is_in(file, folder)]
        yield from [f"{folder}: all {count} files"] if len(inside) == count > 1 else inside


def _is_in(file: str, folder: str) -> bool:
    return file == folder or file.startswith(f"{folder}/")


def _tests(found: dict[str, Any]) -> str:
    folders = {folder: sum(_is_in(file, folder) for file in found["files"]) for folder in CORE}
    rows = []
    for folder, count in folders.items():
        run = [each for each in found["rows"] if _is_in(each["file"], folder)]
        counts = [sum(each["passed"] for each in run), *(sum(len(each[key]) for each in run) for key in _NOT_PASSED)]
        commits = ", ".join(sorted({each["commit"] for each in run}))
        took_s = sum(each["took_s"] for each in run)
        rows.append([folder, f"{len(run)} of {count}", *map(str, counts), f"{took_s:.0f}", commits])
    reasons = Counter(why for each in found["rows"] for why in each["skipped"].values())
    return f"""## Tests

{markdown(("", "files run", "passed", *_NOT_PASSED, "s", "commit"), rows)}

Skipped, by the tests themselves:

{_listed(f"{count}: {why}" for why, count in reasons.items())}

Not run, as the command was ended before (it goes on with them when it is called again):

{_listed(_briefly(not_run(found), folders))}

Left out:

{_listed(f"{name}: {why}" for name, why in LEFT_OUT.items())}"""


def _listed(lines: Iterable[str]) -> str:
    return "\n".join(f"* {line}" for line in lines) or "* none"


def _demo(found: dict[str, Any]) -> str:
    names = [name for name in found["aarch64"] if name != "not_sent"]
    rows = [[name, *(f"{found[machine][name]:.4g}" for machine in ("x86-64", "aarch64"))] for name in names]
    return f"""## The demonstration

`edgevpr demo` on both, with one of its five legs in the map, and every second picture of the flight over that leg and
of some far from it. Messages are those that the simulated autopilot, which is emulated too, heard.

{markdown(("", "x86-64", "aarch64"), rows)}

Fixes that were not sent on aarch64, and why:

{_listed(f"{count}: {why}" for why, count in found["aarch64"]["not_sent"].items())}"""


def _dotted(version: tuple[int, ...] | list[int]) -> str:
    return ".".join(map(str, version))


_SHOWN = {"wheels": _wheels, "flights": _flights, "tests": _tests, "demo": _demo}
