"""The table of the sweep: set-ups, events, their combinations (cells), and the control flight of each cell."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from scenarios import AGP, GPS_INPUT, ODOMETRY, Scenario

WATCH_S = 120.0
MAP_END_M = 500.0  # northern end of the map; beyond it the height of the ground changes
CENTRE_M = (700.0, 500.0)  # of a plane's circle, half of which is beyond the end of the map
RADIUS_M = 200.0
HOVER_AT_M = (600.0, 450.0)  # where a copter hovers
LEG_M = ((700.0, 320.0), (700.0, 900.0))  # the leg of a copter that leaves the map
PLANE_HOME_M = (300.0, 500.0)
ODOMETRY_SET = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class SetUp:
    """An autopilot: its `parameters` for edgevpr only, `common` ones for the control, too, and edgevpr's `config`."""

    vehicle: str = "copter"
    is_px4: bool = False
    parameters: Mapping[str, float] = field(default_factory=dict)
    common: Mapping[str, float] = field(default_factory=dict)
    config: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def control_name(self) -> str:
        """The name of the set-up of the same autopilot without edgevpr."""
        return f"{'px4_' * self.is_px4}{self.vehicle}"

    @property
    def sends_with_gps(self) -> bool:
        """True if edgevpr also sends positions while the autopilot has GPS."""
        return bool({"GPS2_TYPE", "VISO_TYPE"} & set(self.parameters))


@dataclass(frozen=True, slots=True)
class Step:
    """An action, `at_s` after the start of the watched time: the name of a method of `Trial` and its arguments."""

    at_s: float
    action: str
    values: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """What happens in a flight: actions (with values) `before` take-off, and `steps` in flight.

    The control is the same flight without edgevpr, or also with edgevpr if `control_has_edgevpr`; `control` names its
    event (None: this one). GPS works again from `gps_back_s`; from `silent_s`, edgevpr must send no position. With
    `leaves_map`, a copter flies along LEG_M, a plane on its circle, and the map ends at MAP_END_M; beyond it the ground
    is `beyond_scale` times as far below. With `parameters_come_late`, the autopilot gets the parameters of the set-up
    only by the action `adopt`."""

    steps: tuple[Step, ...] = ()
    before: tuple[tuple[str, tuple[float, ...]], ...] = ()
    control: str | None = None
    control_has_edgevpr: bool = False
    gps_back_s: float | None = None
    silent_s: float | None = None
    leaves_map: bool = False
    beyond_scale: float = 1.0
    parameters_come_late: bool = False


@dataclass(frozen=True, slots=True)
class Flight:
    """One flight: the names of its set-up and event, and the kind of its matches (of MATCHES; "" without edgevpr). It
    may be flown several times, with different `number`s."""

    set_up: str
    event: str
    matches: str = ""
    number: int = 1

    @property
    def name(self) -> str:
        name = "-".join(filter(None, (self.set_up, self.event, self.matches)))
        return name if self.number == 1 else f"{name}.{self.number}"

    @property
    def has_edgevpr(self) -> bool:
        return bool(self.matches)

    def make_scenario(self) -> Scenario:
        """Return the scenario of the flight, for the rig."""
        set_up, event = SET_UPS[self.set_up], EVENTS[self.event]
        # A displaced map claims the usual accuracy, not that of the rig's own map, whose places are exact to a metre.
        accuracy = {"min_accuracy_m": 5.0} if self.matches in ("displaced", "wrong") else {}
        homes_m = {"plane": PLANE_HOME_M, "copter": LEG_M[0] if event.leaves_map else HOVER_AT_M}
        return Scenario(
            vehicle=set_up.vehicle,
            is_px4=set_up.is_px4,
            home_m=homes_m[set_up.vehicle],
            parameters={**_VEHICLE_PARAMETERS[set_up.control_name], **set_up.common},
            with_edgevpr={} if event.parameters_come_late else set_up.parameters,
            config={**set_up.config, "mavlink": {**set_up.config.get("mavlink", {}), **accuracy}},
            mapped_m=MAP_END_M if event.leaves_map else None,
            beyond_scale=event.beyond_scale,
            **MATCHES.get(self.matches, {}),
        )


