"""An aircraft that would be fine alone is fine with edgevpr: flights in closed loop, each beside its control."""

import pytest
from closed_loop import STEP_S, ClosedLoop

from edgevpr.core.geodesy import distance_m
from edgevpr.mavlink.ground import UserCommand
from edgevpr.mavlink.wire import mavlink
from edgevpr.runtime.flight.output import Output

pytestmark = pytest.mark.slow

WATCHED_S = 60.0
SETTLED_S = 15.0
MAX_WORSE_M = 3.0
GPS_AGAIN_S = 10.0
GPS_INPUT = {"SIM_GPS1_TYPE": 5, "GPS2_TYPE": 14}  # the receiver's fix is a plain 3D one, as ours is
ODOMETRY = {"VISO_TYPE": 1, "EK3_SRC2_POSXY": 6}
SENSOR = {"EKF2_AGP0_CTRL": 1}
VISION = {"EKF2_AGP0_CTRL": 0, "EKF2_EV_CTRL": 1}
HAS_POSITION = mavlink.EKF_POS_HORIZ_REL | mavlink.EKF_POS_HORIZ_ABS

px4_channels = pytest.mark.parametrize("parameters", [SENSOR, VISION], ids=["message 296", "ODOMETRY"])
with_and_without_matches = pytest.mark.parametrize("matches", [True, False], ids=["matches", "no matches"])


def assert_no_worse(vehicle, event, **setup):
    """Fly twice, with and without edgevpr, let an `event` happen to the autopilot in each flight, and compare them from
    its end. Returns the flight with edgevpr."""
    worst = []
    for edgevpr in (False, True):
        flight = ClosedLoop(vehicle, edgevpr=edgevpr, **setup).fly(SETTLED_S)
        event(flight)
        since_s = flight.now_s
        worst.append(flight.fly(WATCHED_S).worst_m(since_s))
    (alone_away_m, alone_error_m), (away_m, error_m) = worst
    worse_m = {"away": round(away_m - alone_away_m, 1), "estimate": round(error_m - alone_error_m, 1)}
    assert max(worse_m.values()) <= MAX_WORSE_M, worse_m
    return flight


@pytest.mark.parametrize(("satellites", "matches"), [(4, True), (5, False)])
def test_receiver_with_few_satellites_is_not_replaced_by_ours(satellites, matches):
    def lose_satellites(flight):
        flight.set("SIM_GPS1_NUMSATS", satellites)

    assert_no_worse("arducopter", lose_satellites, matches=matches, **GPS_INPUT)


@pytest.mark.parametrize("interval_us", [1_000_000, -1], ids=["once a second", "stopped"])
def test_good_receiver_is_not_replaced_if_its_reports_are_rare_or_stop(interval_us):
    flight = ClosedLoop("arducopter", matches=False, **GPS_INPUT).fly(SETTLED_S)
    flight.set("SIM_GPS1_NUMSATS", 5).fly(5)
    flight.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, interval_us)
    for _ in range(10):
        assert flight.fly(1).navigator.output is Output.RESERVE


def test_px4_gets_no_positions_while_the_reports_of_a_good_receiver_have_stopped():
    flight = ClosedLoop("px4-copter", **SENSOR).fly(SETTLED_S)
    flight.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, -1)
    silent_s = flight.now_s
    assert not flight.fly(10).positions_sent(silent_s)
    texts = [message.text for _, message in flight.sent if message.get_type() == "STATUSTEXT"]
    assert texts[-2:] == ["edgevpr: GPS reports stopped: requested again", "edgevpr: GPS reports arrive again"]


@pytest.mark.parametrize(
    ("vehicle", "parameters"), [("arducopter", GPS_INPUT), ("px4-copter", SENSOR), ("px4-copter", VISION)]
)
def test_positions_without_an_address_are_not_sent_beside_another_autopilot(vehicle, parameters):
    flight = ClosedLoop(vehicle, **parameters).fly(SETTLED_S)
    flight.set("SIM_GPS1_ENABLE", 0).fly(3)
    other = mavlink.MAVLink_heartbeat_message(2, 3, 128, 0, 4, 3).pack(mavlink.MAVLink(None, 2, 1))
    flight.conversation.handle(other, 1000.0 + flight.now_s, None)
    heard_s = flight.now_s
    targets = [
        m.target_system for t_s, m in flight.fly(9.5).sent if t_s > heard_s and m.get_type() == "GLOBAL_POSITION_SENSOR"
    ]
    assert bool(flight.positions_sent(heard_s)) is (parameters is SENSOR) is bool(targets)
    assert set(targets) <= {1}
    assert (flight.navigator.output is Output.LINK_SHARED) is (parameters is not SENSOR)
    assert Output.LINK_SHARED.text == "two autopilots on link: nothing sent"
    assert flight.fly(2).positions_sent(flight.now_s - 1)


