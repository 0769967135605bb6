"""`edgevpr doctor`: checks whether flight controller and board are set up for edgevpr. It only reads, never writes."""

from collections.abc import Iterable, Iterator

from edgevpr.core.config import Config
from edgevpr.core.errors import LinkError
from edgevpr.core.reasons import ReasonCode
from edgevpr.core.text import show_waiting
from edgevpr.frames.source import is_live
from edgevpr.mavlink.address import LinkAddress
from edgevpr.mavlink.asking import HEARTBEAT_WAIT_S, AutopilotReading, Inquiry, read_autopilot
from edgevpr.mavlink.signing import MEANING, open_signing
from edgevpr.mavlink.wire import mavlink
from edgevpr.power.boards import load_board
from edgevpr.runtime.service.camera import check_camera, check_frame
from edgevpr.runtime.service.finding import Finding, check_machine, fine, refuse, run_check, wrong
from edgevpr.runtime.service.findingcodes import FindingCode
from edgevpr.runtime.service.rules import RULES

_SLOW_S = 0.25  # for a round trip: fixes would come as late
_BAD_BYTES = 300  # fewer are usual: the rest of a message or two at the start
_NEEDED = ("GLOBAL_POSITION_INT", "ATTITUDE", "GPS_RAW_INT")
_CLOCK_S = 60.0
_GPS_3D = 3


def doctor(config: Config, address: LinkAddress) -> tuple[list[Finding], AutopilotReading | None]:
    """Check the autopilot at the other end of the link `address`, and this machine. Return the findings, and what was
    read from the autopilot (None: nothing could be read). Raises ConfigError for a board that is unknown or a signing
    key that cannot be used."""
    settings, source = config.mavlink, config.source
    signing = open_signing(settings, to_ask=True)
    of_machine = list(check_machine(load_board(config.board), config.log, address))
    if (uri := source.uri) and is_live(uri):
        of_camera = list(check_camera(uri))
        if all(finding.ok for finding in of_camera):
            show_waiting(f"waiting for a frame of {uri}")
            of_camera.append(run_check("frames", lambda what: check_frame(what, source)))
        of_machine += of_camera
    show_waiting(f"asking the autopilot at {address}")
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
        reading, of_autopilot = None, [refuse("link", error)]
    show_waiting("")
    return of_autopilot + of_machine, reading


def explain_silence(address: LinkAddress, inquiry: Inquiry) -> Finding:
    """Return the finding that explains, by what else has arrived, why no heartbeat of the autopilot was received."""
    link = str(address)
    if refused := inquiry.signing.refused:
        cause = max(refused, key=lambda reason: refused[reason])
        return wrong("link", FindingCode.MESSAGES_REFUSED, address=link, cause=cause, meaning=MEANING[cause])
    if inquiry.others:
        change = f"mavlink: {{system_id: {min(inquiry.others)}}}"
        return wrong("link", FindingCode.OTHER_SYSTEM, change, address=link, systems=_join(sorted(inquiry.others)))
    if address.kind != "serial":
        return wrong("link", FindingCode.NO_HEARTBEAT, address=link, waited_s=HEARTBEAT_WAIT_S)
    code = FindingCode.SERIAL_NOT_MAVLINK if inquiry.reader.bad_bytes else FindingCode.SERIAL_SILENT
    changes = (f"{rules.name}: {', '.join(rules.port_changes(address.number))}" for rules in RULES.values())
    return wrong("link", code, *changes, address=link, waited_s=HEARTBEAT_WAIT_S)


def check_autopilot(reading: AutopilotReading, address: LinkAddress, sends_fixes: bool) -> Iterator[Finding]:
    """Check what was read from the autopilot against what the flight will do, and yield a finding for each check: those
    for every autopilot, and those of the rules of its firmware."""
    yield _link(reading, address)
    yield _signing(reading)
    if reading.other_systems:
        change = f"mavlink: {{system_id: {reading.system_id}}}"
        yield wrong("vehicles", FindingCode.SYSTEM_NOT_NAMED, change, systems=_join(reading.other_systems))
    if reading.firmware not in RULES and sends_fixes:
        yield wrong("firmware", FindingCode.FIRMWARE_UNTESTED, "mavlink: {send_fixes: false}")
    elif reading.firmware not in RULES:
        yield fine("firmware", FindingCode.FIRMWARE_UNTESTED)
    elif reading.answers:
        yield _firmware(reading)
        yield from RULES[reading.firmware].findings(reading, sends_fixes)
    if reading.answers:
        yield from _state(reading)


