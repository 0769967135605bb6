"""Communication of a flight with its autopilot: sends fixes and messages over the link, logs the answers, and reports
the state of the link. An event is the `Recognition` of one frame. The loop of `flight` uses it."""

import logging
import math
from dataclasses import replace
from typing import Any

from edgevpr.core.config import MavlinkConfig, SourceSetsConfig
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import FixReport, Frame
from edgevpr.mavlink import messages
from edgevpr.mavlink.fixes import FixTransmission
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.messages import Fix, Severity
from edgevpr.power.meter import MachineLoad
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.flight.navigation import is_gps_aided
from edgevpr.runtime.flight.navigator import Navigator
from edgevpr.runtime.flight.notifier import Alert, Notifier
from edgevpr.runtime.flight.output import Output
from edgevpr.runtime.recognise.recognition import Recognition

# A fix is sent to a live autopilot within a fraction of a millisecond. The loop waits for that, at most this
# long, so that the log line of the query can contain whether the fix was sent.
_MAX_SEND_WAIT_S = 0.02

DRY_RUN = Reason(ReasonCode.DRY_RUN)

_UNKNOWN_AGE = Reason(ReasonCode.AGE_UNKNOWN)
_MIN_REPORTED_DELAY_S = 0.3

_SOURCE_SET_RETRY_S = 2.0  # between two requests for a source set, until one is answered
_MAX_GPS_DISTANCE_M = 25.0  # a steady receiver so near the map is not left: the next part of the map may be displaced
_MIN_FLYING_HEIGHT_M = 5.0
_MIN_GPS_GOOD_S = 3.0  # GPS must be good for this long before the source set with GPS is requested again

_log = logging.getLogger(__name__)


