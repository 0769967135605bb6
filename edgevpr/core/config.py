"""The configuration of all commands, and `build`, which makes checked frozen dataclasses from YAML mappings.

An unknown key, a wrong type or a value out of range raises ConfigError with a one-sentence message."""

import os
import re
import types
import typing
from collections.abc import Iterator
from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from edgevpr.core.errors import ConfigError
from edgevpr.core.text import suggest

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

FORMS = ("float", "8bit", "1bit")  # number formats of vectors in RAM, largest first: see techniques.vectors
MIN_RATE_HZ = 0.01  # rate of queries
MAX_RATE_HZ = 60.0
BUDGET_RANGE_MB = (1, 65_536)  # size of the index in RAM
SOURCE_HELP = (
    "a folder of images, a video file, a camera (/dev/video0, or rpicam for the ribbon camera of a Raspberry Pi), a "
    "stream (rtsp://, udp://, rtp://, tcp://, http://, FILE.sdp), or gst: followed by a GStreamer pipeline"
)

_MAX_INTEGER = 2**63
_MAX_VALUE_CHARS = 80  # number of characters of an invalid value that a message quotes
_NOT_IN_NAMES = re.compile("[\0\ud800-\udc7f\udd00-\udfff]")  # never in file names; other surrogates are raw bytes

