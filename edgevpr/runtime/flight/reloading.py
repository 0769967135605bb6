"""The configuration is read again in flight, when SIGHUP asks for it: what may change in the air is taken, the rest is
refused by name."""

import logging
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from typing import Any

from edgevpr.core.config import Config, build
from edgevpr.core.errors import ConfigError, EdgevprError
from edgevpr.core.types import NO_TAPE, Tape
from edgevpr.runtime.flight.flightlog import FlightLog

# Neither opens anything anew, nor decides who is told what.
TAKEN = ("match.accept_precision", "source.rate_hz")

_log = logging.getLogger(__name__)


class Reread:
    """Signal handler that asks for the configuration to be read again, by `read`. What is read is on the `tape`."""

    def __init__(self, read: Callable[[], Config], tape: Tape = NO_TAPE) -> None:
        self._read, self._tape, self._asked = read, tape, False

    def __call__(self, *_: object) -> None:
        self._asked = True

    def take(self) -> bool:
        """Tell once that the configuration is to be read again."""
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


class NoReloading:
    """Stands in for a `Reloading` where the configuration has no file."""

    def look(self) -> None:
        """Read nothing."""


class Reloading:
    """Reads the configuration again when `reread` is asked to. Of what differs from the one in force, `TAKEN` is handed
    to `take`; a configuration that cannot be read changes nothing."""

    def __init__(self, reread: Reread, config: Config, flight_log: FlightLog, take: Callable[[Config], None]) -> None:
        self._reread, self._config, self._flight_log, self._take = reread, config, flight_log, take

    def look(self) -> None:
        """Read the configuration, if that is asked for, and say what comes of it."""
        if not self._reread.take():
            return
        try:
            new = self._reread.read()
        except EdgevprError as error:
            _log.warning("the configuration stays as it is: %s", error)
            self._flight_log.write("reload", problem=str(error))
            return
        before, after = dict(_keys(asdict(self._config))), dict(_keys(asdict(new)))
        changed = [name for name, value in after.items() if value != before[name]]
        taken = {name: after[name] for name in changed if name in TAKEN}
        refused = [name for name in changed if name not in TAKEN]
        self._config = replace(
            self._config,
            match=replace(self._config.match, accept_precision=new.match.accept_precision),
            source=replace(self._config.source, rate_hz=new.source.rate_hz),
        )
        if taken:
            self._take(self._config)
            self._flight_log.restate(config=asdict(self._config))
        said = [f"{name} is {'the default' if value is None else value}" for name, value in taken.items()]
        _log.info("the configuration is read again: %s", ", ".join(said) or "nothing changes")
        if refused:
            _log.warning("only a new start changes %s", ", ".join(refused))
        self._flight_log.write("reload", taken=taken, refused=refused)


def _keys(section: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the value of every key."""
    for name, value in section.items():
        if isinstance(value, dict):
            yield from _keys(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value