class AutopilotOutput:
    """Sends fixes and other messages over an open link: a match as a fix if the `navigator` advises so; a dry run
    only omits the sending. `cores` is the number of the board's cores. State shared with the link's thread is accessed
    only in turns (`Link.take_turn`)."""

    def __init__(
        self, link: Link, navigator: Navigator, notifier: Notifier, *, settings: MavlinkConfig, cores: int, clock: Clock
    ) -> None:
        self._link, self._navigator, self._notifier, self._cores, self._clock = link, navigator, notifier, cores, clock
        self._send_fixes, self._source_sets = settings.send_fixes, SourceSets(settings.source_sets)
        self._unanswered: list[tuple[str, FixTransmission]] = []
        self._held, self._is_holding = 0, False
        self._output = Output.STARTING  # last one reported
        self._gps_distance_m = 0.0  # of the last match
        self._unknown_age = Alert(notifier, "age", _UNKNOWN_AGE, ReasonCode.AGE_KNOWN)
        self._delay_s = 0.0  # last one reported

    @property
    def summary(self) -> str:
        """Short text with the counts of fixes and of refused messages from other systems so far."""
        stats = self._link.stats()
        sent = f"{stats.fixes_sent} fixes sent, {stats.acks.get('ACCEPTED', 0)} accepted"
        if stats.positions_sent:
            use = "does not report whether it uses them"
            if stats.used_share is not None:
                use = f"used them in {stats.used_share:.0%} of its reports"
            sent = f"{stats.positions_sent} positions sent, the autopilot {use}"
        summary = sent if self._send_fixes else str(DRY_RUN)
        counts = (
            (sum(stats.acks.values()) - stats.acks.get("ACCEPTED", 0), f"refused ({stats.refused_why})"),
            (stats.unanswered_fixes, "unanswered"),
            (self._held, "held back"),
            (stats.dropped_stale_fixes, "too late to send"),
            (stats.withheld_fixes, "withheld: no answers"),
            (stats.foreign_messages, "foreign messages refused"),
        )
        return ", ".join([summary, *(f"{count} {label}" for count, label in counts if count)])

    def state(self) -> dict[str, Any]:
        """Return the state of the link for the status: `trouble`, why the port could not be opened or was lost (None:
        data arrives); `autopilot`, the system id of the live autopilot (None: none); `channel`, the name of the
        position channel; `fixes`, a summary; and `accuracy_m` of our position."""
        with self._link.take_turn("state"):
            stats = self._link.stats()
            return {
                "trouble": stats.trouble,
                "autopilot": stats.autopilot_system_id if stats.autopilot_heard else None,
                "channel": self._link.channel.name,
                "fixes": self.summary,
                "accuracy_m": self._navigator.accuracy_m(self._clock.mono_s()),
            }

    def log_answers(self) -> None:
        """Write a log line "answer" for each fix that was answered, timed out, or was dropped before it was sent,
        since the last call; and a line "between" for each fix that was sent between two matches."""
        with self._link.take_turn("answers"):
            for transmission in self._link.take_interim_fixes():
                self._notifier.log("between", t_sent_s=transmission.t_sent_s, **_position_fields(transmission.fix))
            # An answer can arrive a moment before the link has recorded that the fix was sent.
            settled = [item for item in self._unanswered if item[1].sent is False or (item[1].sent and item[1].outcome)]
            for query, transmission in settled:
                self._unanswered.remove((query, transmission))
                outcome = transmission.outcome
                latency_s = outcome.latency_s if outcome else None
                self._notifier.log(
                    "answer",
                    query=query,
                    sent=transmission.sent,
                    result=transmission.answer,
                    why=outcome.why if outcome else transmission.why,
                    latency_ms=None if latency_s is None else round(latency_s * 1e3, 1),
                    t_sent_s=transmission.t_sent_s,
                )

    def report_match(self, event: Recognition, used_mah: float) -> Recognition:
        """Send the fix of an event, if any, and its figures. Return the event with the report of its fix, and its
        accuracy in flight. `used_mah` is the charge that the board has drawn so far."""
        with self._link.take_turn("use"):
            fix, transmission = None, None
            if event.accepted:
                event = self._navigator.report_accuracy(event)
                fix, transmission = self._send_match(event)
            else:
                self._navigator.handle_frame(event)
            is_alive = self._link.is_alive()
        if transmission and is_alive:
            transmission.wait(_MAX_SEND_WAIT_S)
        with self._link.take_turn("use of its fix"):
            if transmission:
                sent, why, answer = transmission.sent, transmission.why, transmission.answer
                if sent is not False:  # an unsent fix gets no answer; the log line of its query has the reason
                    self._unanswered.append((event.name, transmission))
                fields = _position_fields(transmission.fix)
                fix = FixReport(query=event.name, sent=sent, why=why, answer=answer, **fields)
            self._send_figures(event, used_mah)
        return replace(event, fix=fix)

    def correct_age(self, frame: Frame) -> Frame:
        """Return a frame with the hidden delay of the camera subtracted from its time."""
        with self._link.take_turn("age of a frame"):
            return self._navigator.age.correct(frame)

    def check_age(self, event: Recognition) -> Recognition:
        """Return the event of a match, without the match if the age of its picture is unknown. Report when this begins
        and ends, and the delay that is corrected."""
        with self._link.take_turn("age"):
            age = self._navigator.age
            if not self._navigator.is_out_of_reach(event):
                age.judge(event)
        self._unknown_age.update(age.is_unknown)
        if abs(age.delay_s - self._delay_s) > _MIN_REPORTED_DELAY_S:
            self._delay_s = age.delay_s
            note = self._delay_note or Reason(ReasonCode.DELAY_GONE)
            self._notifier.report("age", Severity.INFO, note, delay_s=age.delay_s)
        if not age.is_unknown:
            return event
        return replace(event, accepted=False, located=None, accuracy_m=None, reason=_UNKNOWN_AGE)

    @property
    def age_summary(self) -> str | None:
        """Remark on the age of the pictures (None: nothing to report)."""
        note = _UNKNOWN_AGE if self._unknown_age.is_active else self._delay_note
        return None if note is None else str(note)

    @property
    def _delay_note(self) -> Reason | None:
        is_late = self._delay_s > _MIN_REPORTED_DELAY_S
        return Reason(ReasonCode.DELAY_FOUND, {"delay_s": self._delay_s}) if is_late else None

    def add_motion(self, event: Recognition) -> None:
        """Pass the odometry of a picture that is not a query to the navigator."""
        with self._link.take_turn("saw"):
            self._navigator.handle_frame(event, is_query=False)

    def needs_motion_frames(self) -> bool:
        """Return True if odometry between matches is useful, because the position depends on matches."""
        with self._link.take_turn("wants strides"):
            return not self._navigator.has_gps

    def _send_figures(self, event: Recognition, used_mah: float) -> None:
        now_s = self._clock.mono_s()
        if event.accepted and (best := event.best):
            place, score = best.place.place_id, best.match.score
            confidence = combine_confidence(event)
            self._link.send(*messages.make_named_values(now_s, vpr_place=place, vpr_score=score, vpr_conf=confidence))
        if event.is_query:
            cpu_share = event.cost.whole.utilisation(self._cores)
            self._link.send(*messages.make_named_values(now_s, vpr_cpu=float(cpu_share), vpr_mah=float(used_mah)))

    def compare_gps(self, distance_m: float, is_wrong: bool, have_agreed: bool) -> None:
        """Send the distance from GPS to a match. While GPS `is_wrong`, because it contradicts the map,
        the navigator does not use it. Unless they `have_agreed` before, the map is equally likely to be wrong: then GPS
        is used, and no position is sent."""
        with self._link.take_turn("gps"):
            self._link.send(*messages.make_named_values(self._clock.mono_s(), vpr_gps_m=float(distance_m)))
            self._gps_distance_m = distance_m
            self._navigator.trust_gps(not is_wrong or not have_agreed)
            self._navigator.distrust_map(is_wrong and not have_agreed)

    def correct_height(self, ratio: float) -> None:
        """Set the ratio of visual height to the autopilot's height above ground (1.0: equal)."""
        with self._link.take_turn("height"):
            self._navigator.correct_height(ratio)

    def reset_navigation(self) -> None:
        """Restart the navigation, because later fixes have different errors."""
        with self._link.take_turn("anew"):
            self._navigator.reset_navigation()

    def report(
        self, health: messages.Health, load: MachineLoad, temperature_c: float | None, *, is_paused: bool
    ) -> None:
        """Send health, load and temperature (None: unknown) of this computer, and request another source set if needed.
        Call it once a second."""
        with self._link.take_turn("report"):
            self._link.set_health(health)
            self._request_source_set(is_paused)
            self._report_output(Output.PAUSED if is_paused else self._navigator.output)
            now_s, ram_bytes = self._clock.mono_s(), (load.ram_used_bytes, load.ram_total_bytes)
            self._link.send(messages.make_computer_status(now_s, load.core_usage, *ram_bytes, temperature_c))

    def _request_source_set(self, is_paused: bool) -> None:
        """Request another source set if needed. In flight, one may be in use that was requested before a restart."""
        vehicle, now_s = self._link.vehicle(), self._clock.mono_s()
        if vehicle is None or not vehicle.is_fresh(now_s) or not self._send_fixes or not self._source_sets.are_set:
            return
        navigator, stats = self._navigator, self._link.stats()
        is_sent = not is_paused and (navigator.output.is_sent or not self._link.channel.is_continuous)
        has_receiver = vehicle.gps is not None and vehicle.gps.steady_for_s >= _MIN_GPS_GOOD_S
        is_near = has_receiver and is_gps_aided(vehicle) and self._gps_distance_m <= _MAX_GPS_DISTANCE_M
        number = self._source_sets.choose_set(
            now_s,
            has_gps=navigator.has_gps or vehicle.gps_is_silent or is_near,
            has_receiver=has_receiver,
            has_own=is_sent and navigator.knows_position(now_s),
            is_flying=vehicle.height_m is not None and abs(vehicle.height_m) > _MIN_FLYING_HEIGHT_M,
            answered_s=stats.answered_s.get(messages.SET_SOURCE_SET, -math.inf),
        )
        if number:
            text = f"requested source set {number} from the autopilot"
            self._notifier.announce(Severity.WARNING, text, topic="sources")
            self._link.send(messages.make_source_set(number, stats.autopilot_system_id or 0))

    def _report_output(self, output: Output) -> None:
        """Report a change in what a continuous channel sends."""
        if self._link.channel.is_continuous and output is not self._output:
            self._output = output
            self._notifier.log("output", state=output.name)
            self._notifier.announce(output.severity, output.text, topic="output")

    def _send_match(self, event: Recognition) -> tuple[FixReport | None, FixTransmission | None]:
        """Send the fix of an accepted match. Return (None, transmission) or, if it is not sent, (its report, None)."""
        try:
            advice = self._navigator.advise(event, self._clock.mono_s())
        except ValueError as error:  # another program wrote an invalid position
            _log.warning("%s: %s; no fix is sent", event.name, error)
            why = Reason(ReasonCode.INVALID_POSITION, {"problem": str(error)})
            return FixReport(query=event.name, sent=False, why=why), None
        self._report_held(advice.why if advice.is_held else None)
        if advice.fix is None or not self._send_fixes:
            return FixReport(query=event.name, sent=False, why=advice.why or DRY_RUN), None
        return None, self._link.send_fix(advice.fix)

    def _report_held(self, objection: Reason | None) -> None:
        """Count a fix that is held back because of `objection`, and report when a run of them begins and ends."""
        before, self._is_holding = self._is_holding, objection is not None
        self._held += self._is_holding
        if objection and not before:
            is_first = objection.code is ReasonCode.HELD_UNCONFIRMED
            gcs_text = "fix held back until another agrees" if is_first else "fix held back, contradicts autopilot"
            self._notifier.announce(Severity.WARNING, f"a fix is {objection}", gcs_text=gcs_text, topic="held back")
        elif before and not self._is_holding:
            self._notifier.announce(Severity.INFO, "fixes agree again", topic="held back")


