"""Strict YAML to frozen dataclasses: an unknown key, a wrong type or a value out of range is one clear sentence."""

import difflib
import types
import typing
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml

from edgevpr.errors import ConfigError
from edgevpr.resources import shipped

T = TypeVar("T")
_WORDS = {
    float: "a number",
    int: "a whole number",
    str: "a text",
    bool: "true or false",
    list: "a list",
    dict: "a section",
}


def bounded(low: float, high: float) -> Any:
    """A dataclass field whose value, where it is not None, must lie in low..high."""
    return field(metadata={"range": (low, high)})


@dataclass(frozen=True, slots=True)
class SourceConfig:
    uri: str | None
    camera: str | None
    rate_hz: float | None = bounded(0.01, 60)


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchConfig:
    matching: str | None
    form: str | None
    candidates: int | None = bounded(1, 1_000_000)
    sequence: int | None = bounded(1, 100)
    min_score: float | None = bounded(0, 1)
    min_margin: float | None = bounded(0, 1)
    neighbour_m: float = bounded(0, 10_000)
    reach_m_s: float | None = bounded(0.1, 100)


@dataclass(frozen=True, slots=True)
class MemoryConfig:
    budget_mb: float | None = bounded(1, 65_536)


@dataclass(frozen=True, slots=True)
class MappingConfig:
    learn: bool
    spacing_m: float = bounded(1, 1000)


@dataclass(frozen=True, slots=True)
class MavlinkConfig:
    link: str | None
    component_id: int = bounded(1, 255)
    send_fixes: bool = field()
    min_accuracy_m: float = bounded(1, 10_000)


@dataclass(frozen=True, slots=True)
class LogConfig:
    path: str | None


@dataclass(frozen=True, slots=True)
class BatteryConfig:
    pack: str
    regulator_efficiency: float = bounded(0.1, 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Config:
    """The whole configuration; `deploy/config.yaml` documents every key and holds every default."""

    board: str
    map: str | None
    technique: str | None
    source: SourceConfig
    match: MatchConfig
    memory: MemoryConfig
    mapping: MappingConfig
    mavlink: MavlinkConfig
    log: LogConfig
    battery: BatteryConfig


def load_config(path: str | Path | None, overrides: dict[str, Any] | None = None) -> Config:
    """Defaults, then the user's file, then `overrides` ({"source.rate_hz": 2.0}; None values are left out).

    Raises ConfigError with the file, the key and what to do.
    """
    defaults_path = shipped("deploy") / "config.yaml"
    merged = read_yaml(defaults_path)
    if path is not None:
        merged = _overlaid(merged, read_yaml(path), str(path), "")
    for dotted, value in (overrides or {}).items():
        if value is not None:
            *sections, key = dotted.split(".")
            target = merged
            for section in sections:
                target = target[section]
            target[key] = value
    return build(Config, merged, str(path or "the command line"))


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Read a YAML mapping; raises ConfigError for a file that is missing, unreadable or not a mapping."""
    try:
        with open(path, encoding="utf-8") as handle:
            content = yaml.safe_load(handle)
    except OSError as error:
        raise ConfigError(f"{path} cannot be read ({error.strerror}): give the path of a YAML file.") from error
    except (yaml.YAMLError, ValueError) as error:  # a date that is none is a ValueError
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or str(error)
        raise ConfigError(f"{path}{where} is not valid YAML ({problem}): correct it there.") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"{path} must hold `key: value` lines, not {type(content).__name__}.")
    return content


def build(cls: type[T], mapping: dict[str, Any], where: str, prefix: str = "") -> T:
    """Build the frozen dataclass `cls` from a mapping, strictly; `where` names the file in messages."""
    hints = typing.get_type_hints(cls)
    known = {f.name: f for f in fields(cls)}  # type: ignore[arg-type]
    for key in mapping:
        if key not in known:
            raise ConfigError(f"{where}: unknown key `{prefix}{key}`{_suggestion(str(key), known)}.")
    values = {}
    for name, spec in known.items():
        if name in mapping:
            values[name] = _converted(mapping[name], hints[name], spec.metadata.get("range"), where, prefix + name)
        elif spec.default is MISSING and spec.default_factory is MISSING:
            raise ConfigError(f"{where}: the key `{prefix}{name}` is missing: add it.")
    return cls(**values)


def _overlaid(base: dict[str, Any], over: dict[str, Any], where: str, prefix: str) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        if key not in base:
            raise ConfigError(f"{where}: unknown key `{prefix}{key}`{_suggestion(str(key), base)}.")
        if isinstance(base[key], dict):
            if not isinstance(value, dict):
                raise ConfigError(f"{where}: `{prefix}{key}` is a section: write its keys below it, indented.")
            value = _overlaid(base[key], value, where, f"{prefix}{key}.")
        merged[key] = value
    return merged


def _suggestion(key: str, known: typing.Iterable[str]) -> str:
    near = difflib.get_close_matches(key, list(known), n=1)
    return f" (did you mean `{near[0]}`?)" if near else f" (known: {', '.join(sorted(known))})"


def _converted(value: Any, hint: Any, limits: tuple[float, float] | None, where: str, key: str) -> Any:
    options = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    if value is None:
        if type(None) in options:
            return None
        raise ConfigError(f"{where}: `{key}` has no value: write one.")
    wanted = next(option for option in options if option is not type(None))
    if is_dataclass(wanted):
        if not isinstance(value, dict):
            raise ConfigError(f"{where}: `{key}` is a section: write its keys below it, indented.")
        return build(wanted, value, where, f"{key}.")  # type: ignore[arg-type]
    if wanted is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, wanted) or (isinstance(value, bool) and wanted is not bool):
        word = _WORDS.get(wanted, str(wanted))
        raise ConfigError(f"{where}: `{key}` must be {word}, not {value!r}.")
    if limits and not limits[0] <= value <= limits[1]:
        raise ConfigError(f"{where}: `{key}` is {value:g}; it must be between {limits[0]:g} and {limits[1]:g}.")
    return value
