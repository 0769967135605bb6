"""Reading of the configuration in flight, when SIGHUP asks for it: keys that may change in the air are taken, and all
others are refused by name. The loop of `flight` uses it."""

import logging
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

from edgevpr.core.config import Config, build
from edgevpr.core.errors import ConfigError, EdgevprError
from edgevpr.core.types import NO_TAPE, Tape
from edgevpr.runtime.flight.flightlog import FlightLog

# Keys that may change in the air: neither opens anything anew, nor decides where data is sent.
TAKEN = ("match.accept_precision", "source.rate_hz")

_log = logging.getLogger(__name__)


class Reread:
    """Signal handler that notes that the configuration is to be read again, with `read`. What is read is recorded on
    the `tape`."""

    def __init__(self, read: Callable[[], Config], tape: Tape = NO_TAPE) -> None:
        self._read, self._tape, self._asked = read, tape, False

    def __call__(self, *_: object) -> None:
        self._asked = True

    def take(self) -> bool:
        """Return True once after each signal."""
        asked = self._tape.read("reread", lambda: self._asked)
        if asked:
            self._asked = False
        return asked

    def read(self) -> Config:
        """Read the configuration. Raises ConfigError."""
        found = self._tape.read("config", self._found)
        if problem := found.get("problem"):
            raise ConfigError(problem)
        return build(Config, found, "the configuration")

    def _found(self) -> dict[str, Any]:
        try:
            return asdict(self._read())
        except EdgevprError as error:
            return {"problem": str(error)}


def reload(reread: Reread, config: Config, flight_log: FlightLog) -> Config:
    """Read the configuration again, and log the result. Returns the configuration now in force: `config` with the new
    values of the keys in `TAKEN`. If it cannot be read, nothing changes."""
    try:
        new = reread.read()
    except EdgevprError as error:
        _log.warning("the configuration stays as it is: %s", error)
        flight_log.write("reload", problem=str(error))
        return config
    before, after = _keys(asdict(config)), _keys(asdict(new))
    changed = [name for name, value in after.items() if value != before[name]]
    taken = {name: after[name] for name in changed if name in TAKEN}
    refused = [name for name in changed if name not in TAKEN]
    config = replace(
        config,
        match=replace(config.match, accept_precision=new.match.accept_precision),
        source=replace(config.source, rate_hz=new.source.rate_hz),
    )
    if taken:
        flight_log.restate(config=asdict(config))
    values = [f"{name} is {'the default' if value is None else value}" for name, value in taken.items()]
    _log.info("the configuration is read again: %s", ", ".join(values) or "nothing changes")
    if refused:
        _log.warning("only a new start changes %s", ", ".join(refused))
    flight_log.write("reload", taken=taken, refused=refused)
    return config


def _keys(section: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested sections: return each value by its dotted name."""
    found: dict[str, Any] = {}
    for name, value in section.items():
        found |= _keys(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return found
