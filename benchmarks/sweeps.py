"""How far may the aircraft be off its map? One thing is changed at a time, by degrees: `make sweeps`.

Looking down (aerial_swindale, on which nothing was tuned): the queries, of other flights than the map, are laid over
each other as a mosaic. Over it a camera of 66 degrees across stands where a place of the map was taken, and is then
turned, tilted, raised or shifted, over ground that is taken to be flat. So what it sees beyond the place's own picture
is real, as far as the flights went. Asked for are the places of whose picture the mosaic covers at least eight tenths,
in those views of which it covers seven tenths; `asked` says how many. Right are the place itself and those of which, or
of the view, three tenths are common; others that touch the view, or could not be laid beside it, count neither way.

Looking ahead (corridor, on which parameters were tuned): 24 of the queries. A turn is exact. Shift and distance are
those of a wall: a picture that moves aside or shrinks. A corridor is none: enlarged, it looks as from farther along, so
that wrong places accepted there are three to eight on. Beyond the edge of a picture there is nothing: 40 degrees of yaw
leave two fifths of it.

Where a view shows nothing it is black and masked, so no edge of it is taken for one of the world. A change of the
picture starts from the view that is not turned. Techniques are opened as they fly; maps of `cohog` are refined and
calibrated as `map build` does. The networks run on the one that edgevpr ships, `calc`. `seqslam` needs a flight.

What is measured of a set stays in sweeps_work/, so that an interrupted run goes on.
"""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import base
import cv2
import numpy as np
import walks
from base import RESULTS, Row, camera_of
from from_orthophoto import laid, mosaic_of
from height_and_tilt import OVERLAP, TOUCHING, area, corners, cut, through
from sweep_changes import NONE, OF_CAMERA, SWEEPS, spoilt, view

from edgevpr import techniques
from edgevpr.core.types import Frame, Vehicle
from edgevpr.frames.images import read_image
from edgevpr.frames.level import UNKNOWN_VIEW, Levelled
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.techniques import create

SETS = ("aerial_swindale", "corridor")  # one that looks down, one that looks ahead
TECHNIQUES = tuple(name for name in techniques.names() if name != "seqslam")  # which asks with several pictures
WORK = Path("sweeps_work")
_MOST_ASKED = 24
_LEAST_COVERED, _LEAST_SHOWN = 0.8, 0.7


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """Where a sweep starts from: `ground`, a picture or a mosaic, `covered` bool where there is any, and `onto` (3, 3)
    from it to the picture of `size` (width, height) before any change. `right` are the names of places that are right
    whatever changes, `ignored` of those that count neither way, `lies` the corners of other places on the ground."""

    name: str
    ground: np.ndarray
    covered: np.ndarray
    onto: np.ndarray
    size: tuple[int, int]
    right: frozenset[str]
    ignored: frozenset[str]
    lies: dict[str, np.ndarray]


class Shown:
    """Takes pictures as they are, with the mask of the one that is asked for."""

    mask: np.ndarray | None = None

    def prepare(self, frame: Frame, vehicle: Vehicle | None, overlay: np.ndarray | None, **_: object) -> Levelled:
        """Return the picture with the mask."""
        return Levelled(frame.image, self.mask, UNKNOWN_VIEW)


Asked = tuple[Recogniser, Shown, list[str]]  # a walk over a map, what it is shown, and the places' names by slot


def main() -> None:
    rows: list[Row] = []
    for folder in base.find_sets(names=SETS):
        rows += base.kept(WORK / f"{folder.name}.json", partial(swept, folder))
    found = {**base.made_by(), "rows": rows}
    base.write("sweeps", found, page(found))
    draw(rows, RESULTS / "sweeps.png")


def swept(folder: Path) -> list[Row]:
    """Return what each technique finds in its map of a set, at all levels of all sweeps."""
    camera = camera_of(folder.name)
    starts = list(_over_mosaic(folder) if camera == "nadir" else _ahead(folder))
    rows = [{"set": folder.name, "camera": camera, "technique": name, "levels": []} for name in TECHNIQUES]
    with ExitStack() as stack:
        asked = []
        for name in TECHNIQUES:
            technique, shown = create(name, {"camera": camera} if name == "cohog" else {}), Shown()
            place_map, index, _ = stack.enter_context(walks.map_of(folder, technique, folder / "ref"))
            walk = walks.walk(place_map, index, technique, levelling=shown)
            asked.append((walk, shown, walks.names_of(place_map, index)))
        unchanged = _asked(asked, starts, camera, "yaw", 0)
        for sweep, level in ((key, level) for key, each in SWEEPS.items() for level in each.of(camera)):
            is_none = level == NONE.get(sweep, 0)
            found = unchanged if is_none else _asked(asked, starts, camera, sweep, level)
            for row, each in zip(rows, found, strict=True):
                row["levels"].append({"sweep": sweep, "level": level, **each})
    return rows


