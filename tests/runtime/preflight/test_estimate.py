"""What is said before take-off: the figures by hand, the notes that must not be missing, the table."""

import json
from dataclasses import asdict, replace

import pytest

from edgevpr.core.errors import UsageError
from edgevpr.core.types import StageCost
from edgevpr.power.boards import MachineSpeed, load_board
from edgevpr.power.equations import parse_pack
from edgevpr.runtime.preflight import accuracy
from edgevpr.runtime.preflight.estimate import FlightPlan
from edgevpr.runtime.preflight.estimate import estimate as estimate_of
from edgevpr.runtime.preflight.probe import TechniqueCosts
from edgevpr.runtime.preflight.trial import Trial

COSTS = {
    "regions": TechniqueCosts(
        encode=StageCost(0.1, 0.1),
        match_per_place=StageCost(0.004, 0.004),
        ram_bytes_per_place=1_000,
        disk_bytes_per_place=124_000,
        process_mb=90.0,
    ),
    "vector": TechniqueCosts(
        encode=StageCost(0.05, 0.1),
        match_per_place=StageCost(0.001, 0.002),
        ram_bytes_per_place=286_000,
        disk_bytes_per_place=286_000,
        process_mb=90.0,
    ),
}
PLAN = FlightPlan(
    places=100, rate_hz=1.0, flight_min=20.0, pack=parse_pack("4S5200"), regulator_efficiency=0.85, budget_mb=256
)
PI = load_board("rpi-4b")
NOBODY = MachineSpeed(single=None, multi=None, products=None, passes=None, verified=False, source="nobody")
NO_HOVER = "Give the hover power of the aircraft (--hover-w W) to see how many minutes of flight this costs."


def found(recall, wrong=0):
    accepted = {"accepted": 30, "accepted_wrong": wrong, "accepted_elsewhere": wrong}
    return {"recall_at_1": recall, "sets": 2, "queries": 100, "asked": 120, **accepted}


@pytest.fixture(autouse=True)
def accuracies(monkeypatch):
    table = {
        "regions": found(0.9),
        "vector": found(0.5),
        "cohog": found(0.9),
        "hog": found(0.4),
        "hog 1bit": found(0.2),
    }
    monkeypatch.setattr(accuracy, "_content", lambda: {"forward": table, "nadir": {}})
    return table


def trials(costs, stored=False):
    return [
        (Trial(label=label, name=label.split()[0], settings={}, costs=each), stored) for label, each in costs.items()
    ]


def estimate(board, here, costs, plan, *more):
    return estimate_of(board, here, trials(costs), plan, *more)


def test_a_flight_on_the_board_itself_by_hand():
    regions, vector = estimate(PI, PI, COSTS, PLAN).techniques
    assert (regions.technique, regions.fits, vector.fits) == ("regions", True, True)
    assert (regions.map_ram_mb, regions.map_disk_mb, regions.process_ram_mb) == pytest.approx((0.1, 12.4, 90.1))
    assert (regions.t_encode_s, regions.t_match_s) == pytest.approx((0.1, 0.4))
    assert (regions.u_encode, regions.u_match) == pytest.approx((0.25, 0.25))  # one of four cores
    assert (vector.u_encode, vector.u_match) == pytest.approx((0.5, 0.5))
    assert regions.reachable_hz == pytest.approx(2.0)
    volt_hours = 14.8 * 0.85 * 3600
    assert regions.query_mah == pytest.approx(1000 * (2.29 + 4.53 * 0.25) * 0.5 / volt_hours, abs=1e-9)
    assert regions.query_marginal_mah == pytest.approx(1000 * 4.53 * 0.25 * 0.5 / volt_hours, abs=1e-9)
    # 1200 queries; the board idles from start to end, and the queries come on top.
    marginal_j, idle_j = 1200 * 4.53 * 0.25 * 0.5, 1200 * 2.29
    assert regions.flight_marginal_mah == pytest.approx(1000 * marginal_j / volt_hours, abs=1e-6)
    assert regions.flight_mah == pytest.approx(1000 * (idle_j + marginal_j) / volt_hours, abs=1e-6)
    assert regions.flight_pack_frac == pytest.approx(regions.flight_mah / 5200)


def test_a_rate_out_of_reach_is_not_charged_for():
    fast = estimate(PI, PI, COSTS, replace(PLAN, rate_hz=50.0)).techniques[0]
    reached = estimate(PI, PI, COSTS, replace(PLAN, rate_hz=2.0)).techniques[0]
    assert not fast.fits
    assert fast.flight_mah == pytest.approx(reached.flight_mah)


def test_a_technique_that_does_not_fit_says_why_and_what_would():
    rows = estimate(PI, PI, COSTS, replace(PLAN, places=2000)).techniques
    assert [row.fits for row in rows] == [False, False]
    late = "a query takes 8.1 s, and no fix of a frame older than 5 s is ever sent"
    assert rows[0].shortfalls == ("it reaches 0.12 Hz of 1", late)
    assert rows[0].remedies == ("with up to 225 places",), "at 0.12 Hz none of its fixes would be sent"
    assert "its map takes 572.0 MB of RAM and 256.0 are allowed" in rows[1].shortfalls