@dataclass(frozen=True, slots=True)
class Cell:
    """A flight of the table; `is_quick`: it is also in the part of ten minutes."""

    flight: Flight
    is_quick: bool = False

    @property
    def control(self) -> Flight:
        """The flight that this one is compared with."""
        event = EVENTS[self.flight.event]
        event_name = event.control or self.flight.event
        if event.control_has_edgevpr:
            return replace(self.flight, event=event_name)
        return Flight(SET_UPS[self.flight.set_up].control_name, event_name)


MATCHES = {"right": {}, "none": {"is_blind": True}, "displaced": {"map_east_m": 8.0}, "wrong": {"map_east_m": 300.0}}

_GPS_WANDER_SHARE = 0.3  # share of PX4's GPS noise; with all of it a hover strays by 3 m, the margin of a cell
_VEHICLE_PARAMETERS = {
    "copter": {"WPNAV_SPEED_UP": 500, "WPNAV_SPEED": 700, "GPS1_TYPE": 5, "SIM_GPS1_TYPE": 5},  # NMEA: only 3D fixes
    "plane": {"TKOFF_ALT": 60, "WP_LOITER_RAD": RADIUS_M},
    "px4_copter": {
        "MPC_TKO_SPEED": 5.0,
        "MPC_Z_V_AUTO_UP": 5.0,
        "MPC_Z_VEL_MAX_UP": 5.0,
        "MPC_XY_CRUISE": 7.0,
        "SIM_GPS_WANDER": _GPS_WANDER_SHARE,
    },
    "px4_plane": {"SIM_GPS_WANDER": _GPS_WANDER_SHARE},
}
SET_UPS = {
    "copter": SetUp(),
    "plane": SetUp(vehicle="plane"),
    "px4_copter": SetUp(is_px4=True),
    "px4_plane": SetUp(is_px4=True, vehicle="plane"),
    "gps_input": SetUp(parameters=GPS_INPUT),
    "gps_input_never_switched": SetUp(parameters={**GPS_INPUT, "GPS_AUTO_SWITCH": 0}),
    "gps_input_blended": SetUp(parameters={**GPS_INPUT, "GPS_AUTO_SWITCH": 2}),
    "gps_input_if_no_fix": SetUp(parameters={**GPS_INPUT, "GPS_AUTO_SWITCH": 4}),
    "gps_primary": SetUp(parameters={**GPS_INPUT, "GPS_PRIMARY": 1, "GPS_AUTO_SWITCH": 4}),
    "gps_primary_never_switched": SetUp(parameters={**GPS_INPUT, "GPS_PRIMARY": 1, "GPS_AUTO_SWITCH": 0}),
    "affinity": SetUp(parameters={**GPS_INPUT, "EK3_AFFINITY": 1}),
    "affinity_ours": SetUp(parameters={**GPS_INPUT, "EK3_AFFINITY": 1, "EK3_PRIMARY": 1}),
    "odometry": SetUp(parameters=ODOMETRY),
    "odometry_switched": SetUp(parameters=ODOMETRY, config={"mavlink": {"source_sets": {"gps": 1, "no_gps": 2}}}),
    "plane_command": SetUp(vehicle="plane"),
    "plane_gps_input": SetUp(vehicle="plane", parameters=GPS_INPUT),
    "px4_sensor": SetUp(is_px4=True, parameters=AGP),
    "px4_odometry": SetUp(is_px4=True, parameters={"EKF2_EV_CTRL": 1}),
    "px4_plane_sensor": SetUp(is_px4=True, vehicle="plane", parameters=AGP),
}

