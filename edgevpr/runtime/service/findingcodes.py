"""The table of findings of `edgevpr check` and `doctor`: codes, and sentences with what to do. A finding that a flight
reports too has a code of `edgevpr.core.reasons`."""

from edgevpr.core.reasons import Code

_DEVICE = "{path}, group {group}, mode {mode}"
_LINK = ("{address}", ", autopilot of system {system:.0f}", ", signed with {key}")
_AUTOPILOT = "{address}: {firmware}, system {system:.0f}, {state}"
_NO_HEARTBEAT = "{address}: no heartbeat of an autopilot in {waited_s:g} s: "
_SET_PORT = "set the port of the flight controller to MAVLink 2 at this baud rate, and reboot it"


class FindingCode(Code):
    """The codes of findings."""

    # Configuration, map and logs
    FILE_USABLE = "{path}"
    BOARD_KNOWN = "{board}, up to {memory_mb:.0f} MB for edgevpr"
    FILE_UNUSABLE = "{path}: {problem}: check the path and its permissions"
    MAP_READY = "{path}, {technique}; {cost}; a query takes {t_query_s:.2f} s", "; {confidence}"
    QUERY_TOO_SLOW = (
        "a query takes {t_query_s:.1f} s, and no fix of a frame older than {limit_s:g} s is sent: ",
        "use a faster board, fewer places or candidates, or a technique that costs less",
    )
    NO_LOG = "no flight log is configured: nothing of the flight is recorded"
    LOG_NOT_A_FILE = "{path} is not a file in an existing folder: correct `log: {{path: ...}}`"
    LOG_NOT_WRITABLE = "{path} cannot be written by this user: change its permissions or `log: {{path: ...}}`"
    DISK_FULL = "{path}: only {free_mb:.1f} MB are free there, {needed_mb:g} are needed: make room"

    # Memory and devices
    MEMORY_LIMIT = "{limit_mb:.0f} of {ram_mb:.0f} MB available to this process"
    MEMORY_LIMIT_LOW = "{limit_mb:.0f} of {ram_mb:.0f} MB available to this process, {needed_mb:.0f} needed"
    MEMORY_LIMIT_IGNORED = "the kernel does not limit memory: add cgroup_enable=memory to cmdline.txt, and reboot"
    DEVICE_READY = _DEVICE
    DEVICE_ABSENT = "{path}: {problem}: connect it, or correct the name"
    NOT_A_DEVICE = "{path} is not a device: correct the name"
    DEVICE_IN_USE = "{path} is in use by {program}: stop it"
    PORT_IS_CONSOLE = "{path} is the kernel's console: remove console={console} from its cmdline.txt, and reboot"
    DEVICE_DENIED = _DEVICE, ": user {user:.0f} has no access"

    # The source of frames
    NO_SOURCE = "no source of frames is configured: write `source: {{uri: ...}}`"
    SOURCE_OPENED = "{uri}, {state}"
    CAMERA_ABSENT = "the camera is not there ({problem}): connect it, or correct `source: {{uri: ...}}`"
    CAMERA_LISTED = "{uri}: {camera}, read by {program}"
    CAMERA_LIST_HANGS = "{program} --list-cameras does not return: restart the board"
    CAMERA_NOT_LISTED = (
        "{program} --list-cameras lists {cameras}, not {uri}: ",
        "with the power off, push in both ends of the ribbon; else correct camera_auto_detect in config.txt",
    )
    FRAME_RECEIVED = (
        "{uri}, {state}, {width:.0f} x {height:.0f} pixels",
        ", field of view {fov_deg:.0f} degrees (by {lens})",
        ", {facts}",
        ", {age_s:.1f} s old: a flight accepts it",
    )
    FRAMES_LATE = "{uri}: frames are {age_s:.1f} s old (limit {limit_s:g} s): reduce the camera's buffering"
    NO_FRAME = "{uri}: no frame in {waited_s:.0f} s ({state}): start it, or correct `source: {{uri: ...}}`"

    # The link
    LINK_OPENED = _LINK
    LINK_OPENED_DRY = *_LINK, ", dry run: no fix is sent"
    MESSAGES_REFUSED = "{address}: messages arrive but are refused ({cause}): {meaning}"
    OTHER_SYSTEM = "{address}: heartbeats from system {systems}, but none from the configured system"
    NO_HEARTBEAT = _NO_HEARTBEAT, "start the other end, or correct host and port"
    SERIAL_SILENT = _NO_HEARTBEAT, "nothing is received (are TX and RX swapped?): ", _SET_PORT
    SERIAL_NOT_MAVLINK = _NO_HEARTBEAT, "what arrives is not MAVLink (another baud rate?): ", _SET_PORT
    LINK_ANSWERS = _AUTOPILOT, "; round trip {trip_ms:.0f} ms"
    LINK_SLOW = _AUTOPILOT, "; round trip {trip_ms:.0f} ms, so every fix comes late: use a faster line"
    LINK_DAMAGED = _AUTOPILOT, "; {bad_bytes:.0f} damaged bytes arrived: check ground wire, cable and baud rate"
    LINK_ONE_WAY = _AUTOPILOT, ", answers no request: check the wire to its RX, the signing key, and this board's clock"
    SYSTEM_NOT_NAMED = "system {systems} is on this link too: configure the system of this aircraft"
    MAVLINK_2 = "MAVLink 2"
    MAVLINK_1 = "the autopilot sends MAVLink 1, which has neither signing nor the messages for positions"
    SIGNED = "on in both directions"
    UNSIGNED = "off: anyone on this link can send"
    KEY_NEEDED = "the autopilot signs and answers no unsigned request: give its key by `mavlink: {{signing_key: FILE}}`"

    # The autopilot
    FIRMWARE_KNOWN = "{firmware} {version}, {vehicle}"
    FIRMWARE_UNTESTED = "neither ArduPilot nor PX4: fixes by command 43003 are not tested with it"
    FIRMWARE_OLD = "{firmware} {version}: position fixes (command 43003) need {least} or later: update it"
    COMMAND_WITH_FLOW = "command 43003; optical flow (FLOW_TYPE={flow:g}) carries the position between fixes"
    NOT_CARRIED = (
        "no sensor carries the position of this {vehicle} between fixes, so without GPS its failsafe acts in seconds: ",
        "set it up for continuous positions, and reboot",
        ", in place of its receiver of type {receiver_type:g}",
        ", unless another system aboard sends ODOMETRY ({parameter} is {value:g})",
    )
    CHANGES_AFTER_DRY_RUN = "a dry run needs no change; the first flight that sends fixes needs {changes}"
    DRY_RUN_NOT_ARMED = (
        "a dry run sends no positions by {channel}, so this {vehicle} would not arm: ",
        "change this until the first flight that sends fixes, and reboot",
    )
    PARAMETERS_RIGHT = "all parameters that affect the positions of edgevpr are correct"
    STREAMS_RECEIVED = "position, attitude and GPS are received"
    STREAMS_MISSING = "no {missing} arrives, even on request: it may be sent only once there is a GPS fix"
    FILTER_READY = "has attitude and position (flags 0x{flags:x})"
    FILTER_NOT_READY = "the filter has no {lacks} yet (flags 0x{flags:x}): wait, outdoors and standing still"
    FILTER_UNKNOWN = "the autopilot does not report the state of its filter"
    GPS_FIX = "fix type {types}"
    NO_GPS_FIX = "no GPS receiver has a fix: wait for one before take-off, so that the start position is known"
    ORIGIN_KNOWN = "{lat_deg:.6f}, {lon_deg:.6f}"
    CLOCK_AGREES = "the autopilot's clock minus the board's: {ahead_s:+.1f} s"
    CLOCK_DIFFERS = (
        "the autopilot's clock minus the board's: {ahead_s:+.0f} s: set it, or log times and signatures are wrong"
    )
    CLOCK_NOT_COMPARED = "not compared: the autopilot has no time of day yet"

    def __init__(self, *parts: str) -> None:
        super().__init__("", *parts)
