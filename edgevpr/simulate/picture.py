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

from edgevpr.simulate.flight import Flight, to_metres
from edgevpr.simulate.outcome import Answer

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
    """Write the picture as PNG. `ground` is the lit landscape, uint8 (H, W, 3) BGR, that both flights were flown over."""
    figure = Figure(figsize=(19.2, 10.8), dpi=100, facecolor=_PAPER)
    figure.text(0.017, 0.955, "edgevpr demo", fontsize=23, fontweight="bold", color=_INK, va="center")
    figure.text(0.142, 0.9535, headline, fontsize=14, color=_FAINT, va="center")
    left, right = figure.subfigures(1, 2, width_ratios=(1.34, 1))
    for part in (left, right):
        part.set_facecolor("none")
    tracks, errors = left.subplots(
        2,
        1,
        height_ratios=(4.6, 1),
        gridspec_kw={"left": 0.03, "right": 0.985, "top": 0.91, "bottom": 0.065, "hspace": 0.1},
    )
    _draw_tracks(tracks, ground, metres_per_pixel, mapping, answers)
    _draw_errors(errors, answers)
    _draw_pairs(right, answers, map_images, query_images)
    figure.savefig(path, facecolor=_PAPER)


def _draw_tracks(axes: Axes, ground: np.ndarray, metres_per_pixel: float, mapping: Flight, answers: Sequence[Answer]):
    depth_m, width_m = (side * metres_per_pixel for side in ground.shape[:2])
    small = cv2.resize(ground, (_MAP_WIDTH_PX, round(_MAP_WIDTH_PX * depth_m / width_m)), interpolation=cv2.INTER_AREA)
    dimmed = (0.72 * small[..., ::-1] + 0.28 * 70).astype(np.uint8)  # so that the tracks stand out
    axes.imshow(dimmed, extent=(0, width_m, 0, depth_m), interpolation="bilinear")
    places_m = np.array([(pose.east_m, pose.north_m) for pose in mapping.poses])
    taken_m = np.array([to_metres(answer.at.lat_deg, answer.at.lon_deg) for answer in answers])
    named_m = np.array([to_metres(answer.named.lat_deg, answer.named.lon_deg) for answer in answers])
    colours = [_colour(answer) for answer in answers]

    axes.plot(*places_m.T, color=_MAPPED, linewidth=1.2, alpha=0.75)
    axes.scatter(*places_m.T, s=26, color=_MAPPED, edgecolor="#00000088", linewidth=0.8, zorder=3)
    axes.plot(*taken_m.T, color=_LATER, linewidth=1.4, alpha=0.9, zorder=3)
    accepted = [answer.accepted for answer in answers]
    for shown, style in ((np.array(accepted), "solid"), (~np.array(accepted), (0, (2, 3)))):
        lines = np.stack((taken_m, named_m), axis=1)[shown]
        line_colours = [colour for colour, show in zip(colours, shown, strict=True) if show]
        strong = style == "solid"
        axes.add_collection(
            LineCollection(
                lines, colors=line_colours, linestyles=[style], linewidths=2.6 if strong else 0.9,
                alpha=1.0 if strong else 0.55, zorder=4,
            )
        )  # fmt: skip
    axes.scatter(*taken_m.T, s=46, c=colours, edgecolor="black", linewidth=0.8, zorder=5)

    axes.plot((width_m - 115, width_m - 15), (14, 14), color="white", linewidth=3, path_effects=_OUTLINE)
    label = {"color": "white", "ha": "center", "path_effects": _OUTLINE, "fontsize": 11}
    axes.text(width_m - 65, 20, "100 m", **label)
    axes.annotate(
        "N",
        (width_m - 22, depth_m - 14),
        (width_m - 22, depth_m - 46),
        arrowprops={"color": "white", "width": 2.5, "headwidth": 9},
        **label,
    )
    axes.text(
        (places_m[:, 0].max() + width_m) / 2 + 12,
        depth_m - 30,
        "land that is in no map",
        **label | {"fontsize": 13, "style": "italic"},
    )
    axes.legend(
        handles=[
            Line2D([], [], color=_MAPPED, marker="o", markeredgecolor="#00000088", label=f"flight 1: {len(places_m)} places"),
            Line2D([], [], color=_LATER, label=f"flight 2: {len(answers)} queries"),
            *(
                Line2D([], [], color=colour, marker="o", markeredgecolor="black", linestyle=style, label=text)
                for colour, style, text in (
                    (_RIGHT, "solid", "accepted, right place"),
                    (_WRONG, "solid", "accepted, wrong place"),
                    (_REJECTED, "dotted", "rejected: nothing is sent"),
                )
            ),
        ],
        loc="lower left", ncols=2, fontsize=10, facecolor="#30343acc", labelcolor="white", edgecolor="none",
    )  # fmt: skip
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(False)


def _draw_errors(axes: Axes, answers: Sequence[Answer]) -> None:
    numbers = np.arange(1, len(answers) + 1)
    errors_m = np.maximum([answer.error_m for answer in answers], 1)
    axes.bar(numbers, errors_m, bottom=0.8, width=0.72, color=[_colour(answer) for answer in answers])
    axes.set_yscale("log")
    axes.set_yticks([1, 10, 100], ["1 m", "10 m", "100 m"], fontsize=10, color=_FAINT)
    axes.set_ylim(0.8, 900)
    axes.set_xlim(0.2, len(answers) + 0.8)
    axes.set_xticks([1, *range(5, len(answers) + 1, 5)])
    axes.tick_params(labelsize=10, colors=_FAINT, length=0)
    axes.minorticks_off()
    axes.grid(axis="y", color="#00000018")
    axes.set_axisbelow(True)
    axes.set_facecolor("none")
    axes.spines[:].set_visible(False)
    title = "from each query to the place that scored best (metres, logarithmic)"
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
            for side, text in enumerate(("flight 2: the query", "flight 1: the best place")):
                axes = figure.axes[-2 + side]
                axes.annotate(text, (0, 1.23), xycoords="axes fraction", fontsize=11, color=_FAINT)


def _chosen(answers: Sequence[Answer], count: int) -> list[Answer]:
    """Some of each kind, in the order they were flown: everything that went wrong first of all."""
    wrong = [answer for answer in answers if answer.accepted and not answer.right]
    rejected = _spread([answer for answer in answers if not answer.accepted], count // 4)
    right = [answer for answer in answers if answer.accepted and answer.right]
    chosen = wrong[: count // 4] + rejected
    chosen += _spread(right, count - len(chosen))
    return sorted(chosen, key=lambda answer: answer.query)


def _spread(items: list[Answer], count: int) -> list[Answer]:
    """`count` items (all, where there are fewer) at even distances."""
    if len(items) <= count:
        return items
    return [items[round(at)] for at in np.linspace(0, len(items) - 1, count)]


def _colour(answer: Answer) -> str:
    if not answer.accepted:
        return _REJECTED
    return _RIGHT if answer.right else _WRONG


def _verdict(answer: Answer) -> str:
    if answer.accepted:
        return f"accepted, {answer.error_m:.0f} m off, score {answer.score:.3f}"
    where = f"{answer.error_m:.0f} m off" if answer.on_map else "not in the map"
    return f"rejected, {where}, score {answer.score:.3f}"
