"""The watch over our own positions: withdrawn where they cannot be right, back with proof."""

import math
from dataclasses import replace

import pytest
from fakes import make_receiver, make_vehicle

from edgevpr.core.geodesy import offset_position
from edgevpr.mavlink.messages import MAX_TEXT_BYTES, Severity
from edgevpr.runtime.flight.output import Output, OutputWatch

HOME = 50.0, 8.0
BEGIN_S = 1000.0
OFF_RECEIVER = {"off_m": 15.1}
REFUSING = {"ratio": 1.01, "has_gps": False}


def list_withdrawn(*reports):
    """What is withdrawn after reports: so many seconds after the first, how far the estimate is from its receiver, the
    ratio of its innovation, and how long ago a position was sent and a match was believed."""
    watch = OutputWatch()
    for after_s, known in reports:
        known = {"off_m": 0.0, "ratio": 0.1, "has_gps": True, "sd_m": 1.0, "steady_s": 60.0} | known
        t_s, has_gps = BEGIN_S + after_s, known["has_gps"]
        if known.get("sent_ago_s") != math.inf:
            watch.record_sent(t_s - known.get("sent_ago_s", 0.0))
        receiver = make_receiver(HOME, known["sd_m"], t_s, steady_for_s=known["steady_s"]) if has_gps else None
        vehicle = make_vehicle(*offset_position(*HOME, known["off_m"], 0.0), t_s, has_gps=has_gps, gps=receiver)
        last_fix_s = t_s - known.get("fixed_ago_s", math.inf)
        watch.update(replace(vehicle, innovation_ratio=known["ratio"]), last_fix_s, has_gps)
    return watch.withdrawn


@pytest.mark.parametrize(
    ("last_s", "known", "output"),
    [
        (2.0, OFF_RECEIVER, Output.LEADS_AWAY),
        (1.9, OFF_RECEIVER, None),
        (2.0, {"off_m": 14.9}, None),
        (2.0, {"off_m": 20.1, "sd_m": 5.0}, Output.LEADS_AWAY),
        (2.0, {"off_m": 19.9, "sd_m": 5.0}, None),
        (2.0, OFF_RECEIVER | {"steady_s": 3.0}, Output.LEADS_AWAY),
        (2.0, OFF_RECEIVER | {"steady_s": 2.9}, None),
        (2.0, OFF_RECEIVER | {"sent_ago_s": 10.0}, Output.LEADS_AWAY),
        (2.0, OFF_RECEIVER | {"sent_ago_s": 10.1}, None),
        (2.0, OFF_RECEIVER | {"sent_ago_s": math.inf}, None),
        (2.0, OFF_RECEIVER | {"fixed_ago_s": 5.0}, None),
        (2.0, OFF_RECEIVER | {"fixed_ago_s": 5.1}, Output.LEADS_AWAY),
        (2.0, OFF_RECEIVER | {"has_gps": False}, None),
        (3.0, REFUSING, Output.REFUSED),
        (2.9, REFUSING, None),
        (3.0, REFUSING | {"ratio": 1.0}, None),
        (3.0, REFUSING | {"ratio": None}, None),
        (3.0, REFUSING | {"has_gps": True}, None),
        (3.0, REFUSING | {"sent_ago_s": 1.0}, Output.REFUSED),
        (3.0, REFUSING | {"sent_ago_s": 1.1}, None),
        (3.0, REFUSING | {"fixed_ago_s": 5.0}, None),
        (3.0, REFUSING | {"fixed_ago_s": 5.1}, Output.REFUSED),
    ],
)
def test_output_withdraws_positions_that_mislead_or_are_refused(last_s, known, output):
    assert list_withdrawn((0.0, known), (1.0, known), (last_s, known)) is output
    assert list_withdrawn((0.0, known), (1.0, {}), (last_s, known)) is None, "not all the time"


@pytest.mark.parametrize(
    ("known", "output"),
    [
        ({"fixed_ago_s": 10.0}, Output.LEADS_AWAY),
        ({"fixed_ago_s": 9.9}, None),
        ({"has_gps": False}, Output.LEADS_AWAY),
        ({}, Output.LEADS_AWAY),
    ],
)
def test_positions_are_withdrawn_until_a_match_or_gps_proves_them(known, output):
    led_away = (0.0, OFF_RECEIVER), (2.0, OFF_RECEIVER)
    assert list_withdrawn(*led_away, (12.0, known)) is output
    back = {"has_gps": True} | known
    assert list_withdrawn(*led_away, (12.1, back)) is (None if back["has_gps"] else output)
    assert list_withdrawn(*led_away, (11.5, OFF_RECEIVER), (12.1, OFF_RECEIVER)) is Output.LEADS_AWAY


@pytest.mark.parametrize("output", Output)
def test_text_of_an_output_fits_a_status_text(output):
    assert isinstance(output.severity, Severity)
    assert len("edgevpr: " + output.text) <= MAX_TEXT_BYTES