class SourceSets:
    """Decides which source set to request from the autopilot: `no_gps` when GPS is lost or wrong and we send positions,
    then `gps` once GPS has been good for three seconds, or we have sent none for as long beside a steady receiver that
    the map contradicts. If the first call is in flight, `gps` is requested without `no_gps` before. Each is requested
    until it is answered. Unless both numbers are configured, none is."""

    def __init__(self, settings: SourceSetsConfig) -> None:
        self._with_gps, self._without = settings.gps, settings.no_gps
        self._requested: int | None = None
        self._may_differ: bool | None = None  # the autopilot may use another set than `gps`; None: no call yet
        self._requested_s = math.inf
        self._bad_s = -math.inf  # when GPS was last not good
        self._alternative_s = -math.inf  # when there was last something other than a receiver that the map contradicts

    @property
    def are_set(self) -> bool:
        """True if both numbers are configured; `choose_set` may be called only then."""
        return self._with_gps is not None and self._without is not None

    def choose_set(
        self, now_s: float, *, has_gps: bool, has_receiver: bool, has_own: bool, answered_s: float, is_flying: bool
    ) -> int | None:
        """Return the number of the set to request now (None: no request). `has_gps`: there is a trusted GPS;
        `has_receiver`: a receiver is steady, trusted or not; `has_own`: positions are sent; `answered_s`: when such a
        request was last answered; `is_flying`: the vehicle is in the air."""
        if self._may_differ is None:
            self._may_differ, self._bad_s = is_flying, now_s
        if not has_gps:
            self._bad_s = now_s
        if has_own or not has_receiver:
            self._alternative_s = now_s
        number = self._without if not has_gps and has_own else None
        if self._may_differ and now_s - min(self._bad_s, self._alternative_s) > _MIN_GPS_GOOD_S:
            number = self._with_gps
        is_alive = answered_s >= self._requested_s or now_s - self._requested_s < _SOURCE_SET_RETRY_S
        if number is None or (number == self._requested and is_alive):
            return None
        self._requested, self._requested_s, self._may_differ = number, now_s, True
        return number


def _position_fields(fix: Fix) -> dict[str, float]:
    position = {"lat_deg": round(fix.lat_deg, 7), "lon_deg": round(fix.lon_deg, 7)}
    return {**position, "accuracy_m": round(fix.accuracy_m, 2)}


def combine_confidence(event: Recognition) -> float | None:
    """Return a match's own confidence or that given the flight so far, whichever is higher (None: unknown)."""
    if event.confidence is None:
        return None
    return max(event.confidence, event.track.confidence if event.track else 0.0)