def _asked(asked: list[Asked], starts: list[Start], camera: str, sweep: str, level: float) -> list[Row]:
    """Ask every technique for the place of every start, at one level of a sweep: how many were `asked`, how much of
    their views showed anything, and which were accepted for which wrong place."""
    shares, found = [], [{"hits": [], "accepted": 0, "wrong": []} for _ in asked]
    for number, start in enumerate(starts):
        rng = np.random.default_rng((number, list(SWEEPS).index(sweep)))
        change = view(camera, sweep, level, start.size, rng) if sweep in OF_CAMERA else np.eye(3)
        image, mask = seen(start, change @ start.onto)
        if camera == "nadir" and mask.mean() < _LEAST_SHOWN:
            continue
        if sweep not in OF_CAMERA:
            image = spoilt(sweep, level, image, rng)
        shares.append(mask.mean())
        common = _common(start, change @ start.onto)
        right = start.right | {place for place, share in common.items() if share >= OVERLAP}
        ignored = start.ignored | {place for place, share in common.items() if TOUCHING < share < OVERLAP}
        for (walk, shown, names), of_it in zip(asked, found, strict=True):
            shown.mask = None if mask.all() else mask
            event = walk.step(walks.frame(image, start.name))
            ranked = walks.ranked(event, names)
            of_it["hits"].append(next((place for place in ranked if place not in ignored), None) in right)
            of_it["accepted"] += event.accepted
            if event.accepted and ranked[0] not in right | ignored:
                of_it["wrong"].append((start.name, ranked[0]))
    return [
        {
            "asked": len(shares),
            "shown": round(float(np.mean(shares)), 3) if shares else 0.0,
            "recall_at_1": round(float(np.mean(each["hits"])), 4) if shares else None,
            "accepted": each["accepted"],
            "accepted_wrong": len(each["wrong"]),
            "wrong": each["wrong"],
        }
        for each in found
    ]


