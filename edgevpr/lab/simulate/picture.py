"""The picture of a demonstration: both tracks on the landscape, and queries beside the places they were taken for."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D

from edgevpr.core.arrays import Doubles, Image
from edgevpr.core.types import Position
from edgevpr.lab.simulate.camera import view_on_ground
from edgevpr.lab.simulate.generated import SCENE_DEPTH_M, SCENE_WIDTH_M, GeneratedFlight, to_metres
from edgevpr.lab.simulate.outcome import JudgedAnswer

_RIGHT, _WRONG, _REJECTED = "#2fbf5b", "#e5383b", "#f5a524"
_INK, _FAINT = "#22262b", "#6b7178"
_MAPPED, _LATER = "#ffffff", "#ffd60a"
_ROWS, _COLUMNS = 6, 2  # of pairs of a query and a place
_MAP_SIZE_PX = (1600, round(1600 * SCENE_DEPTH_M / SCENE_WIDTH_M))
_LEGEND: tuple[tuple[str, str, Literal["solid", "dotted"], str], ...] = (
    ("flight 1: the places", _MAPPED, "solid", "o"),
    ("flight 2: the queries", _LATER, "solid", ""),
    ("accepted, right place", _RIGHT, "solid", "o"),
    ("accepted, wrong place", _WRONG, "solid", "o"),
    ("rejected: no position is sent", _REJECTED, "dotted", "o"),
)


@dataclass(frozen=True, slots=True)
class DemoPicture:
    """All that is drawn: the answers of the second flight, the first one, and the folders of the pictures of both."""

    answers: Sequence[JudgedAnswer]
    mapping: GeneratedFlight
    map_images: Path
    query_images: Path

    def draw(self, path: Path, ground: Image, headline: str) -> None:
        """Write the picture as PNG; `ground` is the lit landscape, uint8 (H, W, 3) BGR."""
        figure = Figure(figsize=(19.2, 10.8), dpi=100, facecolor="#fbfaf7")
        figure.text(0.0165, 0.953, "edgevpr demo", fontsize=23, fontweight="bold", color=_INK)
        figure.text(0.168, 0.953, headline, fontsize=14, color=_FAINT)
        left, right = np.asarray(figure.subfigures(1, 2, width_ratios=(1.34, 1)))
        for part in (left, right):
            part.set_facecolor("none")
        self._draw_tracks(left.add_axes((0.0285, 0.15, 0.955, 0.7)), ground)
        self._draw_pairs(right)
        figure.savefig(path, facecolor=figure.get_facecolor())

    def _draw_tracks(self, axes: Axes, ground: Image) -> None:
        small = cv2.resize(ground, _MAP_SIZE_PX, interpolation=cv2.INTER_AREA)
        dimmed = np.where(self._mapped_ground()[..., None], 0.95 * small, 0.4 * small + 20).astype(np.uint8)
        axes.imshow(dimmed[..., ::-1], extent=(0, SCENE_WIDTH_M, 0, SCENE_DEPTH_M), interpolation="bilinear")
        places_m = np.array([(pose.east_m, pose.north_m) for pose in self.mapping.poses])
        taken_m, named_m = (_in_metres([getattr(each, of) for each in self.answers]) for of in ("at", "named"))
        colours = [_colour(answer) for answer in self.answers]
        accepted = np.array([answer.accepted for answer in self.answers])
        axes.plot(places_m[:, 0], places_m[:, 1], color=_MAPPED, linewidth=1.2, alpha=0.75, marker="o", markersize=5)
        axes.plot(taken_m[:, 0], taken_m[:, 1], color=_LATER, linewidth=1.4, alpha=0.9, zorder=3)
        axes.scatter(taken_m[:, 0], taken_m[:, 1], 46, c=colours, edgecolor="black", linewidth=0.8, zorder=5)
        ways = LineCollection(
            [np.stack(ends) for ends in zip(taken_m, named_m, strict=True)],
            colors=colours,
            linestyles=["solid" if yes else "dotted" for yes in accepted],
            linewidths=np.where(accepted, 2.6, 0.9).tolist(),
            zorder=4,
        )
        axes.add_collection(ways)
        axes.plot((SCENE_WIDTH_M - 115, SCENE_WIDTH_M - 15), (14, 14), color="white", linewidth=3)
        axes.text(SCENE_WIDTH_M - 65, 20, "100 m", fontsize=11, color="white", ha="center")
        lines = [
            Line2D([], [], color=colour, linestyle=style, marker=marker, markeredgecolor="#000000aa", label=label)
            for label, colour, style, marker in _LEGEND
        ]
        box = {"facecolor": "#30343acc", "labelcolor": "white", "edgecolor": "none"}
        axes.legend(handles=lines, loc="lower left", ncols=2, fontsize=10, **box)
        _bare(axes)

    def _mapped_ground(self) -> Image:
        """Return the ground that is in any picture of the first flight, uint8 (H, W), 1 or 0."""
        seen = np.zeros(_MAP_SIZE_PX[::-1], np.uint8)
        for pose in self.mapping.poses:
            if (corners_m := view_on_ground(pose, self.mapping.camera)) is not None:
                pixels = (corners_m * (1, -1) + (0, SCENE_DEPTH_M)) * _MAP_SIZE_PX[0] / SCENE_WIDTH_M
                cv2.fillConvexPoly(seen, pixels.round().astype(np.int32), 1)
        return seen

    def _draw_pairs(self, figure: SubFigure) -> None:
        grid = figure.add_gridspec(
            _ROWS, 2 * _COLUMNS + 1, width_ratios=(1, 1, 0.08, 1, 1),
            left=0.005, right=0.985, top=0.885, bottom=0.012, hspace=0.2, wspace=0.03,
        )  # fmt: skip
        for number, answer in enumerate(_chosen(self.answers, _ROWS * _COLUMNS)):
            row, column = number % _ROWS, 3 * (number // _ROWS)
            for side, path in enumerate((self.query_images / answer.query, self.map_images / answer.reference_image)):
                axes = figure.add_subplot(grid[row, column + side])
                axes.imshow(np.asarray(cv2.imread(str(path)))[::2, ::2, ::-1])
                _bare(axes)
                axes.spines[:].set(visible=True, color=_colour(answer), linewidth=4)
                if side == 0:
                    axes.set_title(_verdict(answer), loc="left", fontsize=11, color=_INK, pad=5)


def _bare(axes: Axes) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(False)


def _in_metres(positions: Sequence[Position]) -> Doubles:
    return np.array([to_metres(position.lat_deg, position.lon_deg) for position in positions])


def _chosen(answers: Sequence[JudgedAnswer], count: int) -> list[JudgedAnswer]:
    """Choose at most `count` answers, all that are wrong, and others at even distances, as they were flown."""
    wrong = [answer for answer in answers if answer.accepted and not answer.right][:count]
    others = [answer for answer in answers if answer not in wrong]
    at = np.linspace(0, len(others) - 1, min(count - len(wrong), len(others))).round().astype(int)
    return sorted([*wrong, *(others[index] for index in at)], key=lambda answer: answer.query)


def _colour(answer: JudgedAnswer) -> str:
    if not answer.accepted:
        return _REJECTED
    return _RIGHT if answer.right else _WRONG


def _verdict(answer: JudgedAnswer) -> str:
    if answer.fix_off_m is not None:
        return f"accepted, {answer.fix_off_m:.1f} m off, score {answer.score:.3f}"
    where = f"{answer.error_m:.0f} m off" if answer.on_map else "not in the map"
    return f"rejected, {where}, score {answer.score:.3f}"