def test_plane_gets_no_match_while_its_reports_are_late():
    """Reports that are late are not used, so nothing shows that the map has led it to a place that looks alike."""
    flight = ClosedLoop("arduplane", velocity_m_s=15j).fly(SETTLED_S)
    flight.set("SIM_GPS1_ENABLE", 0).fly(8)
    flight.downlink_s, flight.map_off_m = 2.0, 300 + 0j
    late_s = flight.fly(2).now_s
    assert not flight.fly(10).positions_sent(late_s)


@with_and_without_matches
def test_source_set_with_odometry_does_not_diverge_with_gps(matches):
    def choose_second_set(flight):
        if flight.conversation:
            flight.command(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, 2)
            answered_s = flight.conversation.autopilot.answered_s[mavlink.MAV_CMD_SET_EKF_SOURCE_SET]
            assert answered_s == pytest.approx(1000.0 + flight.now_s, abs=0.1)

    assert_no_worse("arducopter", choose_second_set, matches=matches, **ODOMETRY)


@pytest.mark.parametrize(
    ("matches", "parameters"), [(True, {"GPS_PRIMARY": 1, "GPS_AUTO_SWITCH": 4}), (False, {"GPS_AUTO_SWITCH": 2})]
)
def test_receiver_of_ours_does_not_diverge_while_used_with_gps(parameters, matches):
    assert_no_worse("arducopter", lambda flight: None, matches=matches, **GPS_INPUT, **parameters)


@pytest.mark.parametrize("parameters", [GPS_INPUT, ODOMETRY], ids=["GPS_INPUT", "ODOMETRY"])
def test_copter_without_gps_uses_our_positions_again_after_a_long_gap(parameters):
    """ArduPilot's filter stops after ten seconds, and starts with a receiver of 5 m, 1 m/s and HDOP 2.5 or better."""
    flight = ClosedLoop("arducopter", **parameters).fly(SETTLED_S)
    flight.command(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, 1 + ("VISO_TYPE" in parameters))
    flight.set("SIM_GPS1_ENABLE", 0).fly(5)
    flight.matches = flight.sees_motion = False
    assert flight.fly(25).brain.flags() & mavlink.EKF_CONST_POS_MODE
    flight.matches = flight.sees_motion = True
    again_s = flight.fly(15).now_s
    assert flight.fly(20).worst_m(again_s)[1] < 8
    assert not flight.brain.flags() & mavlink.EKF_CONST_POS_MODE


@pytest.mark.parametrize(("vehicle", "parameters"), [("arducopter", ODOMETRY), ("px4-copter", SENSOR)])
def test_match_after_a_minute_without_images_needs_a_second_one(vehicle, parameters):
    """Our prediction is so rough by then that any match agrees with it, and its velocity is rough after the first."""
    flight = ClosedLoop(vehicle, **parameters).fly(SETTLED_S)
    flight.set("SIM_GPS1_ENABLE", 0).fly(5)
    flight.matches = flight.sees_motion = False
    flight.fly(60).matches = True
    flight.fly(1).matches = False
    assert not flight.fly(2).positions_sent(flight.now_s - 3)
    flight.matches = True
    assert flight.fly(3).positions_sent(flight.now_s - 1)


@px4_channels
def test_px4_uses_gps_again_after_flight_over_lower_ground(parameters):
    """Over ground that falls away, where strides are 1.4 times short: the position that is sent is 140 m off."""
    flight = ClosedLoop("px4-copter", matches=False, velocity_m_s=10j, **parameters).fly(SETTLED_S)
    flight.set("SIM_GPS1_ENABLE", 0)
    for second in range(50):
        flight.stride_scale = 1 / (1 + 0.4 * min(1.0, second / 20))
        flight.fly(1)
    back_s = flight.set("SIM_GPS1_ENABLE", 1).fly(GPS_AGAIN_S).now_s
    _, error_m = flight.fly(20).worst_m(back_s)
    assert error_m <= MAX_WORSE_M
    assert not flight.positions_sent(back_s)


