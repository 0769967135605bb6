"""The picture of a demonstration: both tracks on the landscape, and queries beside the places they were taken for."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from edgevpr.lab.simulate.camera import ground_to_pixel
from edgevpr.lab.simulate.flight import Flight, to_metres
from edgevpr.lab.simulate.outcome import Answer

_RIGHT, _WRONG, _REJECTED = "#2fbf5b", "#e5383b", "#f5a524"
_PAPER, _INK, _FAINT = "#fbfaf7", "#22262b", "#6b7178"
_MAPPED, _LATER = "#ffffff", "#ffd60a"
_PAIR_ROWS, _PAIR_COLUMNS = 6, 2
_MAP_WIDTH_PX = 1600
_OUTLINE = [withStroke(linewidth=2.5, foreground="#00000099")]


def draw(
    path: Path,
    ground: np.ndarray,
    metres_per_pixel: float,
    mapping: Flight,
    answers: Sequence[Answer],
    map_images: Path,
    query_images: Path,
    headline: str,
) -> None:
    """Write the picture as PNG; `ground` is the lit landscape, uint8 (H, W, 3) BGR."""
    figure = Figure(figsize=(19.2, 10.8), dpi=100, facecolor=_PAPER)
    figure.text(0.0165, 0.953, "edgevpr demo", fontsize=23, fontweight="bold", color=_INK, va="baseline")
    figure.text(0.168, 0.953, headline, fontsize=14, color=_FAINT, va="baseline")
    left, right = figure.subfigures(1, 2, width_ratios=(1.34, 1))
    for part in (left, right):
        part.set_facecolor("none")
    tracks = left.add_axes((0.0285, 0.27, 0.955, 0.65))
    errors = left.add_axes((0.075, 0.065, 0.908, 0.145))
    _draw_tracks(tracks, ground, metres_per_pixel, mapping, answers)
    _draw_errors(errors, answers)
    _draw_pairs(right, answers, map_images, query_images)
    figure.savefig(path, facecolor=_PAPER)


def _draw_tracks(axes: Axes, ground: np.ndarray, metres_per_pixel: float, mapping: Flight, answers: Sequence[Answer]):
    depth_m, width_m = (side * metres_per_pixel for side in ground.shape[:2])
    small = cv2.resize(ground, (_MAP_WIDTH_PX, round(_MAP_WIDTH_PX * depth_m / width_m)), interpolation=cv2.INTER_AREA)
    seen = _seen_by(mapping, small.shape[:2], width_m / _MAP_WIDTH_PX)
    dimmed = np.where(seen[..., None], 0.95 * small, 0.4 * small + 20).astype(np.uint8)
    axes.imshow(dimmed[..., ::-1], extent=(0, width_m, 0, depth_m), interpolation="bilinear")
    places_m = np.array([(pose.east_m, pose.north_m) for pose in mapping.poses])
    taken_m = np.array([to_metres(answer.at.lat_deg, answer.at.lon_deg) for answer in answers])
    named_m = np.array([to_metres(answer.named.lat_deg, answer.named.lon_deg) for answer in answers])
    colours = [_colour(answer) for answer in answers]

    accepted = np.array([answer.accepted for answer in answers])

    axes.plot(*places_m.T, color=_MAPPED, linewidth=1.2, alpha=0.75)
    axes.scatter(*places_m.T, s=26, color=_MAPPED, edgecolor="#00000088", linewidth=0.8, zorder=3)
    axes.plot(*taken_m.T, color=_LATER, linewidth=1.4, alpha=0.9, zorder=3)
    axes.scatter(*taken_m.T, s=46, c=colours, edgecolor="black", linewidth=0.8, zorder=5)
    ways = LineCollection(
        np.stack((taken_m, named_m), axis=1),
        colors=colours,
        linestyles=["solid" if yes else (0, (2, 3)) for yes in accepted],
        linewidths=np.where(accepted, 2.6, 0.9),
        alpha=np.where(accepted, 1.0, 0.55),
        zorder=4,
    )
    axes.add_collection(ways)
    _draw_legend(axes, width_m, depth_m, unmapped_m=(places_m[:, 0].max() + 12 + width_m) / 2)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(False)


def _draw_legend(axes: Axes, width_m: float, depth_m: float, unmapped_m: float) -> None:
    text = {"color": "white", "ha": "center", "path_effects": _OUTLINE}
    axes.plot((width_m - 115, width_m - 15), (14, 14), color="white", linewidth=3, path_effects=_OUTLINE)
    axes.text(width_m - 65, 20, "100 m", fontsize=11, **text)
    tip, tail = (width_m - 22, depth_m - 14), (width_m - 22, depth_m - 46)
    axes.annotate("N", tip, tail, arrowprops={"color": "white", "width": 2.5, "headwidth": 9}, fontsize=11, **text)
    axes.text(unmapped_m, depth_m - 30, "land that is in no map", fontsize=13, style="italic", **text)
    rows = (
        ("flight 1: the places", _MAPPED, "solid", "o"),
        ("flight 2: the queries", _LATER, "solid", ""),
        ("accepted, right place", _RIGHT, "solid", "o"),
        ("accepted, wrong place", _WRONG, "solid", "o"),
        ("rejected: no position is sent", _REJECTED, "dotted", "o"),
    )
    lines = [
        Line2D([], [], color=colour, linestyle=style, marker=marker, markeredgecolor="#000000aa", label=label)
        for label, colour, style, marker in rows
    ]
    box = {"facecolor": "#30343acc", "labelcolor": "white", "edgecolor": "none"}
    axes.legend(handles=lines, loc="lower left", ncols=2, fontsize=10, **box)


def _seen_by(flight: Flight, shape: tuple[int, int], metres_per_pixel: float) -> np.ndarray:
    """Return the ground that is in any picture of a flight, bool (H, W)."""
    camera = flight.camera
    corners = np.array([(0, 0), (camera.width, 0), (camera.width, camera.height), (0, camera.height)], np.float64)
    seen = np.zeros(shape, np.uint8)
    for pose in flight.poses:
        on_ground = cv2.perspectiveTransform(corners[None], np.linalg.inv(ground_to_pixel(pose, camera)))[0]
        pixels = on_ground / metres_per_pixel * (1, -1) + (0, shape[0])
        cv2.fillConvexPoly(seen, pixels.round().astype(np.int32), 1)
    return seen.astype(bool)


def _draw_errors(axes: Axes, answers: Sequence[Answer]) -> None:
    numbers = np.arange(1, len(answers) + 1)
    errors_m = np.maximum([_off_m(answer) for answer in answers], 0.1)
    axes.bar(numbers, errors_m - 0.08, bottom=0.08, width=0.72, color=[_colour(answer) for answer in answers])
    axes.set_yscale("log")
    axes.set_yticks([0.1, 1, 10, 100], ["0.1 m", "1 m", "10 m", "100 m"], fontsize=10, color=_FAINT)
    axes.set_ylim(0.08, 900)
    axes.set_xlim(0.2, len(answers) + 0.8)
    axes.set_xticks([1, *range(5, len(answers) + 1, 5)])
    axes.tick_params(labelsize=10, colors=_FAINT, length=0)
    axes.minorticks_off()
    axes.grid(axis="y", color="#00000018")
    axes.set_axisbelow(True)
    axes.set_facecolor("none")
    axes.spines[:].set_visible(False)
    title = "from each query to its fix, or where there is none to the place that scored best (metres, logarithmic)"
    axes.set_title(title, loc="left", fontsize=11, color=_FAINT, pad=4)
    axes.set_xlabel("query of flight 2", fontsize=10, color=_FAINT, labelpad=1)


def _draw_pairs(figure: SubFigure, answers: Sequence[Answer], map_images: Path, query_images: Path) -> None:
    grid = figure.add_gridspec(
        _PAIR_ROWS, 2 * _PAIR_COLUMNS + 1, width_ratios=(1, 1, 0.08, 1, 1),
        left=0.005, right=0.985, top=0.885, bottom=0.012, hspace=0.2, wspace=0.03,
    )  # fmt: skip
    for number, answer in enumerate(_chosen(answers, _PAIR_ROWS * _PAIR_COLUMNS)):
        row, column = number % _PAIR_ROWS, 3 * (number // _PAIR_ROWS)
        for side, path in enumerate((query_images / answer.query, map_images / answer.reference_image)):
            axes = figure.add_subplot(grid[row, column + side])
            axes.imshow(cv2.resize(cv2.imread(str(path)), (320, 240), interpolation=cv2.INTER_AREA)[..., ::-1])
            axes.set_xticks([])
            axes.set_yticks([])
            axes.spines[:].set(color=_colour(answer), linewidth=4)
            if side == 0:
                axes.set_title(_verdict(answer), loc="left", fontsize=11, color=_INK, pad=5)
            if row == 0:
                heading = ("flight 2: the query", "flight 1: the best place")[side]
                axes.annotate(heading, (0, 1.23), xycoords="axes fraction", fontsize=11, color=_FAINT)


def _chosen(answers: Sequence[Answer], count: int) -> list[Answer]:
    """Choose at most `count` answers, some of each kind, wrong ones first; return them in the order they were flown."""
    wrong = [answer for answer in answers if answer.accepted and not answer.right]
    rejected = _spread([answer for answer in answers if not answer.accepted], count // 4)
    right = [answer for answer in answers if answer.accepted and answer.right]
    chosen = wrong[: count // 4] + rejected
    chosen += _spread(right, count - len(chosen))
    return sorted(chosen, key=lambda answer: answer.query)


def _spread(items: list[Answer], count: int) -> list[Answer]:
    """Choose `count` items (all, where there are fewer) at even distances."""
    if len(items) <= count:
        return items
    return [items[round(at)] for at in np.linspace(0, len(items) - 1, count)]


def _colour(answer: Answer) -> str:
    if not answer.accepted:
        return _REJECTED
    return _RIGHT if answer.right else _WRONG


def _off_m(answer: Answer) -> float:
    return answer.error_m if answer.fix_off_m is None else answer.fix_off_m


def _verdict(answer: Answer) -> str:
    if answer.accepted:
        return f"accepted, {_off_m(answer):.1f} m off, score {answer.score:.3f}"
    where = f"{answer.error_m:.0f} m off" if answer.on_map else "not in the map"
    return f"rejected, {where}, score {answer.score:.3f}"