def test_figures_of_the_machine_itself_are_measured_and_carry_no_note():
    found = estimate(PI, PI, COSTS, PLAN)
    assert (found.times, found.verified, found.notes) == ("measured", True, (NO_HOVER,))


def test_figures_of_another_board_are_scaled_and_say_so():
    found = estimate(PI, load_board("generic-x86"), COSTS, PLAN)
    assert found.times == "scaled"
    assert found.techniques[0].t_encode_s == pytest.approx(0.1 / found.ratios.passes)
    assert found.ratios.products == 0.056
    assert found.notes[0].startswith(
        "The times are scaled from this machine, not measured on this board: networks and full comparisons to 0.056 of "
        "its speed, everything else to 0.19 (unverified; the board by 7-zip"
    )
    assert found.notes[1] == (
        "Those of cohog are the instructions that it takes on an ARM core (`make bench-arm64`), at 1741 million a "
        "second."
    )


def test_cohog_on_an_arm_board_does_not_depend_on_how_fast_this_machine_is():
    slow = replace(COSTS["regions"], encode=StageCost(9.0, 9.0))
    quick, slowed = (
        estimate(PI, load_board("generic-x86"), {"cohog": costs}, PLAN).techniques[0]
        for costs in (COSTS["regions"], slow)
    )
    assert quick.t_encode_s == slowed.t_encode_s < 0.05


def test_a_busy_machine_is_said():
    costs = {"regions": replace(COSTS["regions"], waited=0.34)}
    (note,) = (each for each in estimate(PI, PI, costs, PLAN).notes if "busy" in each)
    assert note.startswith("This machine was busy: while techniques were tried, other programs had it for 34% of the")
    assert not any("busy" in each for each in estimate(PI, PI, COSTS, PLAN).notes)


def test_a_board_whose_products_are_not_known_apart_says_so():
    found = estimate(load_board("odroid-xu4"), load_board("generic-x86"), COSTS, PLAN)
    assert found.notes[0].endswith("; its products are not known apart: 0.15 of its single thread.")


def test_figures_for_a_board_of_unknown_speed_are_unscaled_and_say_so():
    found = estimate(load_board("thesis-xeon"), PI, COSTS, PLAN)
    assert found.times == "unscaled"
    assert found.techniques[0].t_encode_s == 0.1
    assert (
        "not measured on this board: the speed of the thesis's server (Xeon Gold 6134) is not known" in found.notes[0]
    )


def test_a_machine_of_unknown_speed_is_named_when_its_times_cannot_be_scaled():
    here = replace(load_board("generic-x86"), title="this machine (Radxa)", benchmark_score=NOBODY)
    found = estimate(PI, here, COSTS, PLAN)
    assert "the speed of this machine (Radxa) is not known (nobody)" in found.notes[0]


def test_unverified_power_is_said_with_its_source():
    board = load_board("rpi-zero-2w")
    found = estimate(board, board, COSTS, PLAN)
    assert not found.verified
    assert found.notes == (f"The power of Raspberry Pi Zero 2 W is unverified: {board.source}.", NO_HOVER)


def test_the_estimate_is_ready_for_json():
    there_and_back = json.loads(json.dumps(asdict(estimate(PI, PI, COSTS, PLAN))))
    assert there_and_back["plan"]["pack"] == {"cells": 4, "capacity_mah": 5200}
    assert there_and_back["techniques"][1]["technique"] == "vector"
    assert there_and_back["techniques"][1]["fits"] is True


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"places": 0}, "The number of places is 0: give a number above 0."),
        ({"places": -5}, "The number of places is -5: give a number above 0."),
        ({"rate_hz": 0.0}, "The rate in Hz is 0: give a number above 0."),
        ({"flight_min": -20.0}, "The length of the flight in minutes is -20: give a number above 0."),
        ({"flight_min": float("nan")}, "The length of the flight in minutes is nan: give a number above 0."),
        ({"budget_mb": float("inf")}, "The budget in MB is inf: give a number above 0."),
        ({"min_recall": 0.0}, "The least recall is 0: give a number above 0."),
        ({"min_recall": 1.5}, "The least recall is 1.5: give a share of the queries, up to 1."),
        ({"hover_w": 0.0}, "The hover power in W is 0: give a number above 0."),
        ({"hover_w": float("nan")}, "The hover power in W is nan: give a number above 0."),
    ],
)
def test_a_plan_that_makes_no_sense_is_one_sentence(change, sentence):
    with pytest.raises(UsageError) as raised:
        replace(PLAN, **change)
    assert str(raised.value) == sentence