def test_px4_without_gps_or_images_gets_nothing_and_the_operator_is_informed():
    flight = ClosedLoop("px4-copter", matches=False, **SENSOR).fly(SETTLED_S)
    assert flight.navigator.output is Output.GPS_IN_USE
    flight.sees_motion = False
    flight.fly(15).set("SIM_GPS1_ENABLE", 0).fly(10)
    assert flight.navigator.output is Output.UNKNOWN
    assert not flight.positions_sent(0)


@pytest.mark.parametrize(("unseen_s", "scale"), [(0, 1.4), (0, 0.75), (1, 1.1), (1, 0.92), (4, 1.4), (4, 0.75)])
@pytest.mark.parametrize(("vehicle", "channel"), [("arducopter", GPS_INPUT), ("arduplane", {}), ("px4-copter", SENSOR)])
def test_cliff_beyond_the_map_is_followed_and_where_it_is_not_seen_claimed(vehicle, channel, scale, unseen_s):
    """Strides are 1.4 times short beyond it: unseen, 120 to 180 m off in half a minute, 6 to 40 claimed."""
    flight = ClosedLoop(vehicle, velocity_m_s=12j, **channel).fly(SETTLED_S)
    flight.set("SIM_GPS1_ENABLE", 0).fly(20)
    flight.matches, flight.show_ground = False, unseen_s == 0
    flight.sees_motion = not unseen_s
    flight.fly(unseen_s)
    flight.sees_motion, flight.stride_scale = True, 1 / scale
    for _ in range(6):
        flight.fly(5)
        truth, state = flight.brain.truth, flight.navigator._navigation.estimate_state(1000.0 + flight.now_s)
        away_m = distance_m(truth.lat_deg, truth.lon_deg, state.position.lat_deg, state.position.lon_deg)
        assert away_m < (30 if flight.show_ground else max(10.0, 3 * state.accuracy_m))


@pytest.mark.parametrize("match_every", [2, 3, 10])
def test_correct_matches_are_sent_soon_after_flight_over_lower_ground_off_the_map(match_every):
    """Odometry is 90 m off by then. Positions must not end: after 15 s without one, ArduPilot's filter stops."""
    flight = ClosedLoop("arducopter", velocity_m_s=10j, **GPS_INPUT).fly(30)
    flight.set("SIM_GPS1_ENABLE", 0).fly(12)
    flight.matches, flight.stride_scale = False, 1 / 1.3
    flight.fly(30)
    flight.matches, flight.stride_scale, flight.match_every = True, 1.0, match_every
    flight.fly(20 + 4 * match_every)
    assert flight.fly(10).worst_m(flight.now_s - 10)[1] < 15


@pytest.mark.parametrize(("matched_s", "scale"), [(0, 1.4), (15, 1.4), (15, 0.7)])
def test_odometry_over_other_ground_is_correct_once_matches_show_its_height(matched_s, scale):
    """Strides alone, 1.4 times short: uncorrected they lose 86 m in 20 s. Before the height is corrected, matches show
    the same error as one of odometry; corrected twice, strides lost 25 m in 8 s."""
    flight = ClosedLoop("px4-copter", matches=matched_s > 0, velocity_m_s=10j, **SENSOR).fly(SETTLED_S)
    flight.set("SIM_GPS1_ENABLE", 0)
    flight.stride_scale = 1 / scale
    flight.fly(matched_s).navigator.correct_height(scale)
    flight.matches = False
    flight.fly(8)
    truth, state = flight.brain.truth, flight.navigator._navigation.estimate_state(1000.0 + flight.now_s)
    assert distance_m(truth.lat_deg, truth.lon_deg, state.position.lat_deg, state.position.lon_deg) < 8
    assert state.accuracy_m < 10
    flight.sees_motion = False
    flight.fly(1).sees_motion, flight.stride_scale = True, 1.0
    flight.fly(3)
    truth, state = flight.brain.truth, flight.navigator._navigation.estimate_state(1000.0 + flight.now_s)
    away_m = distance_m(truth.lat_deg, truth.lon_deg, state.position.lat_deg, state.position.lon_deg)
    assert away_m < 2 * state.accuracy_m, "the ground changed back in between"


