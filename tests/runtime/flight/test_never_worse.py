"""An aircraft that would be fine alone is fine with edgevpr: flights in closed loop, each beside its control."""

import pytest
from closed_loop import ClosedLoop

pytestmark = pytest.mark.slow

WATCHED_S, SETTLED_S = 120.0, 40.0
NO_WORSE_M = 3.0
GPS_INPUT = {"SIM_GPS1_TYPE": 5, "GPS2_TYPE": 14}  # the receiver's fix is a plain 3D one, as ours is

with_and_without_matches = pytest.mark.parametrize("matches", [True, False], ids=["matches", "no matches"])


def assert_no_worse(vehicle, event, *, matches=True, **parameters):
    """Fly twice, with and without edgevpr, and let an `event` happen to the autopilot in each flight."""
    worst = []
    for edgevpr in (False, True):
        flight = ClosedLoop(vehicle, edgevpr=edgevpr, matches=matches, **parameters).fly(SETTLED_S)
        event(flight)
        worst.append(flight.fly(WATCHED_S).worst_m(SETTLED_S))
    (alone_away_m, alone_error_m), (away_m, error_m) = worst
    worse_m = {"away": round(away_m - alone_away_m, 1), "estimate": round(error_m - alone_error_m, 1)}
    assert max(worse_m.values()) <= NO_WORSE_M, worse_m


@with_and_without_matches
@pytest.mark.parametrize("satellites", [4, 5])
def test_receiver_with_few_satellites_is_not_outbid(satellites, matches):
    def lose_satellites(flight):
        flight.set("SIM_GPS1_NUMSATS", satellites)

    assert_no_worse("arducopter", lose_satellites, matches=matches, **GPS_INPUT)
