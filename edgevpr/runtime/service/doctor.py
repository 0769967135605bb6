"""`edgevpr doctor`: checks whether flight controller and board are set up for edgevpr. It only reads, never writes."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from edgevpr.core.config import Config
from edgevpr.core.errors import LinkError
from edgevpr.frames.source import is_live
from edgevpr.mavlink.address import LinkAddress
from edgevpr.mavlink.asking import AutopilotReading, Inquiry, read_autopilot
from edgevpr.mavlink.signing import MEANING, open_signing
from edgevpr.mavlink.wire import mavlink
from edgevpr.runtime.service.camera import camera_findings, frame_seen
from edgevpr.runtime.service.finding import Finding, board_findings, fine, judged, looked_at, wrong
from edgevpr.runtime.service.rules import RULES

_SLOW_S = 0.25  # for a round trip: fixes would come as late
_BAD_BYTES = 300  # fewer are usual: the rest of a message or two at the start
_NEEDED = ("GLOBAL_POSITION_INT", "ATTITUDE", "GPS_RAW_INT")
_CLOCK_S = 60.0
_GPS_3D = 3
_WHERE_SILENT = {
    "udpin": "let the autopilot, its simulator or a router send to this port",
    "udpout": "start what listens there, or correct host and port",
    "tcp": "something answers there that is no flight controller, or one that is still starting",
}


def doctor(
    config: Config, address: LinkAddress, say: Callable[[str], None], root: Path = Path("/")
) -> tuple[list[Finding], AutopilotReading | None]:
    """Check the autopilot at the other end of the link `address`, and this machine (its files below `root`). Return the
    findings, and what was read from the autopilot (None: nothing could be read).

    `say` is called with a short text while answers are awaited, and with "" after that. Raises ConfigError for a
    board that is unknown or a signing key that cannot be used.
    """
    settings = config.mavlink
    signing = open_signing(settings.signing_key, settings.signing_state, to_ask=True)
    about_board = list(board_findings(config, address, root))
    if (uri := config.source.uri) and is_live(uri):
        about_camera = list(camera_findings(uri, root))
        if all(finding.ok for finding in about_camera):
            say(f"waiting for a frame of {uri}")
            about_camera.append(looked_at("frames", lambda: frame_seen(config.source)))
        about_board += about_camera
    say(f"asking the autopilot at {address}")
    reading = None
    try:
        with Inquiry(address, settings.component_id, settings.system_id, signing) as asking:
            reading = read_autopilot(asking, {name: rules.parameters for name, rules in RULES.items()})
            if reading:
                about_autopilot = list(autopilot_findings(reading, address, settings.send_fixes))
            else:
                about_autopilot = [silence(address, asking.reader.bad_bytes, asking.others, asking.signing.refused)]
    except LinkError as error:
        reading, about_autopilot = None, [wrong("link", str(error))]
    say("")
    return about_autopilot + about_board, reading


def silence(address: LinkAddress, bad_bytes: int, others: set[int], refused: Mapping[str, int]) -> Finding:
    """Return the finding that explains why no heartbeat was received, from what else has arrived: bytes that are no
    MAVLink, system ids of other autopilots, and numbers of messages with refused signatures, by reason."""
    if refused:
        why = max(refused, key=lambda reason: refused[reason])
        return wrong("link", f"{address}: messages arrive, and are refused ({why}): {MEANING[why]}.")
    if others:
        systems = " and ".join(map(str, sorted(others)))
        unlike = f"{address}: the autopilots heard are of system {systems}, none is the one configured."
        return wrong("link", unlike, f"mavlink: {{system_id: {min(others)}}}")
    if address.kind == "serial":
        seen = (
            "bytes arrive that are no MAVLink (another baud rate, or another program?)"
            if bad_bytes
            else "nothing arrives (TX and RX?)"
        )
        return wrong(
            "link",
            f"{address}: no heartbeat in 5 s, {seen}: set the port of the flight controller for MAVLink 2 at this "
            "baud rate, and reboot it.",
            *(f"{rules.name}: {', '.join(rules.port_changes(address.number))}" for rules in RULES.values()),
        )
    return wrong("link", f"{address}: no heartbeat of an autopilot in 5 s: {_WHERE_SILENT[address.kind]}.")


def autopilot_findings(reading: AutopilotReading, address: LinkAddress, sends_fixes: bool) -> Iterator[Finding]:
    """Check what was read from the autopilot against what the flight will do, and yield a finding for each check: those
    for every autopilot, and those of the rules of its firmware."""
    yield _link(reading, address)
    yield _signing(reading)
    if reading.other_systems:
        systems = " and ".join(map(str, reading.other_systems))
        also = f"System {systems} is on this link too: name the one to fly with."
        yield wrong("vehicles", also, f"mavlink: {{system_id: {reading.system_id}}}")
    if reading.firmware not in RULES:
        dry = "it is neither ArduPilot nor PX4; a dry run sends it no fix"
        fixes = (
            "It is neither ArduPilot nor PX4: a flight would send it fixes by command 43003, untried with it: fly dry."
        )
        yield judged("firmware", not sends_fixes, dry, fixes, "mavlink: {send_fixes: false}")
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
        return wrong("firmware", f"{rules.name} does not tell its version: update it to {least}.")
    if reading.version[:2] < rules.knows_fixes:
        old = f"{named} does not know position fixes (command 43003): update it."
        return wrong("firmware", old, f"{rules.name} {least}")
    return fine("firmware", f"{named}, {reading.vehicle}")


def _link(reading: AutopilotReading, address: LinkAddress) -> Finding:
    rules = RULES.get(reading.firmware)
    who = f"{address}: {rules.name if rules else 'an autopilot'}, system {reading.system_id}"
    who += ", armed" if reading.is_armed else ""
    if not reading.answers:
        why = "the wire from the board's TX to its RX, or a signing key, may be the reason"
        if reading.signs:
            why = "it signs its packets, so it may want signed requests"
        if reading.is_signed_to:
            why = "the wire from the board's TX to its RX, or the clock of this board, may be the reason"
        return wrong("link", f"{who} is heard, but answers nothing: {why}.")
    if reading.bad_bytes > _BAD_BYTES:
        look_at = "look at ground wire, cable and baud rate, and for another program on the port"
        return wrong("link", f"{who}: {reading.bad_bytes} bytes arrived damaged: {look_at}.")
    if reading.round_trip_s is None:
        return fine("link", who)
    trip = f"an answer takes {1000 * reading.round_trip_s:.0f} ms"
    if reading.round_trip_s > _SLOW_S:
        late = f"{who}; {trip}, so every fix comes late: use a faster line."
        return wrong("link", late, *(rules.port_changes(921_600) if rules else ()))
    return fine("link", f"{who}; {trip}")


def _signing(reading: AutopilotReading) -> Finding:
    if reading.is_signed_to:
        return fine("signing", "its packets carry the right signature, and so do ours")
    if not reading.signs:
        return fine("signing", "off: whoever is on this link can send")
    if reading.answers:
        return fine("signing", "it signs its packets, and answers unsigned requests on this port")
    return wrong(
        "signing",
        "It signs its packets and answers no unsigned request: no fix would be taken without its key.",
        "mavlink: {signing_key: FILE} with the key of this vehicle, or clear the key of this port",
    )


def _streams(reading: AutopilotReading) -> Finding:
    if missing := [name for name in _NEEDED if name not in reading.heard]:
        return wrong(
            "streams",
            f"No {' and no '.join(missing)} comes, even on request: an autopilot that does not know its position "
            "yet may keep it back; let it have GPS.",
        )
    return fine("streams", "position, attitude and GPS come; in flight edgevpr asks for what it needs")


def _filter(reading: AutopilotReading) -> Finding:
    if reading.filter_flags is None:
        return wrong("filter", "It does not say how its filter is, so no fix could be weighed against it.")
    flags, has = f"flags 0x{reading.filter_flags:x}", reading.filter_flags
    # In constant-position mode ArduPilot's filter takes the vehicle to stand still, since it has nothing to navigate
    # by. PX4's says so too while it stands still.
    is_lost = has & mavlink.EKF_CONST_POS_MODE and reading.firmware != "px4"
    if has & mavlink.EKF_ATTITUDE and has & mavlink.EKF_POS_HORIZ_ABS and not is_lost:
        return fine("filter", f"attitude and position are known ({flags})")
    lacks = "position" if has & mavlink.EKF_ATTITUDE else "attitude"
    return wrong("filter", f"The filter has no {lacks} yet ({flags}): wait, outdoors and standing still.")


def _gps(reading: AutopilotReading) -> Finding:
    fixes = [fix for fix in reading.gps_fix if fix is not None]
    none = "No GPS receiver has a fix: take off only with one, so that the start is known."
    return judged("gps", max(fixes, default=0) >= _GPS_3D, f"fix type {' and '.join(map(str, fixes))}", none)


def _origin(reading: AutopilotReading) -> Finding:
    if reading.origin:
        return fine("origin", f"{reading.origin[0]:.6f}, {reading.origin[1]:.6f}")
    return wrong(
        "origin",
        "The filter has no origin, and without one no position on the Earth is taken: wait for a GPS fix, or set the "
        "EKF origin from the ground station.",
    )


def _clock(reading: AutopilotReading) -> Finding:
    ahead_s = reading.clock_ahead_s
    if ahead_s is None:
        return fine("clock", "the autopilot has no time of day yet, so the board's is not compared with it")
    side = "behind" if ahead_s > 0 else "ahead of"
    return judged(
        "clock",
        abs(ahead_s) <= _CLOCK_S,
        f"{abs(ahead_s):.1f} s {side} the autopilot's",
        f"The board's clock is {abs(ahead_s):.0f} s {side} the autopilot's: flight logs and signatures would carry the "
        "wrong time.",
        "timedatectl set-ntp true, or a clock chip",
    )