@pytest.mark.parametrize(("parameters", "late_s"), [(SENSOR, 0.5), (VISION, 1.3)])
def test_restart_without_gps_sends_from_the_second_match(parameters, late_s):
    """The estimate comes from what was sent before. Late matches are of frames taken before the last match."""
    flight = ClosedLoop("px4-copter", velocity_m_s=13j, **parameters).fly(SETTLED_S)
    flight.late_s = late_s
    flight.set("SIM_GPS1_ENABLE", 0).fly(10)
    flight.matches = False
    assert not flight.start().fly(5).positions_sent(flight.now_s - 5)
    flight.matches = True
    flight.fly(1).matches = False
    assert not flight.fly(4).positions_sent(flight.now_s - 5), "a single match may be wrong"
    flight.matches = True
    assert flight.fly(3).positions_sent(flight.now_s - 3)[0] < flight.now_s - 1.8 + late_s
    flight.matches = False
    flight.start().fly(2).matches = True
    first_s = flight.fly(4).positions_sent(flight.now_s - 6)[0] - (flight.now_s - 4)
    assert 2 + late_s < first_s < 2.2 + late_s, "the second frame is taken before the first match arrives"
    assert flight.fly(20).worst_m(flight.now_s - 20)[1] < 8, "the first position has the velocity of two matches"


@pytest.mark.parametrize("restarts", [True, False], ids=["restart", "long silence"])
def test_a_plane_gets_no_fix_of_a_single_match_that_nothing_confirms(restarts):
    """Neither is a look-alike 500 m away contradicted by dead reckoning, nor at all after a restart."""
    flight = ClosedLoop("arduplane", velocity_m_s=15j).fly(SETTLED_S)
    flight.set("SIM_GPS1_ENABLE", 0).fly(5)
    flight.matches = flight.sees_motion = False
    flight.fly(5 if restarts else 60)
    if restarts:
        flight.start().fly(5)
    flight.map_off_m, flight.matches = 500.0, True
    flight.fly(1).matches = False
    assert not flight.fly(4).positions_sent(flight.now_s - 5)
    flight.map_off_m, flight.matches = 0.0, True
    assert flight.fly(5).positions_sent(flight.now_s - 5)
    assert flight.error_m[-1] < 10


@pytest.mark.parametrize("turned_deg", [30, 90])
def test_a_turned_camera_does_not_lead_a_plane_away_after_the_last_match(turned_deg):
    flight = ClosedLoop("arduplane", velocity_m_s=15j, min_accuracy_m=5.0)
    flight.heading_error_deg = turned_deg
    flight.fly(SETTLED_S).set("SIM_GPS1_ENABLE", 0).set("SIM_WIND_SPD", 6).fly(8)
    flight.matches = False
    assert flight.fly(32).error_m[-1] < 100


@pytest.mark.parametrize(("turned_deg", "sent_s"), [(90, 8), (60, 8), (30, 39), (-30, 39)])
def test_odometry_of_a_compass_that_has_jumped_is_unused_or_rotated_and_claimed(turned_deg, sent_s):
    flight = ClosedLoop("arducopter", velocity_m_s=10j, **GPS_INPUT).fly(SETTLED_S).set("SIM_GPS1_ENABLE", 0).fly(15)
    flight.matches, flight.heading_error_deg = False, turned_deg
    last_s = flight.fly(40).positions_sent(30)[-1]
    assert flight.error_m[round(last_s / STEP_S) - 1] < 60, "180 if a heading that has stepped is not doubted"
    assert last_s < 30 + sent_s
    assert flight.navigator.output is Output.UNKNOWN


@pytest.mark.parametrize("turned_deg", [-60, 30])
def test_positions_end_when_a_compass_has_jumped_in_a_hover(turned_deg):
    """Nothing shows there whether the heading before or after the step is wrong; the way flown on by it is claimed."""
    flight = ClosedLoop("arducopter", **GPS_INPUT).fly(SETTLED_S).set("SIM_GPS1_ENABLE", 0).fly(15)
    flight.matches, flight.heading_error_deg = False, turned_deg
    flight.fly(10).motion.cruise(8j)
    assert not flight.fly(25).positions_sent(flight.now_s - 8)


