"""`edgevpr doctor`: checks whether flight controller and board are set up for edgevpr. It only reads, never writes."""

from collections.abc import Iterator

from edgevpr.core.config import Config
from edgevpr.core.errors import LinkError
from edgevpr.core.text import waiting
from edgevpr.frames.source import is_live
from edgevpr.mavlink.address import LinkAddress
from edgevpr.mavlink.asking import AutopilotReading, Inquiry, read_autopilot
from edgevpr.mavlink.signing import MEANING, open_signing
from edgevpr.mavlink.wire import mavlink
from edgevpr.runtime.service.camera import check_camera, frame_seen
from edgevpr.runtime.service.finding import Finding, check_machine, fine, judge, run_check, wrong
from edgevpr.runtime.service.rules import RULES

_SLOW_S = 0.25  # for a round trip: fixes would come as late
_BAD_BYTES = 300  # fewer are usual: the rest of a message or two at the start
_NEEDED = ("GLOBAL_POSITION_INT", "ATTITUDE", "GPS_RAW_INT")
_CLOCK_S = 60.0
_GPS_3D = 3
_IF_SILENT = {
    "udpin": "let the autopilot, its simulator or a router send to this port",
    "udpout": "start what listens there, or correct host and port",
    "tcp": "what answers there is not a flight controller, or is still starting",
}


def doctor(config: Config, address: LinkAddress) -> tuple[list[Finding], AutopilotReading | None]:
    """Check the autopilot at the other end of the link `address`, and this machine. Return the findings, and what was
    read from the autopilot (None: nothing could be read). Raises ConfigError for a board that is unknown or a signing
    key that cannot be used."""
    settings = config.mavlink
    signing = open_signing(settings, to_ask=True)
    of_machine = list(check_machine(config, address))
    if (uri := config.source.uri) and is_live(uri):
        of_camera = list(check_camera(uri))
        if all(finding.ok for finding in of_camera):
            waiting(f"waiting for a frame of {uri}")
            of_camera.append(run_check("frames", lambda: frame_seen(config.source)))
        of_machine += of_camera
    waiting(f"asking the autopilot at {address}")
    reading = None
    try:
        with Inquiry(address, settings.component_id, settings.system_id, signing) as inquiry:
            reading = read_autopilot(inquiry, {name: rules.parameters for name, rules in RULES.items()})
            of_autopilot = (
                list(check_autopilot(reading, address, settings.send_fixes))
                if reading
                else [explain_silence(address, inquiry)]
            )
    except LinkError as error:
        reading, of_autopilot = None, [wrong("link", str(error))]
    waiting("")
    return of_autopilot + of_machine, reading


def explain_silence(address: LinkAddress, inquiry: Inquiry) -> Finding:
    """Return the finding that explains, by what else has arrived, why no heartbeat of the autopilot was received."""
    if refused := inquiry.signing.refused:
        why = max(refused, key=lambda reason: refused[reason])
        return wrong("link", f"{address}: messages arrive, and are refused ({why}): {MEANING[why]}.")
    if inquiry.others:
        systems = " and ".join(map(str, sorted(inquiry.others)))
        message = f"{address}: autopilots of system {systems} send, but not the configured one."
        return wrong("link", message, f"mavlink: {{system_id: {min(inquiry.others)}}}")
    if address.kind != "serial":
        return wrong("link", f"{address}: no heartbeat of an autopilot in 5 s: {_IF_SILENT[address.kind]}.")
    cause = "nothing arrives (TX and RX?)"
    if inquiry.reader.bad_bytes:
        cause = "what arrives is not MAVLink (another baud rate?)"
    return wrong(
        "link",
        f"{address}: no heartbeat in 5 s, {cause}: set the port of the flight controller to MAVLink 2 at "
        "this baud rate, and reboot it.",
        *(f"{rules.name}: {', '.join(rules.port_changes(address.number))}" for rules in RULES.values()),
    )


def check_autopilot(reading: AutopilotReading, address: LinkAddress, sends_fixes: bool) -> Iterator[Finding]:
    """Check what was read from the autopilot against what the flight will do, and yield a finding for each check: those
    for every autopilot, and those of the rules of its firmware."""
    yield _link(reading, address)
    yield _signing(reading)
    if reading.other_systems:
        systems = " and ".join(map(str, reading.other_systems))
        message = f"System {systems} is on this link too: name the one to fly with."
        yield wrong("vehicles", message, f"mavlink: {{system_id: {reading.system_id}}}")
    if reading.firmware not in RULES:
        message = "neither ArduPilot nor PX4: fixes by command 43003 are not tested with it"
        yield judge("firmware", not sends_fixes, message, f"It is {message}.", "mavlink: {send_fixes: false}")
    elif reading.answers:
        yield _firmware(reading)
        yield from RULES[reading.firmware].findings(reading, sends_fixes)
    if reading.answers:
        yield from (_streams(reading), _filter(reading), _gps(reading), _origin(reading), _clock(reading))


