"""The picture of an estimate: what must be on it, and that labels stay apart."""

import itertools
from dataclasses import replace

import pytest

pytest.importorskip("matplotlib", reason="pictures need matplotlib")

from edgevpr.core.text import figure
from edgevpr.core.types import StageCost
from edgevpr.power.boards import load_board
from edgevpr.power.equations import parse_pack
from edgevpr.runtime.preflight import chart
from edgevpr.runtime.preflight.estimate import FlightPlan, estimate
from edgevpr.runtime.preflight.probe import TechniqueCosts
from edgevpr.runtime.preflight.trial import Trial

PI = load_board("rpi-4b")
COSTS = TechniqueCosts(
    encode=StageCost(0.1, 0.1),
    match_per_place=StageCost(1e-6, 1e-6),
    ram_bytes_per_place=1_000,
    disk_bytes_per_place=124_000,
    process_mb=90.0,
)
PLAN = FlightPlan(
    places=1000, rate_hz=1.0, flight_min=20.0, pack=parse_pack("4S5200"), regulator_efficiency=0.85, budget_mb=256
)


def estimated(labels, plan=PLAN, costs=COSTS):
    return estimate(
        PI, PI, [(Trial(label=label, name=label, settings={}, costs=costs), False) for label in labels], plan
    )


def test_techniques_limits_and_boards_are_on_the_picture(tmp_path):
    path = tmp_path / "chart.svg"
    monstrous = replace(COSTS, ram_bytes_per_place=1_000_000)
    result = estimate(
        PI,
        PI,
        [
            (Trial(label="hog", name="hog", settings={}, costs=monstrous), False),
            (Trial(label="calc 1bit", name="calc", settings={}, costs=COSTS), False),
        ],
        PLAN,
    )
    chart.plot(result, path)
    drawn = path.read_text()
    names = ("hog", "calc 1bit", "rpi-3a-plus, rpi-zero-2w", "rpi-3b, rpi-3b-plus, rpi-4b", "thesis-xeon")
    limits = ("recall@1 on image sets, looking ahead", "pack, less idle: 5139 mAh")
    for words in (*names, *limits, "Raspberry Pi 4B, 64-bit: 1000 places"):
        assert f"<!-- {words}" in drawn, words


def test_it_is_a_picture_that_can_be_opened(tmp_path):
    chart.plot(estimated(["cohog"]), tmp_path / "chart.png")
    assert (tmp_path / "chart.png").read_bytes().startswith(b"\x89PNG")


def test_nothing_to_draw_is_a_picture_without_points(tmp_path):
    chart.plot(estimated([]), tmp_path / "chart.png")
    assert (tmp_path / "chart.png").stat().st_size > 1000


def test_names_of_points_in_one_place_do_not_cover_each_other():
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    drawn = figure(7, 6)
    axes = drawn.add_subplot()
    axes.set(xscale="log", yscale="log", xlim=(0.1, 100), ylim=(10, 1000))
    drawn.draw_without_rendering()
    points = [(f"technique{n} 8bit", 2.0 + 0.01 * n, 100.0 + n) for n in range(24)]
    chart._label(axes, points)
    renderer = FigureCanvasAgg(drawn).get_renderer()
    boxes = [text.get_window_extent(renderer) for text in axes.texts]
    frame = axes.get_window_extent(renderer)
    assert len(boxes) == 24
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))
    assert all(frame.x0 < box.x0 and box.x1 < frame.x1 for box in boxes)
