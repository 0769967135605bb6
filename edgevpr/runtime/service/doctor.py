"""`edgevpr doctor`: checks whether flight controller and board are set up for edgevpr, without changing them."""

from collections.abc import Iterable, Iterator

from edgevpr.core.config import Config
from edgevpr.core.errors import LinkError
from edgevpr.core.reasons import ReasonCode
from edgevpr.core.text import show_progress
from edgevpr.frames.source import is_live
from edgevpr.mavlink.address import LinkAddress
from edgevpr.mavlink.clock import HEARTBEAT_TIMEOUT_S
from edgevpr.mavlink.requestlink import AutopilotReading, RequestLink, read_autopilot
from edgevpr.mavlink.signing import REFUSAL_MEANINGS, open_signing
from edgevpr.mavlink.wire import mavlink
from edgevpr.power.boards import load_board
from edgevpr.runtime.service.camera import check_camera, check_frame
from edgevpr.runtime.service.finding import Finding, check_machine, report_error, report_fault, report_ok, run_check
from edgevpr.runtime.service.findingcodes import FindingCode
from edgevpr.runtime.service.rules import RULES

_MAX_ROUND_TRIP_S = 0.25  # a slow link delays fixes too
_MAX_BAD_BYTES = 300  # the rest of one or two messages at the start is normal
_NEEDED_MESSAGES = ("GLOBAL_POSITION_INT", "ATTITUDE", "GPS_RAW_INT")
_MAX_CLOCK_DIFFERENCE_S = 60.0
_GPS_FIX_TYPE_3D = 3


def check_setup(config: Config, address: LinkAddress) -> tuple[list[Finding], AutopilotReading | None]:
    """Check the autopilot at the other end of the link `address`, and this machine. Return the findings and the
    autopilot's values (None: none). Raises ConfigError for an unknown board or a signing key that is unusable."""
    settings, source = config.mavlink, config.source
    signing = open_signing(settings, is_read_only=True)
    machine_findings = list(check_machine(load_board(config.board), config.log, address))
    if (uri := source.uri) and is_live(uri):
        camera_findings = list(check_camera(uri))
        if all(finding.ok for finding in camera_findings):
            show_progress(f"waiting for a frame of {uri}")
            camera_findings.append(run_check("frames", lambda what: check_frame(what, source)))
        machine_findings += camera_findings
    show_progress(f"querying the autopilot at {address}")
    reading = None
    try:
        with RequestLink(address, settings.component_id, settings.system_id, signing) as link:
            reading = read_autopilot(link, {name: rules.parameters for name, rules in RULES.items()})
            if reading:
                autopilot_findings = list(check_autopilot(reading, address, settings.send_fixes))
            else:
                autopilot_findings = [explain_silence(address, link)]
    except LinkError as error:
        reading, autopilot_findings = None, [report_error("link", error)]
    show_progress("")
    return autopilot_findings + machine_findings, reading


def explain_silence(address: LinkAddress, link: RequestLink) -> Finding:
    """Return the finding that explains why no autopilot heartbeat was received, from what was received instead."""
    url = str(address)
    if refused := link.signing.refused:
        cause = max(refused, key=lambda reason: refused[reason])
        meaning = REFUSAL_MEANINGS[cause]
        return report_fault("link", FindingCode.MESSAGES_REFUSED, address=url, cause=cause, meaning=meaning)
    if link.other_systems:
        change = f"mavlink: {{system_id: {min(link.other_systems)}}}"
        systems = _join_numbers(sorted(link.other_systems))
        return report_fault("link", FindingCode.OTHER_SYSTEM, change, address=url, systems=systems)
    if address.kind != "serial":
        return report_fault("link", FindingCode.NO_HEARTBEAT, address=url, waited_s=HEARTBEAT_TIMEOUT_S)
    code = FindingCode.SERIAL_NOT_MAVLINK if link.reader.bad_bytes else FindingCode.SERIAL_SILENT
    changes = (f"{rules.name}: {', '.join(rules.port_changes(address.number))}" for rules in RULES.values())
    return report_fault("link", code, *changes, address=url, waited_s=HEARTBEAT_TIMEOUT_S)


def check_autopilot(reading: AutopilotReading, address: LinkAddress, sends_fixes: bool) -> Iterator[Finding]:
    """Check an autopilot's reading for a flight that sends fixes or not. Yield a finding for each check that applies to
    every autopilot, then for each rule of its firmware."""
    yield _check_link(reading, address)
    yield _check_signing(reading)
    if reading.other_systems:
        change = f"mavlink: {{system_id: {reading.system_id}}}"
        systems = _join_numbers(reading.other_systems)
        yield report_fault("vehicles", FindingCode.SYSTEM_NOT_NAMED, change, systems=systems)
    if reading.firmware not in RULES and sends_fixes:
        yield report_fault("firmware", FindingCode.FIRMWARE_UNTESTED, "mavlink: {send_fixes: false}")
    elif reading.firmware not in RULES:
        yield report_ok("firmware", FindingCode.FIRMWARE_UNTESTED)
    elif reading.answers:
        yield _check_firmware(reading)
        yield from RULES[reading.firmware].check(reading, sends_fixes)
    if reading.answers:
        yield from _check_state(reading)