def seen(start: Start, onto: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what a camera sees of the ground, black where there is none, and bool where there is any."""
    width, height = start.size
    finer = np.diag([2.0, 2.0, 1.0])  # seen at twice the resolution, so that ground from high up does not flicker
    fine = cv2.warpPerspective(start.ground, finer @ onto, (2 * width, 2 * height))
    mask = cv2.warpPerspective(start.covered.view(np.uint8), onto, start.size, flags=cv2.INTER_NEAREST)
    mask = cv2.erode(mask, np.ones((3, 3), np.uint8), borderValue=1).astype(bool)
    image = cv2.resize(fine, start.size, interpolation=cv2.INTER_AREA)
    image[~mask] = 0
    return image, mask


def _common(start: Start, onto: np.ndarray) -> dict[str, float]:
    """Return what each other place and a view have in common, as a share of the smaller of both."""
    width, height = start.size
    ground = through(np.linalg.inv(onto), corners(np.empty((height, width))))
    return {name: area(cut(ground, lies)) / min(area(ground), area(lies)) for name, lies in start.lies.items()}


def _over_mosaic(folder: Path) -> Iterator[Start]:
    """Start where places of the map were taken, over the mosaic of the queries."""
    on = laid(folder)
    ground, covered = mosaic_of(folder, on, "query")
    every = sorted(path.name for path in (folder / "ref").iterdir())
    images = {name: read_image(folder / "ref" / name) for name in every if name in on.middle}
    there = {name: np.vstack([on.matrix(name, image), [0, 0, 1]]) for name, image in images.items()}
    lies = {name: through(there[name], corners(image)) for name, image in images.items()}
    starts = [
        Start(
            name=name,
            ground=ground,
            covered=covered,
            onto=np.linalg.inv(there[name]),
            size=image.shape[1::-1],
            right=frozenset([name]),
            ignored=frozenset(every) - frozenset(images),
            lies={other: each for other, each in lies.items() if other != name},
        )
        for name, image in images.items()
    ]
    yield from _some([start for start in starts if seen(start, start.onto)[1].mean() >= _LEAST_COVERED])


def _ahead(folder: Path) -> Iterator[Start]:
    """Start from the queries of a set that looks ahead."""
    for query in _some(walks.dataset_of(folder).queries):
        image = read_image(query.path)
        yield Start(
            name=query.path.name,
            ground=image,
            covered=np.ones(image.shape[:2], bool),
            onto=np.eye(3),
            size=image.shape[1::-1],
            right=query.right,
            ignored=query.ignored,
            lies={},
        )


def _some(starts):
    """Return at most `_MOST_ASKED` of all, evenly spread."""
    return [starts[at] for at in np.unique(np.linspace(0, len(starts) - 1, _MOST_ASKED).round().astype(int))]


def page(found: Row) -> str:
    """Return the page for people."""
    parts = ["# How far off the map", base.told(__doc__, "What is measured")]
    parts.append("![recall@1 and accepted queries against each change](sweeps.png)")
    for name, rows in base.groups(found["rows"], lambda row: row["set"]):
        columns = {"change": "{change}", "level": "{level:g}", "asked": "{asked}", "shown": "{shown:.2f}"}
        lines = []
        for levels in zip(*(row["levels"] for row in rows), strict=True):
            sweep = SWEEPS[levels[0]["sweep"]]
            lines.append({**levels[0], "change": f"{sweep.title}, {sweep.unit}"})
            for row, level in zip(rows, levels, strict=True):
                lines[-1][row["technique"]] = base.cell("{recall_at_1:.2f} ({accepted}, {accepted_wrong})", level)
        columns |= {row["technique"]: f"{{{row['technique']}}}" for row in rows}
        parts.append(f"## {name} ({base.use_of(name).replace('tune', 'tuned on')})")
        parts.append("recall@1; in brackets accepted and, of these, wrong.")
        parts.append(base.table(lines, columns))
    return "\n\n".join([*parts, base.made_line(found, "make sweeps")])


def draw(found: list[Row], path: Path) -> None:
    """Draw recall against each change, two lines of panels a set, and of `cohog` what was accepted."""
    sets = dict(base.groups(found, lambda row: row["set"]))
    columns = -(-len(SWEEPS) // 2)
    drawn, axes = base.panels(2.3 * columns, 4.4 * len(sets), 2 * columns * len(sets), 2 * len(sets), sharey=True)
    for number, (name, rows) in enumerate(sets.items()):
        of_set = axes[2 * columns * number :][: 2 * columns]
        of_set[0].set_ylabel(f"{name}\n({base.use_of(name)})", fontsize=9)
        for axis, (key, sweep) in zip(of_set, SWEEPS.items(), strict=False):
            for colour, row in enumerate(rows):
                _curve(axis, row, key, "tab:orange" if row["technique"] == "cohog" else f"C{colour + (colour > 0)}")
            axis.set(xlabel=sweep.unit, ylim=(-0.03, 1.03))
            axis.set_title(sweep.title, fontsize=9)
        for axis in of_set[len(SWEEPS) :]:
            axis.set_visible(False)
    handles, labels = axes[0].get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside lower center", ncols=6, fontsize=9, frameon=False)
    base.save(drawn, path, 70)


def _curve(axis, row: Row, sweep: str, colour: str) -> None:
    levels = [level for level in row["levels"] if level["sweep"] == sweep and level["asked"]]
    name, at = row["technique"], [level["level"] for level in levels]
    recall, width = [level["recall_at_1"] for level in levels], 2 if name == "cohog" else 0.9
    axis.plot(at, recall, "o-", ms=1.5 * width, lw=width, color=colour, label=f"{name}, recall@1")
    if name == "cohog":
        right = [(level["accepted"] - level["accepted_wrong"]) / level["asked"] for level in levels]
        axis.plot(at, right, "--", color=colour, label="cohog, accepted and right")
        wrong = [level["accepted_wrong"] / level["asked"] or None for level in levels]
        axis.plot(at, wrong, "x", color="red", ms=5, zorder=9, label="cohog, accepted and wrong")
    if sweep in ("dark", "height"):
        axis.set_xscale("log")
        axis.set_xticks(at[::2], [f"{level:g}" for level in at[::2]])
        axis.minorticks_off()
    if sweep in ("dark", "jpeg") and not axis.xaxis_inverted():
        axis.invert_xaxis()


if __name__ == "__main__":
    base.run(main)
