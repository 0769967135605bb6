"""The findings of `edgevpr check` and `doctor`: each code, and the sentence that states the fact and the remedy.
Findings that a flight also reports have their codes in `edgevpr.core.reasons`."""

from edgevpr.core.reasons import Code

_DEVICE = "{path}, group {group}, mode {mode}"
_LINK = ("{address}", ", autopilot of system {system:.0f}", ", signed with {key}")
_AUTOPILOT = "{address}: {firmware}, system {system:.0f}, {state}"
_NO_HEARTBEAT = "{address}: no heartbeat from an autopilot within {waited_s:g} s: "
_SET_PORT = "configure the flight controller's port for MAVLink 2 at this baud rate, and reboot the flight controller"


class FindingCode(Code):
    """The codes of findings."""

    # Configuration, map and logs
    FILE_USABLE = "{path}"
    BOARD_KNOWN = "{board}, up to {memory_mb:.0f} MB for edgevpr"
    FILE_UNUSABLE = "{path}: {problem}: check the path and the file's permissions"
    MAP_READY = (
        "{path}, {technique}; {accuracy}",
        "; a query takes {t_query_s:.2f} s on {machine} ({rate_hz:g} Hz needed)",
        "; {confidence}",
    )
    QUERY_TOO_SLOW = (
        "a query takes {t_query_s:.1f} s on {machine}, but fixes from frames older than {limit_s:g} s are never sent: ",
        "use a faster board, fewer places or candidates, or a cheaper technique",
    )
    NO_LOG = "no flight log is configured: the flight is not recorded"
    LOG_NOT_A_FILE = "{path} is not a file in an existing folder: correct `log: {{path: ...}}`"
    LOG_NOT_WRITABLE = "this user cannot write {path}: change its permissions or `log: {{path: ...}}`"
    DISK_FULL = "{path}: only {free_mb:.1f} MB free on its disk, {needed_mb:g} MB needed: free some space"

    # Memory and devices
    MEMORY_LIMIT = "{limit_mb:.0f} of {ram_mb:.0f} MB available to this process"
    MEMORY_LIMIT_LOW = "{limit_mb:.0f} of {ram_mb:.0f} MB available to this process, {needed_mb:.0f} MB needed"
    MEMORY_LIMIT_IGNORED = "the kernel ignores memory limits: add cgroup_enable=memory to cmdline.txt, and reboot"
    DEVICE_READY = _DEVICE
    DEVICE_ABSENT = "{path}: {problem}: connect the device, or correct its path"
    NOT_A_DEVICE = "{path} is not a device: correct the path"
    DEVICE_IN_USE = "{path} is in use by {program}: stop that program"
    PORT_IS_CONSOLE = "{path} is the kernel's console: remove console={console} from cmdline.txt, and reboot"
    DEVICE_DENIED = _DEVICE, ": user {user:.0f} has no access"

    # The frame source
    NO_SOURCE = "no frame source is configured: add `source: {{uri: ...}}` to the configuration"
    SOURCE_OPENED = "{uri}, {state}"
    CAMERA_ABSENT = "no camera found ({problem}): connect it, or correct `source: {{uri: ...}}`"
    CAMERA_LISTED = "{uri}: {camera}, read by {program}"
    CAMERA_LIST_HANGS = "{program} --list-cameras hangs: reboot the board"
    CAMERA_NOT_LISTED = (
        "{program} --list-cameras lists {cameras}, not {uri}: ",
        "power the board off and reseat both ends of the ribbon cable, or correct camera_auto_detect in config.txt",
    )
    FRAME_RECEIVED = (
        "{uri}, {state}, {width:.0f} x {height:.0f} pixels",
        ", field of view {fov_deg:.0f} degrees (from {lens})",
        ", {facts}",
        ", {age_s:.1f} s old: recent enough for a flight",
    )
    FRAMES_LATE = "{uri}: frames are {age_s:.1f} s old (limit {limit_s:g} s): reduce the camera's buffering"
    NO_FRAME = "{uri}: no frame within {waited_s:.0f} s ({state}): start the source, or correct `source: {{uri: ...}}`"

    # The link
    LINK_OPENED = _LINK
    LINK_OPENED_DRY = *_LINK, ", dry run: no fix is sent"
    MESSAGES_REFUSED = "{address}: messages arrive but are rejected ({cause}): {meaning}"
    OTHER_SYSTEM = "{address}: heartbeats from system {systems}, but none from the configured system"
    NO_HEARTBEAT = _NO_HEARTBEAT, "start the other end of the link, or correct host and port"
    SERIAL_SILENT = _NO_HEARTBEAT, "no data is received (are TX and RX swapped?): ", _SET_PORT
    SERIAL_NOT_MAVLINK = _NO_HEARTBEAT, "the data received is not MAVLink (wrong baud rate?): ", _SET_PORT
    LINK_ANSWERS = _AUTOPILOT, "; round trip {trip_ms:.0f} ms"
    LINK_SLOW = _AUTOPILOT, "; round trip {trip_ms:.0f} ms, so every fix arrives late: use a faster link"
    LINK_DAMAGED = _AUTOPILOT, "; {bad_bytes:.0f} corrupt bytes received: check ground wire, cable and baud rate"
    LINK_ONE_WAY = _AUTOPILOT, ", does not answer requests: check its RX wire, the signing key and this board's clock"
    SYSTEM_NOT_NAMED = "system {systems} is also on this link: configure the system ID of this aircraft"
    MAVLINK_2 = "MAVLink 2"
    MAVLINK_1 = "the autopilot sends MAVLink 1, which supports neither signing nor the position messages"
    SIGNED = "on in both directions"
    UNSIGNED = "off: anyone on this link can send commands"
    KEY_NEEDED = "the autopilot signs and ignores unsigned requests: set its key as `mavlink: {{signing_key: FILE}}`"

    # The autopilot
    FIRMWARE_KNOWN = "{firmware} {version}, {vehicle}"
    FIRMWARE_UNTESTED = "neither ArduPilot nor PX4: fixes via command 43003 are untested with this firmware"
    FIRMWARE_OLD = "{firmware} {version}: position fixes (command 43003) need {least} or later: update the firmware"
    COMMAND_WITH_FLOW = "command 43003; optical flow (FLOW_TYPE={flow:g}) tracks the position between fixes"
    NOT_CARRIED = (
        "no sensor tracks the position of this {vehicle} between fixes, so without GPS its failsafe acts in seconds: ",
        "set up continuous positions",
        " instead of the receiver of type {receiver_type:g}",
        ", unless another system on board sends ODOMETRY ({parameter} is {value:g})",
        "; then reboot the autopilot",
    )
    CHANGES_AFTER_DRY_RUN = "a dry run needs no change; the first flight that sends fixes needs {changes}"
    DRY_RUN_NOT_ARMED = (
        "a dry run sends no positions via {channel}, so this {vehicle} would not arm: ",
        "make this change until the first flight that sends fixes, and reboot the autopilot",
    )
    PARAMETERS_RIGHT = "all parameters that affect positions from edgevpr are correct"
    STREAMS_RECEIVED = "receiving position, attitude and GPS"
    STREAMS_MISSING = "no {missing} received, even on request: the autopilot may send it only after a GPS fix"
    FILTER_READY = "the EKF has attitude and position (flags 0x{flags:x})"
    FILTER_NOT_READY = "the EKF has no {lacks} yet (flags 0x{flags:x}): wait outdoors with the aircraft stationary"
    FILTER_UNKNOWN = "the autopilot does not report the state of its EKF"
    GPS_FIX = "fix type {types}"
    NO_GPS_FIX = "no GPS receiver has a fix: wait for one before take-off, so that the start position is known"
    ORIGIN_KNOWN = "{lat_deg:.6f}, {lon_deg:.6f}"
    CLOCK_AGREES = "the autopilot's clock differs from the board's by {ahead_s:+.1f} s"
    CLOCK_DIFFERS = (
        "the autopilot's clock differs from the board's by {ahead_s:+.0f} s: ",
        "set the board's clock, otherwise log times and signatures will be wrong",
    )
    CLOCK_NOT_COMPARED = "not compared: the autopilot does not know the UTC time yet"

    def __init__(self, *parts: str) -> None:
        super().__init__("", *parts)