def test_minutes_lost_by_hand():
    found = estimate(PI, PI, COSTS, replace(PLAN, hover_w=180.0))
    regions = found.techniques[0]
    pack_wh, idle_w, marginal_w = 14.8 * 5.2, 2.29 / 0.85, 4.53 * 0.25 * 0.5 / 0.85
    whole, idling, flying = (60 * pack_wh / (180 + more) for more in (0, idle_w, idle_w + marginal_w))
    assert regions.lost_min == pytest.approx(whole - flying, rel=1e-9)
    assert regions.lost_marginal_min == pytest.approx(idling - flying, rel=1e-9)
    assert found.notes == ()
    longer = estimate(PI, PI, COSTS, replace(PLAN, hover_w=180.0, flight_min=40.0)).techniques[0]
    assert longer.lost_min == pytest.approx(regions.lost_min), "it is power that counts, not how long was planned"


def test_without_a_hover_power_nothing_is_said_to_be_lost():
    assert estimate(PI, PI, COSTS, PLAN).techniques[0].lost_min is None


FORMS = {
    "cohog": COSTS["regions"],
    "hog": COSTS["vector"],
    "hog 1bit": replace(COSTS["vector"], ram_bytes_per_place=17_900),
}


def test_the_most_accurate_that_fits_is_recommended_and_why():
    found = estimate(replace(PI, technique=None), PI, FORMS, PLAN)
    assert found.recommended == "cohog"
    assert found.reason == (
        "cohog: nothing that fits finds more: recall@1 0.90 on 2 image sets, 30 of 120 accepted, 0 wrong; 90 of 512 "
        "MB, 2 Hz where 1 are asked, 25% of the CPU during a query, and 15 mAh a flight beside the 60.7 of the idle "
        "board."
    )
    assert [row.on_front for row in found.techniques] == [True, True, False]
    cheapest = estimate(replace(PI, technique=None), PI, FORMS, replace(PLAN, min_recall=0.3))
    assert cheapest.recommended == "hog"
    assert "hog: it is the cheapest with a recall@1 of at least 0.3: recall@1 0.40 on" in cheapest.reason
    nothing = estimate(PI, PI, FORMS, replace(PLAN, min_recall=0.95))
    assert nothing.reason == "None: nothing that fits has a recall@1 of 0.95; the most is 0.90."


def test_what_has_accepted_wrong_places_is_not_recommended_and_says_why(accuracies):
    accuracies["hog"] = found(0.95, wrong=3)
    rows = estimate(PI, PI, FORMS, PLAN)
    assert rows.recommended == "cohog"
    assert rows.techniques[1].objection == "hog accepted 3 wrong places in 120 queries: name it to use it"
    for label in accuracies:
        accuracies[label] = found(0.9, wrong=1)
    assert estimate(PI, PI, FORMS, PLAN).reason.startswith(
        "None: of what fits Raspberry Pi 4B, 64-bit nothing is chosen by itself: cohog accepted 1 wrong places in 120 "
    )


def test_the_boards_own_technique_goes_before_a_better_one_if_it_fits():
    own = replace(PI, technique="hog")
    assert estimate(own, PI, FORMS, PLAN).recommended == "hog"
    assert estimate(own, PI, FORMS, replace(PLAN, places=190, budget_mb=1.0)).recommended == "cohog"


def test_with_a_map_only_what_its_file_can_serve_is_recommended():
    found = estimate(PI, PI, FORMS, replace(PLAN, places=200, budget_mb=20.0), "hog")
    assert found.recommended == "hog 1bit"
    assert found.reason.startswith(
        "hog 1bit: the map was built with hog, and nothing that fits finds more: recall@1 0."
    )
    nothing = estimate(PI, PI, FORMS, PLAN, "netvlad")
    assert (nothing.recommended, nothing.reason) == (
        None, "None: the map was built with netvlad, which cannot be used here."
    )  # fmt: skip


def test_where_nothing_fits_the_reason_says_what_would():
    found = estimate(PI, PI, COSTS, replace(PLAN, places=2000))
    assert found.recommended is None
    assert found.reason == (
        "None: nothing that was tried fits Raspberry Pi 4B, 64-bit; what would fit is regions with up to 225 places, "
        "or vector with up to 895 places."
    )
    tiny = replace(PI, memory_max_mb=64.0)
    assert estimate(tiny, PI, COSTS, PLAN).reason.endswith("; use a larger board.")


def test_what_cannot_be_used_is_kept_beside_and_the_date_only_where_it_counts():
    broken = (Trial(label="calc", name="calc", settings={}, problem="There is no model `calc`."), False)
    stored = trials({"cohog": COSTS["regions"]}, stored=True)
    found = estimate_of(PI, PI, [*stored, *trials({"hog": COSTS["vector"]}), broken], PLAN, None, "today")
    assert found.unusable == {"calc": "There is no model `calc`."}
    assert [row.measured for row in found.techniques] == [True, False]
    assert found.measured_on == "today"
    assert estimate_of(PI, PI, trials(COSTS), PLAN, None, "today").measured_on is None