_GPS_OFF = Step(0, "set_gps", (0,))
_GPS_OFF_LATER = (Step(20, "set_gps", (0,)),)
EVENTS = {
    "quiet": Event(),
    "4_satellites": Event(steps=(Step(0, "set_satellites", (4,)),)),
    "5_satellites": Event(steps=(Step(0, "set_satellites", (5,)),)),
    "satellites_back": Event(
        steps=(Step(0, "set_satellites", (4,)), Step(60, "set_satellites", (10,))), gps_back_s=60.0
    ),
    "gps_off": Event(steps=(_GPS_OFF,)),
    "gps_back": Event(steps=(_GPS_OFF, Step(50, "set_gps", (1,))), gps_back_s=50.0),
    "gps_flaps": Event(
        steps=tuple(Step(6.0 * number, "set_gps", (number % 2,)) for number in range(12)), gps_back_s=66.0
    ),
    "gps_jumps": Event(steps=(Step(0, "displace_gps", (100,)), Step(60, "displace_gps", (0,))), gps_back_s=60.0),
    "gps_drifts": Event(steps=(Step(0, "drift_gps", (0.5,)),)),
    "gps_drifts_fast": Event(steps=(Step(0, "drift_gps", (2.0,)),)),
    "gps_spoofed": Event(steps=(Step(0, "flag_gps", (3,)), Step(25, "flag_gps", (1,))), gps_back_s=25.0),
    "gps_unused": Event(steps=(Step(0, "use_gps", (0,)), Step(20, "use_gps", (7,))), gps_back_s=20.0),
    "source_set": Event(steps=(Step(0, "choose_sources", (ODOMETRY_SET,)),), control="quiet"),
    "source_set_and_back": Event(
        steps=(Step(0, "choose_sources", (ODOMETRY_SET,)), Step(60, "choose_sources", (1,))), control="quiet"
    ),
    "home_set": Event(
        steps=(Step(0, "set_home", (60,)), Step(10, "set_gps", (0,))), control="gps_off_late", control_has_edgevpr=True
    ),
    "gps_off_late": Event(steps=(Step(10, "set_gps", (0,)),)),
    "origin_set": Event(steps=(Step(0, "set_origin", (100, 80)),)),
    "companion_reboots": Event(
        steps=(_GPS_OFF, Step(30, "restart_edgevpr", (25,))), control="companion_restarts", control_has_edgevpr=True
    ),
    "companion_restarts": Event(steps=(_GPS_OFF, Step(30, "restart_edgevpr")), control="gps_off"),
    "companion_reboots_with_gps": Event(steps=(Step(0, "restart_edgevpr", (25,)),), control="quiet"),
    "autopilot_reboots": Event(before=(("reboot", ()),), steps=_GPS_OFF_LATER, control="gps_off_20"),
    "set_up_late": Event(
        before=(("adopt", ()), ("reboot", ())), steps=_GPS_OFF_LATER, control="gps_off_20", parameters_come_late=True
    ),
    "parameters_late": Event(before=(("lose_requests", (8,)),), steps=_GPS_OFF_LATER, control="gps_off_20"),
    "gps_off_20": Event(steps=_GPS_OFF_LATER),
    "other_stamps": Event(steps=(_GPS_OFF, Step(20, "send_other_stamps")), control="gps_off", control_has_edgevpr=True),
    "paused": Event(steps=(_GPS_OFF, Step(20, "pause")), control="gps_off", silent_s=22.0),
    "camera_freezes": Event(steps=(_GPS_OFF, Step(30, "freeze", (1,)), Step(90, "freeze", (0,))), control="gps_off"),
    "companion_busy": Event(steps=(_GPS_OFF, Step(30, "stop_edgevpr", (10,))), control="gps_off"),
    "companion_busy_with_gps": Event(steps=(Step(10, "stop_edgevpr", (10,)),), control="quiet"),
    "link_saturated": Event(steps=(Step(0, "saturate", (2000,)), *_GPS_OFF_LATER), control="gps_off_20"),
    "link_saturated_with_gps": Event(steps=(Step(0, "saturate", (2000,)),), control="quiet"),
    **{
        f"{word}_ground": Event(
            steps=(Step(5, "set_gps", (0,)), Step(55, "set_gps", (1,))),
            gps_back_s=55.0,
            leaves_map=True,
            beyond_scale=scale,
        )
        for word, scale in (("lower", 1.4), ("higher", 0.7))
    },
}