def _firmware(reading: AutopilotReading) -> Finding:
    rules = RULES[reading.firmware]
    least = f"{rules.knows_fixes[0]}.{rules.knows_fixes[1]} or later"
    named = f"{rules.name} {reading.version_text}"
    if reading.version is None:
        return wrong("firmware", f"{rules.name} does not report its version: update it to {least}.")
    if reading.version[:2] < rules.knows_fixes:
        old = f"{named} does not know position fixes (command 43003): update it."
        return wrong("firmware", old, f"{rules.name} {least}")
    return fine("firmware", f"{named}, {reading.vehicle}")


def _link(reading: AutopilotReading, address: LinkAddress) -> Finding:
    rules = RULES.get(reading.firmware)
    who = f"{address}: {rules.name if rules else 'an autopilot'}, system {reading.system_id}"
    who += ", armed" if reading.is_armed else ""
    if not reading.answers:
        check = "check the wire from the board's TX to its RX, the signing key, and the clock of this board"
        return wrong("link", f"{who} sends, but answers nothing: {check}.")
    if reading.bad_bytes > _BAD_BYTES:
        check = "check ground wire, cable and baud rate, and whether another program has the port open"
        return wrong("link", f"{who}: {reading.bad_bytes} damaged bytes arrived: {check}.")
    if reading.round_trip_s is None:
        return fine("link", who)
    trip = f"an answer takes {1000 * reading.round_trip_s:.0f} ms"
    if reading.round_trip_s > _SLOW_S:
        late = f"{who}; {trip}, so every fix comes late: use a faster line."
        return wrong("link", late, *(rules.port_changes(921_600) if rules else ()))
    return fine("link", f"{who}; {trip}")


def _signing(reading: AutopilotReading) -> Finding:
    if reading.is_signed_to:
        return fine("signing", "on in both directions")
    if not reading.signs:
        return fine("signing", "off: anyone on this link can send")
    if reading.answers:
        return fine("signing", "it signs its packets, and accepts unsigned ones on this port")
    return wrong(
        "signing",
        "It signs its packets and answers no unsigned request: without its key it accepts no fix.",
        "mavlink: {signing_key: FILE} with the key of this vehicle, or clear the key of this port",
    )


def _streams(reading: AutopilotReading) -> Finding:
    if missing := [name for name in _NEEDED if name not in reading.heard]:
        absent = f"No {' and no '.join(missing)} arrives, even on request: it may be sent only once there is a GPS fix."
        return wrong("streams", absent)
    return fine("streams", "position, attitude and GPS are received")


def _filter(reading: AutopilotReading) -> Finding:
    if reading.filter_flags is None:
        return wrong("filter", "It does not report the state of its filter.")
    flags, has = f"flags 0x{reading.filter_flags:x}", reading.filter_flags
    # ArduPilot's filter assumes a constant position when it has nothing to navigate by; PX4's also while it stands.
    is_lost = has & mavlink.EKF_CONST_POS_MODE and reading.firmware != "px4"
    if has & mavlink.EKF_ATTITUDE and has & mavlink.EKF_POS_HORIZ_ABS and not is_lost:
        return fine("filter", f"has attitude and position ({flags})")
    lacks = "position" if has & mavlink.EKF_ATTITUDE else "attitude"
    return wrong("filter", f"The filter has no {lacks} yet ({flags}): wait, outdoors and standing still.")


def _gps(reading: AutopilotReading) -> Finding:
    fixes = [fix for fix in reading.gps_fix if fix is not None]
    none = "No GPS receiver has a fix: take off only with one, so that the start is known."
    return judge("gps", max(fixes, default=0) >= _GPS_3D, f"fix type {' and '.join(map(str, fixes))}", none)


def _origin(reading: AutopilotReading) -> Finding:
    if reading.origin:
        return fine("origin", f"{reading.origin[0]:.6f}, {reading.origin[1]:.6f}")
    change = "wait for a GPS fix, or set the EKF origin from the ground station"
    return wrong("origin", f"The filter has no origin, so it accepts no position: {change}.")


def _clock(reading: AutopilotReading) -> Finding:
    ahead_s = reading.clock_ahead_s
    if ahead_s is None:
        return fine("clock", "not compared: the autopilot has no time of day yet")
    side = "behind" if ahead_s > 0 else "ahead of"
    return judge(
        "clock",
        abs(ahead_s) <= _CLOCK_S,
        f"{abs(ahead_s):.1f} s {side} the autopilot's",
        f"The board's clock is {abs(ahead_s):.0f} s {side} the autopilot's: logs and signatures would be wrong.",
        "timedatectl set-ntp true, or a clock chip",
    )
