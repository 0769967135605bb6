"""The table of scenarios: the vehicle, what fails in flight, and the configuration of edgevpr."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from edgevpr.frames.level import STRAIGHT_DOWN, Mount

HEIGHT_M = 100.0
# Positions on the ground, metres east and north.
HOME_M = (240.0, 200.0)
CLIMB_M = (560.0, 230.0)
CIRCUIT_M = ((1060.0, 260.0), (1060.0, 730.0), (340.0, 730.0), (340.0, 260.0))
COPTER_HOME_M = (420.0, 320.0)
COPTER_CIRCUIT_M = ((980.0, 320.0), (980.0, 680.0), (420.0, 680.0), (420.0, 320.0))
COPTER_SPEED_M_S = 7.0
WIND_FROM_DEG = 270.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """A flight: `gps_s` seconds with GPS, then `off_s` without.

    The wind begins with the loss of GPS; then the autopilot also switches to `source_set` (None: it chooses itself). If
    not `loses_gps`, the receiver works on, displaced by `glitch_m_s` per second, or PX4 ignores it (`uses_no_gps`). The
    camera `is_level` on a gimbal, or fixed to the airframe with a `mount` that edgevpr does not know; `is_stamped`: its
    pictures have time stamps. `parameters` are set on the autopilot, those of `with_edgevpr` not in the control;
    `config` are further keys of edgevpr's configuration. The map ends at `mapped_m` north (None: it does not end), from
    where the ground is `beyond_scale` times as far below, and is displaced by `map_east_m`. `is_blind`: the camera
    shows nothing that is in the map. `home_m`: start of the vehicle (None: the usual one). `starts_early`: edgevpr runs
    before arming. `is_compared`: the flight is also made without edgevpr."""

    vehicle: str = "plane"
    is_px4: bool = False
    height_m: float = HEIGHT_M
    gps_s: float = 60.0
    off_s: float = 300.0
    loses_gps: bool = True
    uses_no_gps: bool = False
    wind_m_s: float = 0.0
    glitch_m_s: float = 0.0
    source_set: int | None = None
    is_level: bool = False
    mount: Mount = STRAIGHT_DOWN
    is_stamped: bool = True
    parameters: Mapping[str, float] = field(default_factory=dict)
    with_edgevpr: Mapping[str, float] = field(default_factory=dict)
    config: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    starts_early: bool = False
    mapped_m: float | None = None
    home_m: tuple[float, float] | None = None
    map_east_m: float = 0.0
    is_blind: bool = False
    beyond_scale: float = 1.0
    is_compared: bool = True


def format_flight_name(name: str, seed: int) -> str:
    """Return the name of the flight of a scenario with a seed, such as "plane_wind" or "plane_wind.2"."""
    return name if seed == 1 else f"{name}.{seed}"


def parse_flight_name(flight: str) -> tuple[str, int]:
    """Return the scenario name and the seed of a flight's name; the inverse of `format_flight_name`."""
    name, _, seed = flight.partition(".")
    return name, int(seed or 1)


VEHICLE_PARAMETERS = {
    "plane": {
        "ROLL_LIMIT_DEG": 35,
        "WP_LOITER_RAD": 70,
        "TERRAIN_ENABLE": 0,
        "THR_FAILSAFE": 0,  # there is no transmitter
        "FS_SHORT_ACTN": 3,
        "FS_LONG_ACTN": 0,
    },
    "copter": {"FS_THR_ENABLE": 0, "FS_GCS_ENABLE": 0},
}

_FLOW = {  # an optical-flow sensor and a range finder with enough range, as the second source set
    "FLOW_TYPE": 10,
    "SIM_FLOW_ENABLE": 1,
    "RNGFND1_TYPE": 100,
    "RNGFND1_MIN": 0,
    "RNGFND1_MAX": 150,
    "EK3_SRC2_POSXY": 0,
    "EK3_SRC2_VELXY": 5,
    "EK3_SRC2_POSZ": 1,
    "EK3_SRC2_VELZ": 0,
    "EK3_SRC2_YAW": 1,
}
GPS_INPUT = {"GPS2_TYPE": 14, "GPS_AUTO_SWITCH": 1}
ODOMETRY = {
    "VISO_TYPE": 1,
    "EK3_SRC2_POSXY": 6,
    "EK3_SRC2_VELXY": 0,
    "EK3_SRC2_POSZ": 1,
    "EK3_SRC2_VELZ": 0,
    "EK3_SRC2_YAW": 1,
}

AGP = {"EKF2_AGP0_CTRL": 1, "EKF2_AGP0_ID": 1, "EKF2_AGP0_DELAY": 0.0}  # PX4: uses message 296 (GLOBAL_POSITION_SENSOR)

SCENARIOS = {
    "plane_wind": Scenario(wind_m_s=6.0),
    "plane_rare": Scenario(wind_m_s=6.0, config={"source": {"rate_hz": 0.1}}, is_compared=False),
    "plane_still": Scenario(),
    "plane_level": Scenario(wind_m_s=6.0, is_level=True, config={"source": {"gimbal": True}}),
    "plane_mjpeg": Scenario(wind_m_s=6.0, is_stamped=False, is_compared=False),
    "plane_mounted": Scenario(wind_m_s=6.0, gps_s=300.0, mount=Mount(7.0, -4.0), is_compared=False),
    "copter_flow": Scenario(vehicle="copter", source_set=2, parameters=_FLOW),
    "copter_gps_input": Scenario(vehicle="copter", with_edgevpr=GPS_INPUT, starts_early=True),
    "copter_off_map": Scenario(
        vehicle="copter", with_edgevpr=GPS_INPUT, starts_early=True, mapped_m=450.0, is_compared=False
    ),
    "copter_odometry": Scenario(vehicle="copter", source_set=2, with_edgevpr=ODOMETRY, starts_early=True),
    "plane_glitch": Scenario(loses_gps=False, glitch_m_s=5.0, off_s=60.0),
    "plane_clean": Scenario(loses_gps=False, off_s=1800.0, is_compared=False),
    "px4_copter": Scenario(is_px4=True, vehicle="copter", with_edgevpr=AGP),
    "px4_plane": Scenario(is_px4=True, wind_m_s=6.0, with_edgevpr=AGP),
    "px4_plane_still": Scenario(is_px4=True, is_compared=False),  # command 43003; the simulator of 1.17.0 has no wind
    "px4_copter_unused": Scenario(
        is_px4=True,
        vehicle="copter",
        with_edgevpr=AGP,
        loses_gps=False,
        uses_no_gps=True,
        off_s=120.0,
        is_compared=False,
    ),
    "px4_copter_vision": Scenario(is_px4=True, vehicle="copter", with_edgevpr={"EKF2_EV_CTRL": 1}, is_compared=False),
}