def _firmware(reading: AutopilotReading) -> Finding:
    rules = RULES[reading.firmware]
    named = {"firmware": rules.name, "version": reading.version_text or "of unknown version"}
    if reading.version is None or reading.version[:2] < rules.knows_fixes:
        return wrong("firmware", FindingCode.FIRMWARE_OLD, least=".".join(map(str, rules.knows_fixes)), **named)
    return fine("firmware", FindingCode.FIRMWARE_KNOWN, vehicle=reading.vehicle, **named)


def _link(reading: AutopilotReading, address: LinkAddress) -> Finding:
    rules = RULES.get(reading.firmware)
    link: dict[str, str | float | None] = {
        "address": str(address),
        "firmware": rules.name if rules else "an autopilot",
        "system": reading.system_id,
        "state": "armed" if reading.is_armed else "disarmed",
    }
    if not reading.answers:
        return wrong("link", FindingCode.LINK_ONE_WAY, **link)
    if reading.bad_bytes > _BAD_BYTES:
        return wrong("link", FindingCode.LINK_DAMAGED, bad_bytes=reading.bad_bytes, **link)
    trip_s = reading.round_trip_s
    link["trip_ms"] = None if trip_s is None else 1e3 * trip_s
    if trip_s is not None and trip_s > _SLOW_S:
        return wrong("link", FindingCode.LINK_SLOW, *(rules.port_changes(921_600) if rules else ()), **link)
    return fine("link", FindingCode.LINK_ANSWERS, **link)


def _signing(reading: AutopilotReading) -> Finding:
    if reading.is_signed_to:
        return fine("signing", FindingCode.SIGNED)
    if reading.signs and not reading.answers:
        return wrong("signing", FindingCode.KEY_NEEDED)
    return fine("signing", FindingCode.UNSIGNED)


def _state(reading: AutopilotReading) -> Iterator[Finding]:
    """Check what the autopilot sends and knows at this moment."""
    if missing := [name for name in _NEEDED if name not in reading.heard]:
        yield wrong("streams", FindingCode.STREAMS_MISSING, missing=" and no ".join(missing))
    else:
        yield fine("streams", FindingCode.STREAMS_RECEIVED)
    yield _filter(reading)
    types = [fix for fix in reading.gps_fix if fix is not None]
    if max(types, default=0) < _GPS_3D:
        yield wrong("gps", FindingCode.NO_GPS_FIX)
    else:
        yield fine("gps", FindingCode.GPS_FIX, types=_join(types))
    if reading.origin is None:
        yield wrong("origin", ReasonCode.NO_ORIGIN)
    else:
        yield fine("origin", FindingCode.ORIGIN_KNOWN, lat_deg=reading.origin[0], lon_deg=reading.origin[1])
    if reading.clock_ahead_s is None:
        yield fine("clock", FindingCode.CLOCK_NOT_COMPARED)
    elif abs(reading.clock_ahead_s) > _CLOCK_S:
        yield wrong("clock", FindingCode.CLOCK_DIFFERS, "timedatectl set-ntp true", ahead_s=reading.clock_ahead_s)
    else:
        yield fine("clock", FindingCode.CLOCK_AGREES, ahead_s=reading.clock_ahead_s)


def _filter(reading: AutopilotReading) -> Finding:
    if (flags := reading.filter_flags) is None:
        return wrong("filter", FindingCode.FILTER_UNKNOWN)
    # ArduPilot's filter assumes a constant position when it has nothing to navigate by; PX4's also while it stands.
    is_lost = flags & mavlink.EKF_CONST_POS_MODE and reading.firmware != "px4"
    if flags & mavlink.EKF_ATTITUDE and flags & mavlink.EKF_POS_HORIZ_ABS and not is_lost:
        return fine("filter", FindingCode.FILTER_READY, flags=flags)
    lacks = "position" if flags & mavlink.EKF_ATTITUDE else "attitude"
    return wrong("filter", FindingCode.FILTER_NOT_READY, lacks=lacks, flags=flags)


def _join(numbers: Iterable[int]) -> str:
    return " and ".join(map(str, numbers))