@pytest.mark.parametrize(("speed_m_s", "limit_m"), [(0.4, 10), (1.0, 18)])
def test_noise_of_odometry_does_not_bias_its_scale(speed_m_s, limit_m):
    flight = ClosedLoop("arducopter", velocity_m_s=speed_m_s * 1j, **GPS_INPUT).fly(20)
    flight.set("SIM_GPS1_ENABLE", 0).fly(15).matches = False
    assert flight.fly(300).error_m[-1] < limit_m, "14 and 25 if noise counts as motion"


def test_gps_that_comes_back_wrong_does_not_outweigh_matches():
    flight = ClosedLoop("px4-copter", velocity_m_s=5j, **SENSOR).fly(SETTLED_S).set("SIM_GPS1_ENABLE", 0).fly(20)
    flight.brain.receivers.error_m = 15.0
    flight.set("SIM_GPS1_ENABLE", 1).fly(4).set("SIM_GPS1_ENABLE", 0)
    assert flight.fly(20).worst_m(flight.now_s - 24)[0] < 20, "17 without edgevpr"


@pytest.mark.parametrize(("vehicle", "channel", "away_m"), [("arducopter", GPS_INPUT, 8), ("px4-copter", SENSOR, 20)])
def test_places_that_look_alike_for_nine_seconds_move_no_aircraft(vehicle, channel, away_m):
    flight = ClosedLoop(vehicle, velocity_m_s=5j, **channel).fly(25)
    since_s = flight.set("SIM_GPS1_ENABLE", 0).fly(15).now_s
    for map_off_m in (60, 0, -60, 0):
        flight.map_off_m = map_off_m
        flight.fly(9)
    assert flight.worst_m(since_s)[0] < away_m, "80 m and more if four matches that agree are believed at once"
    assert flight.positions_sent(flight.now_s - 1)


def test_px4_is_given_proven_positions_that_it_does_not_refuse():
    flight = ClosedLoop("px4-copter", **SENSOR)
    flight.show_tilt = True
    flight.fly(SETTLED_S).set("SIM_GPS1_ENABLE", 0).fly(20)
    flight.brain.estimator.error_m += 25.0
    assert flight.fly(3).error_m[-1] < 17, "21 if they are refused"


@pytest.mark.parametrize(("every_s", "fixes"), [(20, 40), (60, 6)])
def test_a_plane_gets_fixes_of_rare_matches_without_odometry(every_s, fixes):
    """Each is predicted to no better than 36 and 180 m in wind; single fixes follow a match for up to a minute."""
    flight = ClosedLoop("arduplane", velocity_m_s=15j).fly(SETTLED_S)
    flight.set("SIM_GPS1_ENABLE", 0).set("SIM_WIND_SPD", 6)
    flight.sees_motion, flight.match_every = False, every_s
    assert len(flight.fly(200).positions_sent(flight.now_s - 200)) >= fixes
    assert flight.error_m[-1] < 300


@pytest.mark.parametrize(("map_off_m", "parameters"), [(8, SENSOR), (20, VISION)])
def test_px4_uses_gps_again_after_a_test_without_gps(map_off_m, parameters):
    def suspend_gps(flight):
        flight.map_off_m = map_off_m
        flight.set("EKF2_GPS_CTRL", 0).fly(20)
        flight.set("EKF2_GPS_CTRL", 7).fly(GPS_AGAIN_S + 5)  # it has to fly back

    assert_no_worse("px4-copter", suspend_gps, **parameters)


@pytest.mark.parametrize(("matches", "parameters"), [(True, SENSOR), (False, VISION)])
def test_px4_uses_gps_again_after_a_receiver_was_flagged_as_spoofed(matches, parameters):
    def flag(flight):
        flight.set("SIM_GPS_SPOOF", 1).fly(20)
        flight.set("SIM_GPS_SPOOF", 0).fly(GPS_AGAIN_S)

    flight = assert_no_worse("px4-copter", flag, matches=matches, velocity_m_s=10j, **parameters)
    assert not flight.positions_sent(SETTLED_S + 20 + GPS_AGAIN_S)