T = TypeVar("T", bound="DataclassInstance")
_TYPE_NAMES = {float: "a number", int: "a whole number", str: "text", bool: "true or false", list: "a list"}
_TYPE_NAMES |= {dict: "a section"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Key:
    """A configuration key. `flags`: command-line options that set it (empty: none); `metavar`: placeholder for their
    value (None: argparse's default); `text`: their help. A value other than None must lie between the `limits` (None:
    any) and be one of the `choices` (empty: any). The option of a boolean key has no value: it sets the key to
    `sets`. `name`: dotted name, such as "source.rate_hz"; `kind`: type of its value unless it is None."""

    flags: tuple[str, ...] = ()
    metavar: str | None = None
    text: str = ""
    limits: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    sets: bool = True
    name: str = ""
    kind: type = str


def key(default: Any = MISSING, flag: str = "", text: str = "", **rules: Any) -> Any:
    """Make the dataclass field for a `Key`; `rules` are further fields of the `Key`. `default` MISSING: a value is
    required. `flag`: its flags and their placeholder, such as "--rate-hz HZ"."""
    words = flag.split()
    flags = tuple(word for word in words if word.startswith("-"))
    metavar = words[-1] if len(words) > len(flags) else None
    return field(default=default, metadata={"key": Key(flags=flags, metavar=metavar, text=text, **rules)})


def bounded_key(low: float, high: float, default: Any = MISSING) -> Any:
    """Make a `key` whose value must be None or within low..high."""
    return key(default, limits=(low, high))


_ANY = Key()


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceConfig:
    uri: str | None = key(None, "--images --source SOURCE", SOURCE_HELP)
    camera: str | None = key(
        None,
        "--camera",
        "nadir: camera faces straight down; forward: it faces ahead (default: as in the map; forward for a new map)",
        choices=("nadir", "forward"),
    )
    rate_hz: float | None = key(
        None, "--rate-hz HZ", "queries per second (default: the board's)", limits=(MIN_RATE_HZ, MAX_RATE_HZ)
    )
    mask: str | None = key(None, "--mask PNG", "mask image, black where frames show an overlay, not the ground")
    lens: str | None = key(None, "--lens FILE", "camera calibration (OpenCV, ROS or Kalibr YAML), to undistort images")
    fov_deg: float | None = key(
        None, "--fov-deg DEG", "field of view across the longest side of the image, in degrees", limits=(5, 150)
    )
    up_deg: float = key(
        0.0,
        "--up-deg DEG",
        "compass direction of the top of the image when the nose points north, in degrees (default: 0)",
        limits=(0, 360),
    )
    mount_ahead_deg: float = bounded_key(-45, 45, default=0.0)
    mount_right_deg: float = bounded_key(-45, 45, default=0.0)
    gimbal: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchConfig:
    matching: str | None = key(
        None, "--matching", "scoring method of cohog (default: displacement)", choices=("displacement", "thesis")
    )
    form: str | None = key(
        None,
        "--form",
        "storage of vectors in RAM: half precision, one byte or one bit per number (default: float)",
        choices=FORMS,
    )
    candidates: int | None = key(
        None, "--candidates N", "number of places compared in full (default: the technique's)", limits=(1, 1_000_000)
    )
    follow: bool = True
    sequence: int | None = key(
        None, "--sequence N", "number of queries matched as a sequence (default: the technique's)", limits=(1, 100)
    )
    accept_precision: float = key(
        0.999,
        "--accept-precision P",
        "required fraction of accepted matches that are correct (default: 0.999)",
        limits=(0.5, 0.999999),
    )
    min_score: float | None = key(None, "--min-score S", "minimum score of an accepted match", limits=(0, 1))
    min_margin: float | None = key(
        None,
        "--min-margin MARGIN",
        "minimum lead in score of an accepted match over the best place elsewhere",
        limits=(0, 1),
    )
    neighbour_m: float = bounded_key(0, 10_000, default=50.0)
    reach_m_s: float | None = key(
        None,
        "--reach-m-s V",
        "maximum speed in m/s: search only the area that the aircraft can have reached (default: the whole map)",
        limits=(0.1, 100),
    )


@dataclass(frozen=True, slots=True)
class MemoryConfig:
    budget_mb: float | None = key(
        None, "--budget-mb MB", "memory limit for the index in MB (default: the board's)", limits=BUDGET_RANGE_MB
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class SalienceConfig:
    use: bool = key(False, "--salience", "use only distinctive (salient) images")
    memorability: float = bounded_key(0, 1, default=0.3)
    staticity: float = bounded_key(0, 1, default=0.6)
    entropy: float = bounded_key(0, 1, default=0.4)
    network: str | None = "matchability"
    detector: str | None = None
    detect_every: int = bounded_key(1, 1000, default=1)
    gap_frames: int = bounded_key(1, 10_000, default=20)
    gap_m: float = bounded_key(1, 100_000, default=100.0)


@dataclass(frozen=True, slots=True)
class SourceSetsConfig:
    gps: int | None = bounded_key(1, 3, default=None)
    no_gps: int | None = bounded_key(1, 3, default=None)


@dataclass(frozen=True, slots=True, kw_only=True)
class MavlinkConfig:
    link: str | None = key(
        None,
        "--link URL",
        "MAVLink connection to the autopilot: udpout:HOST:PORT, udpin:HOST:PORT, tcp:HOST:PORT or serial:DEV:BAUD",
    )
    component_id: int = bounded_key(1, 255, default=197)
    system_id: int | None = bounded_key(1, 255, default=None)
    send_fixes: bool = key(True, "--dry-run", "do everything as in a flight, but send no positions", sets=False)
    max_fix_age_s: float = bounded_key(0.1, 5, default=1.0)
    min_accuracy_m: float = bounded_key(1, 10_000, default=5.0)
    source_sets: SourceSetsConfig = SourceSetsConfig()
    set_origin: bool = False
    signing_key: str | None = None
    signing_state: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LogConfig:
    path: str | None = key("edgevpr-flight.jsonl", "--log FILE", "flight log to write (JSON lines)")
    max_mb: float | None = bounded_key(1, 1_000_000, default=200.0)
    record: str | None = key(None, "--record FOLDER", "record the flight to this folder, for `edgevpr replay`")
    record_mb: float = bounded_key(10, 1_000_000, default=8000.0)


@dataclass(frozen=True, slots=True)
class StatusConfig:
    file: str | None = None


@dataclass(frozen=True, slots=True)
class BatteryConfig:
    pack: str = key("4S5200", "--battery PACK", "cells and capacity of the battery, for example 4S5200")
    regulator_efficiency: float = bounded_key(0.1, 1, default=0.85)


@dataclass(frozen=True, slots=True, kw_only=True)
class Config:
    """The whole configuration: types, defaults, limits and flags. `deploy/config.yaml` explains the keys."""

    board: str = key("this", "--board NAME", "hardware profile (default: this computer)")
    map: str | None = key(None, "--map MAP", "map file")
    technique: str | None = key(None, "--technique NAME", "fail unless the map uses this technique")
    source: SourceConfig = SourceConfig()
    match: MatchConfig = MatchConfig()
    memory: MemoryConfig = MemoryConfig()
    salience: SalienceConfig = SalienceConfig()
    mavlink: MavlinkConfig = MavlinkConfig()
    log: LogConfig = LogConfig()
    status: StatusConfig = StatusConfig()
    battery: BatteryConfig = BatteryConfig()


def list_keys(cls: type = Config, prefix: str = "") -> Iterator[Key]:
    """Yield the keys of the dataclass `cls` and of its sections, in the order of the fields. `prefix` begins each name:
    the dotted name of the section `cls`, such as "source." ("": the whole configuration)."""
    hints = typing.get_type_hints(cls)
    for spec in fields(cls):
        kind = _get_class(hints[spec.name])
        if is_dataclass(kind):
            yield from list_keys(kind, f"{prefix}{spec.name}.")
        else:
            yield replace(spec.metadata.get("key", _ANY), name=prefix + spec.name, kind=kind)


def load_config(path: str | Path | None, overrides: dict[str, Any] | None = None) -> Config:
    """Load the configuration file `path` (None: all defaults) and replace values with `overrides`, such as
    {"source.rate_hz": 2.0}; None values are ignored. Raises ConfigError that names the file, the key and the remedy."""
    from edgevpr.core.yamlfile import read_yaml  # loads PyYAML, which listing the flags does not need

    mapping = asdict(Config() if path is None else build(Config, read_yaml(path), str(path)))
    for dotted, value in (overrides or {}).items():
        if value is not None:
            *sections, name = dotted.split(".")
            target = mapping
            for section in sections:
                target = target[section]
            target[name] = value
    return build(Config, mapping, "the command line")


def resolve_log_paths(log: LogConfig, folder: str) -> LogConfig:
    """Return the settings with relative paths of logs and recordings resolved against `folder`."""
    path, record = (value and os.path.join(folder, value) for value in (log.path, log.record))
    return replace(log, path=path, record=record)


def build(cls: type[T], mapping: dict[str, Any], where: str, prefix: str = "") -> T:
    """Build the frozen dataclass `cls` from a mapping. `where` and `prefix` are for messages: the file, and the start
    of each key.

    Raises ConfigError for an unknown or missing key, and for a value of the wrong type or out of range."""
    hints = typing.get_type_hints(cls)
    specs = {spec.name: spec for spec in fields(cls)}
    for key in mapping:
        if key not in specs:
            name = str(key)[:_MAX_VALUE_CHARS]
            hint = suggest(name, specs, f"known: {', '.join(sorted(specs))}")
            raise ConfigError(f"{where}: unknown key `{prefix}{name}` ({hint}).")
    values = {}
    for name, spec in specs.items():
        if name in mapping:
            values[name] = _convert(mapping[name], hints[name], spec.metadata.get("key", _ANY), where, prefix + name)
        elif spec.default is MISSING and spec.default_factory is MISSING:
            raise ConfigError(f"{where}: key `{prefix}{name}` is missing: add it.")
    return cls(**values)


def _convert(value: Any, hint: Any, rules: Key, where: str, name: str) -> Any:
    kind, subject = _get_class(hint), f"{where}: `{name}`"
    limits: Any = rules.limits
    if value is None and isinstance(hint, types.UnionType):
        return None
    if is_dataclass(kind):
        if not isinstance(value, dict):
            raise ConfigError(f"{subject} must be a section: indent its keys below it.")
        return build(kind, value, where, f"{name}.")
    if value is None:
        raise ConfigError(f"{subject} has no value: add one.")
    if isinstance(value, int) and abs(value) > _MAX_INTEGER:
        raise ConfigError(f"{subject} has too many digits: use a smaller number.")
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if isinstance(value, str) and _NOT_IN_NAMES.search(value):
        raise ConfigError(f"{subject} contains a character that no file name can have ({value!a:.60}): remove it.")
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise ConfigError(f"{subject} must be {_TYPE_NAMES.get(kind, kind)}, not {value!r:.{_MAX_VALUE_CHARS}}.")
    if limits and not limits[0] <= value <= limits[1]:
        raise ConfigError(f"{subject} is {value:g}, but must be between {limits[0]:g} and {limits[1]:g}.")
    if rules.choices and value not in rules.choices:
        allowed = f"{', '.join(rules.choices[:-1])} or {rules.choices[-1]}"
        raise ConfigError(f"{subject} is `{value:.{_MAX_VALUE_CHARS}}`, but must be {allowed}.")
    return value


def _get_class(hint: Any) -> type:
    """Return the class of a type hint without None and type parameters: dict for `dict[str, Any] | None`."""
    options = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    kind: type = next(option for option in options if option is not type(None))
    return typing.get_origin(kind) or kind