def _make_cells(set_up: str, events: str, matches: str = "right") -> list[Cell]:
    """Return the cells of a set-up and of event names; those with a `*` are also in the quick part."""
    names = ((event.rstrip("*"), event.endswith("*")) for event in events.split())
    return [Cell(Flight(set_up, event, matches), is_quick) for event, is_quick in names]


CELLS = {
    cell.flight.name: cell
    for cell in (
        *_make_cells("gps_input", "4_satellites* 5_satellites satellites_back gps_back gps_flaps quiet", "none"),
        *_make_cells("gps_input", "gps_drifts_fast link_saturated_with_gps companion_reboots_with_gps", "none"),
        *_make_cells("gps_input", "4_satellites gps_back gps_jumps gps_drifts gps_drifts_fast home_set paused"),
        *_make_cells("gps_input", "autopilot_reboots* set_up_late parameters_late companion_busy_with_gps"),
        *_make_cells("gps_input", "higher_ground camera_freezes companion_busy companion_restarts link_saturated"),
        *_make_cells("gps_input", "lower_ground"),
        *_make_cells("gps_input", "quiet", "displaced"),
        *_make_cells("gps_input", "quiet gps_back", "wrong"),
        *_make_cells("gps_input_never_switched", "4_satellites", "none"),
        *_make_cells("gps_input_never_switched", "gps_back"),
        *_make_cells("gps_input_blended", "quiet 4_satellites", "none"),
        *_make_cells("gps_input_blended", "gps_back gps_jumps"),
        *_make_cells("gps_input_blended", "quiet", "displaced"),
        *_make_cells("gps_input_if_no_fix", "4_satellites", "none"),
        *_make_cells("gps_input_if_no_fix", "gps_back"),
        *_make_cells("gps_primary", "quiet*", "none"),
        *_make_cells("gps_primary_never_switched", "quiet", "none"),
        *_make_cells("affinity", "4_satellites", "none"),
        *_make_cells("affinity", "gps_back"),
        *_make_cells("affinity_ours", "quiet", "none"),
        *_make_cells("odometry", "source_set", "none"),
        *_make_cells("odometry", "source_set* source_set_and_back 4_satellites"),
        *_make_cells("odometry", "source_set", "displaced"),
        *_make_cells("odometry", "source_set", "wrong"),
        *_make_cells("odometry_switched", "gps_back gps_jumps gps_flaps gps_drifts_fast lower_ground camera_freezes"),
        *_make_cells("odometry_switched", "companion_restarts companion_reboots autopilot_reboots"),
        *_make_cells("odometry_switched", "gps_back", "wrong"),
        *_make_cells("plane_command", "gps_back gps_jumps gps_drifts_fast home_set companion_reboots other_stamps"),
        *_make_cells("plane_command", "lower_ground"),
        *_make_cells("plane_command", "gps_back", "wrong"),
        *_make_cells("plane_gps_input", "4_satellites", "none"),
        *_make_cells("plane_gps_input", "gps_back gps_drifts_fast companion_restarts companion_reboots lower_ground"),
        *_make_cells("px4_sensor", "5_satellites gps_back", "none"),
        *_make_cells("px4_sensor", "gps_back gps_jumps gps_drifts gps_spoofed home_set origin_set paused"),
        *_make_cells("px4_sensor", "autopilot_reboots set_up_late companion_busy lower_ground* higher_ground"),
        *_make_cells("px4_sensor", "companion_restarts companion_reboots camera_freezes gps_flaps"),
        *_make_cells("px4_sensor", "gps_unused quiet", "displaced"),
        *_make_cells("px4_sensor", "gps_back", "wrong"),
        *_make_cells("px4_odometry", "gps_back gps_spoofed lower_ground gps_jumps companion_busy"),
        *_make_cells("px4_odometry", "gps_unused", "displaced"),
        *_make_cells("px4_plane_sensor", "gps_back gps_spoofed home_set lower_ground higher_ground gps_jumps"),
        *_make_cells("px4_plane_sensor", "companion_restarts companion_reboots"),
        *_make_cells("px4_plane_sensor", "gps_unused", "displaced"),
        *_make_cells("px4_plane_sensor", "gps_back", "wrong"),
    )
}