@px4_channels
def test_restart_sends_to_a_px4_that_does_not_use_its_receiver(parameters):
    flight = ClosedLoop("px4-copter", velocity_m_s=5j, **parameters).fly(SETTLED_S)
    flight.set("SIM_GPS_SPOOF", 1).fly(20)
    assert flight.start().fly(20).positions_sent(flight.now_s - 10)
    assert flight.fly(20).worst_m(flight.now_s - 20)[1] < 8


def test_restart_does_not_send_to_an_older_px4_whose_use_of_gps_is_unknown():
    flight = ClosedLoop("px4-copter", velocity_m_s=5j, **VISION)
    flight.brain.version = 1 << 24 | 15 << 16
    flight.fly(SETTLED_S).set("SIM_GPS_SPOOF", 1).fly(20)
    assert not flight.start().fly(20).positions_sent(flight.now_s - 20)


@pytest.mark.parametrize(
    ("vehicle", "parameters"),
    [
        ("px4-copter", SENSOR),
        ("px4-copter", VISION),
        ("arducopter", GPS_INPUT),
        ("arducopter", ODOMETRY),
        ("arduplane", {"SIM_WIND_SPD": 6}),
    ],
)
def test_paused_flight_sends_no_position_on_any_channel(vehicle, parameters):
    flight = ClosedLoop(vehicle, **parameters).fly(20)
    flight.set("SIM_GPS1_ENABLE", 0).set("SIM_WIND_SPD", 0)
    if parameters == ODOMETRY:
        flight.command(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, 2)
    paused_s = flight.fly(20).now_s
    assert flight.positions_sent(paused_s - 10)
    assert flight.ask(mavlink.MAV_CMD_USER_1, UserCommand.PAUSE) == mavlink.MAV_RESULT_ACCEPTED
    flight.fly(10)
    assert not flight.positions_sent(paused_s)


@pytest.mark.parametrize(
    ("vehicle", "parameters"), [("px4-copter", SENSOR), ("px4-copter", VISION), ("arducopter", GPS_INPUT)]
)
def test_map_with_an_offset_moves_no_aircraft_with_good_gps(vehicle, parameters):
    def shift_map(flight):
        flight.map_off_m = 8

    assert_no_worse(vehicle, shift_map, **parameters)


def test_copter_with_our_receiver_continues_after_the_loss_of_gps():
    flight = ClosedLoop("arducopter", **GPS_INPUT).fly(20)
    lost_s = flight.set("SIM_GPS1_ENABLE", 0).now_s
    assert flight.fly(40).error_m[-1] < 4
    assert flight.brain.flags() & HAS_POSITION, "without it a copter lands"
    sent = [message for t_s, message in flight.sent if message.get_type() == "GPS_INPUT" and t_s > lost_s]
    assert len(sent) == pytest.approx(400, abs=8), "ten a second"
    assert {(each.gps_id, each.fix_type) for each in sent} == {(1, mavlink.GPS_FIX_TYPE_3D_FIX)}
    flight.matches = flight.sees_motion = False
    flight.fly(75)
    *_, last = (message for _, message in flight.sent if message.get_type() == "GPS_INPUT")
    assert last.fix_type == mavlink.GPS_FIX_TYPE_NO_FIX, "a minute without a match"
    assert not flight.brain.flags() & HAS_POSITION


def test_plane_gets_and_accepts_single_fixes_only_after_the_loss_of_gps():
    flight = ClosedLoop("arduplane", matches=False).fly(10)
    flight.matches, flight.sees_motion = True, False
    assert not flight.fly(20).positions_sent(0)
    lost_s = flight.set("SIM_GPS1_ENABLE", 0).set("SIM_WIND_SPD", 6).now_s
    since_s = flight.fly(15).now_s
    _, error_m = flight.fly(45).worst_m(since_s)
    assert error_m < 15
    assert len(flight.positions_sent(lost_s)) > 30
    assert {message.get_type() for _, message in flight.sent} & {"GPS_INPUT", "COMMAND_INT"} == {"COMMAND_INT"}
    flight.matches = False
    assert flight.fly(20).error_m[-1] < 40, "the wind that matches have shown carries on"
    assert flight.fly(60).error_m[-1] > 50, "alone it drifts away"
