"""Test the closed loop of edgevpr, whose positions an autopilot flies by, and the autopilot, whose attitude edgevpr
uses: `python benchmarks/loop.py` flies simulated autopilots and writes benchmarks/results/loop.md.

The filter of a simulated autopilot tilts with the errors of its input. Each flight lasts two minutes, with one change;
three last half an hour on our stream alone. Then the factor of the claimed accuracy is swept.
"""

import itertools
from unittest import mock

import base
from closed_loop import ClosedLoop

from edgevpr.runtime.flight import navigator

SETTLE_DURATION_S = 40.0
FLIGHT_DURATION_S = 120.0
LONG_FLIGHT_DURATION_S = 1800.0
ODOMETRY = {"VISO_TYPE": 1, "EK3_SRC2_POSXY": 6}
SET_UPS = {
    "GPS_INPUT": ("arducopter", {"SIM_GPS1_TYPE": 5, "GPS2_TYPE": 14}),
    "ODOMETRY (ArduPilot)": ("arducopter", ODOMETRY),
    "GLOBAL_POSITION_SENSOR": ("px4-copter", {"EKF2_AGP0_CTRL": 1}),
    "ODOMETRY (PX4)": ("px4-copter", {"EKF2_AGP0_CTRL": 0, "EKF2_EV_CTRL": 1}),
}
CHANGES = {
    "nothing": {},
    **{f"answers {late_s:g} s late": {"late_s": late_s} for late_s in (0.1, 0.25, 0.5, 1.0, 2.0)},
    **{f"times {time_s:+g} s wrong": {"time_error_s": time_s} for time_s in (-0.3, -0.1, 0.1, 0.3)},
    **{f"odometry scale {scale:g}": {"stride_scale": scale} for scale in (0.7, 0.9, 1.1, 1.4)},
    **{f"camera tilted by {tilt_deg:g} degrees": {"mount_tilt_deg": tilt_deg} for tilt_deg in (-5.0, -2.0, 2.0, 5.0)},
    **{f"heading wrong by {error_deg:g} degrees": {"heading_error_deg": error_deg} for error_deg in (-15.0, 15.0)},
}
FACTORS = (1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0)
FACTOR_CHANGES = ("nothing", "answers 1 s late", "times +0.3 s wrong", "odometry scale 0.7")
MAV_CMD_SET_EKF_SOURCE_SET = 42007


def fly_without_gps(name: str, changes: dict[str, float]) -> dict[str, float]:
    """Fly by our stream alone after GPS is lost, with a match each second. Returns the largest distances, metres."""
    vehicle, parameters = SET_UPS[name]
    flight = ClosedLoop(vehicle, **parameters).fly(SETTLE_DURATION_S)
    for field, value in changes.items():
        setattr(flight, field, value)
    if parameters == ODOMETRY:
        flight.command(MAV_CMD_SET_EKF_SOURCE_SET, 2)
    return fly_and_measure(flight.set("SIM_GPS1_ENABLE", 0), FLIGHT_DURATION_S)


def fly_with_gps(match_every: int | None) -> dict[str, float]:
    """Fly half an hour by our ODOMETRY alone beside good GPS, with a match every `match_every` frames (None: never)."""
    flight = ClosedLoop("arducopter", matches=match_every is not None, **ODOMETRY).fly(SETTLE_DURATION_S)
    flight.match_every = match_every or 1
    flight.command(MAV_CMD_SET_EKF_SOURCE_SET, 2)
    return fly_and_measure(flight, LONG_FLIGHT_DURATION_S)


def fly_with_factor(name: str, factor: float) -> list[float]:
    """Fly with this factor of the claimed accuracy. Returns the largest distance by FACTOR_CHANGES, metres."""
    is_px4 = "px4" in SET_UPS[name][0]
    with mock.patch.object(navigator, "PX4_CORRELATION_FACTOR" if is_px4 else "CORRELATION_FACTOR", factor):
        flights = [fly_without_gps(name, {"show_tilt": is_px4, **CHANGES[change]}) for change in FACTOR_CHANGES]
    return [max(row["away_m"], row["away_later_m"]) for row in flights]


def fly_and_measure(flight: ClosedLoop, seconds: float) -> dict[str, float]:
    """Fly for `seconds`, and return the largest distances, metres: of the aircraft from its target in each half of that
    time, and of the autopilot's estimate from the truth."""
    first = len(flight.away_m)
    flight.fly(seconds)
    half = (first + len(flight.away_m)) // 2
    return {
        "away_m": round(max(flight.away_m[first:half]), 1),
        "away_later_m": round(max(flight.away_m[half:]), 1),
        "error_m": round(max(flight.error_m[first:]), 1),
    }


def format_page(rows: list[dict], factors: list[dict]) -> str:
    """Return the results as Markdown."""
    columns = {
        "positions by": "{set_up}",
        "changed": "{changed}",
        "away, first half": "{away_m:.1f}",
        "away, second half": "{away_later_m:.1f}",
        "estimate": "{error_m:.1f}",
    }
    worst = {change: f"{{worst_m[{number}]:.1f}}" for number, change in enumerate(FACTOR_CHANGES)}
    return f"""# The loop of an autopilot that flies by edgevpr

An autopilot that flies by our positions tilts with their errors, and we use its attitude. Simulated autopilots hover in
closed loop, 60 m above ground, for two minutes each. *Away*: largest distance of the aircraft from its target in each
half of the flight; *estimate*: that of the autopilot's estimate from the truth; metres. In a stable loop, none grows.

{base.format_table(rows, columns, left=2)}

Autopilots treat the ten positions of a second as independent, which ours are not: so we multiply their claimed standard
deviation by a factor: {navigator.CORRELATION_FACTOR:.1f} for ArduPilot, {navigator.PX4_CORRELATION_FACTOR:g} for PX4
while matches show the error of its attitude, as they do here. Below: the largest distance of the aircraft from its
target, metres, by this factor. A smaller factor is closer to the true error, but the loop may become unstable.

{base.format_table(factors, {"positions by": "{set_up}", "factor": "{factor:g}", **worst})}
"""


def main() -> None:
    rows = []
    for name, (changed, changes) in itertools.product(SET_UPS, CHANGES.items()):
        rows.append({"set_up": name, "changed": f"no GPS, {changed}", **fly_without_gps(name, changes)})
        print(rows[-1], flush=True)
    for match_every, match_text in ((1, "a match each second"), (10, "a match each ten seconds"), (None, "no match")):
        changed = f"30 minutes beside good GPS, {match_text}"
        rows.append({"set_up": "ODOMETRY (ArduPilot)", "changed": changed, **fly_with_gps(match_every)})
        print(rows[-1], flush=True)
    sweep = itertools.product(SET_UPS, FACTORS)
    factors = [{"set_up": name, "factor": factor, "worst_m": fly_with_factor(name, factor)} for name, factor in sweep]
    result = {**base.describe_run(), "rows": rows, "factors": factors}
    origin = base.format_origin(result, "python benchmarks/loop.py")
    base.write("loop", result, f"{format_page(rows, factors)}\n{origin}")


if __name__ == "__main__":
    base.run(main)