def _check_firmware(reading: AutopilotReading) -> Finding:
    rules = RULES[reading.firmware]
    facts = {"firmware": rules.name, "version": reading.version_text or "of unknown version"}
    if reading.version is None or reading.version[:2] < rules.min_version:
        return report_fault("firmware", FindingCode.FIRMWARE_OLD, least=".".join(map(str, rules.min_version)), **facts)
    return report_ok("firmware", FindingCode.FIRMWARE_KNOWN, vehicle=reading.vehicle, **facts)


def _check_link(reading: AutopilotReading, address: LinkAddress) -> Finding:
    rules = RULES.get(reading.firmware)
    link: dict[str, str | float | None] = {
        "address": str(address),
        "firmware": rules.name if rules else "an autopilot",
        "system": reading.system_id,
        "state": "armed" if reading.is_armed else "disarmed",
    }
    if not reading.answers:
        return report_fault("link", FindingCode.LINK_ONE_WAY, **link)
    if reading.bad_bytes > _MAX_BAD_BYTES:
        return report_fault("link", FindingCode.LINK_DAMAGED, bad_bytes=reading.bad_bytes, **link)
    trip_s = reading.round_trip_s
    link["trip_ms"] = None if trip_s is None else 1e3 * trip_s
    if trip_s is not None and trip_s > _MAX_ROUND_TRIP_S:
        return report_fault("link", FindingCode.LINK_SLOW, *(rules.port_changes(921_600) if rules else ()), **link)
    return report_ok("link", FindingCode.LINK_ANSWERS, **link)


def _check_signing(reading: AutopilotReading) -> Finding:
    if reading.signs_requests:
        return report_ok("signing", FindingCode.SIGNED)
    if reading.signs and not reading.answers:
        return report_fault("signing", FindingCode.KEY_NEEDED)
    return report_ok("signing", FindingCode.UNSIGNED)


def _check_state(reading: AutopilotReading) -> Iterator[Finding]:
    """Check the autopilot's current state: streams, filter, GPS, origin and clock."""
    if missing := [name for name in _NEEDED_MESSAGES if name not in reading.received]:
        yield report_fault("streams", FindingCode.STREAMS_MISSING, missing=" and no ".join(missing))
    else:
        yield report_ok("streams", FindingCode.STREAMS_RECEIVED)
    yield _check_filter(reading)
    types = [fix for fix in reading.gps_fix if fix is not None]
    if max(types, default=0) < _GPS_FIX_TYPE_3D:
        yield report_fault("gps", FindingCode.NO_GPS_FIX)
    else:
        yield report_ok("gps", FindingCode.GPS_FIX, types=_join_numbers(types))
    if reading.origin is None:
        yield report_fault("origin", ReasonCode.NO_ORIGIN)
    else:
        yield report_ok("origin", FindingCode.ORIGIN_KNOWN, lat_deg=reading.origin[0], lon_deg=reading.origin[1])
    if reading.clock_ahead_s is None:
        yield report_ok("clock", FindingCode.CLOCK_NOT_COMPARED)
    elif abs(reading.clock_ahead_s) > _MAX_CLOCK_DIFFERENCE_S:
        change = "timedatectl set-ntp true"
        yield report_fault("clock", FindingCode.CLOCK_DIFFERS, change, ahead_s=reading.clock_ahead_s)
    else:
        yield report_ok("clock", FindingCode.CLOCK_AGREES, ahead_s=reading.clock_ahead_s)


def _check_filter(reading: AutopilotReading) -> Finding:
    if (flags := reading.filter_flags) is None:
        return report_fault("filter", FindingCode.FILTER_UNKNOWN)
    # ArduPilot's filter assumes a constant position if it has no aiding source. PX4's also does so on the ground.
    is_lost = flags & mavlink.EKF_CONST_POS_MODE and reading.firmware != "px4"
    if flags & mavlink.EKF_ATTITUDE and flags & mavlink.EKF_POS_HORIZ_ABS and not is_lost:
        return report_ok("filter", FindingCode.FILTER_READY, flags=flags)
    missing = "position" if flags & mavlink.EKF_ATTITUDE else "attitude"
    return report_fault("filter", FindingCode.FILTER_NOT_READY, lacks=missing, flags=flags)


def _join_numbers(numbers: Iterable[int]) -> str:
    return " and ".join(map(str, numbers))
