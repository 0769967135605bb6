"""A flight of the service on its machine, in its world, and what is found out about it."""

import json
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from machine import HOST, Answer, Machine
from world import World, wait_until

LOG, MAP = "/var/log/edgevpr/flight.jsonl", "/var/lib/edgevpr/valley.gpkg"
PATIENCE_S = 400.0
_BOARD = "rpi-zero-2w"  # its limits of memory and CPU are those of the unit


@dataclass(kw_only=True)
class Outcome:
    """What came of one fault. `told` are the texts that the ground station heard, `again_s` the seconds from the end of
    the fault to the next accepted match (None: it never went away, or never came back); `failed` names what should be
    so and was not."""

    fault: str
    does: str = ""
    kept: str = ""
    lost: str = "nothing"
    told: list[str] = field(default_factory=list)
    again_s: float | None = None
    failed: list[str] = field(default_factory=list)

    def expect(self, is_so: object, what: str) -> None:
        """Note what should be so, where it is not."""
        if not is_so:
            self.failed.append(what)


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault to try: its title, whether the usual flight is to go on before it, the restarts of the service that it
    brings about (None: any), and what is done."""

    title: str
    flies: bool
    restarts: int | None
    act: Callable[["Trial", Outcome], None]


FAULTS: dict[str, Fault] = {}


def fault(title: str, *, flies: bool = True, restarts: int | None = 0) -> Callable[[Callable], Callable]:
    """Register a function as a fault by its name."""

    def registered(act: Callable[["Trial", Outcome], None]) -> Callable:
        FAULTS[act.__name__] = Fault(title, flies, restarts, act)
        return act

    return registered


class Trial:
    """One machine, with its world. All times are of this machine's monotonic clock unless `inside` is in the name;
    `begin_s` and `begin_inside_s` are those at which the fault that is tried begins."""

    def __init__(self, machine: Machine, world: World) -> None:
        self.machine, self.world = machine, world
        self.begin_s = self.begin_inside_s = 0.0

    def tries(self, name: str) -> Outcome:
        """Try a fault, and find out what comes of it."""
        of = FAULTS[name]
        outcome = Outcome(fault=of.title)
        if of.flies:
            self.flies()
        restarts = self.restarts()
        self.begin_s, self.begin_inside_s = time.monotonic(), self.inside_s()
        of.act(self, outcome)
        outcome.told = outcome.told or self.world.ground.told_since(self.begin_s)
        if of.restarts is not None:
            outcome.expect(self.restarts() == restarts + of.restarts, f"the service was restarted {of.restarts} times")
        return outcome

    def matches_since(self, since_s: float) -> list[float]:
        """Return when accepted matches were told, after a time."""
        return [each for each in self.world.ground.matches_s if each > since_s]

    def restart(self) -> None:
        self.run("systemctl restart edgevpr", limit_s=PATIENCE_S)

    def run(self, script: str, **more: Any) -> str:
        """Run a shell script in the machine and return what it said."""
        return self.machine.run(script, **more).text

    def tried(self, script: str, **more: Any) -> Answer:
        """Run a shell script in the machine that may fail."""
        return self.machine.run(script, check=False, **more)

    def configure(self, **sections: Any) -> None:
        """Write the configuration of the service: the usual one, with these sections in place of its own."""
        usual = {
            "board": _BOARD,
            "map": MAP,
            "source": {"uri": f"http://{HOST}:{self.world.camera_port}/", "rate_hz": 1.0},
            "mavlink": {name: f"udpout:{HOST}:{port}" for name, port in self.world.ports.items()},
            "log": {"path": LOG},
        }
        self.machine.put("/etc/edgevpr/config.yaml", json.dumps(usual | sections).encode())

    def flies(self) -> None:
        """Have the usual flight go on, from whatever there was before; wait for its matches."""
        if self.world.camera is None or self.world.camera.poll() is not None:
            self.world.start_camera()
        if self.world.autopilot is None or self.world.autopilot.poll() is not None:
            self.world.start_autopilot()
        if self.unit("ActiveState") != "active":
            self.run("systemctl reset-failed edgevpr; systemctl restart edgevpr", limit_s=PATIENCE_S)
        self.next_match(time.monotonic() + 1)

    def begins_anew(self) -> None:
        """Put world and configuration back, after a trial that was broken off."""
        for process in filter(None, (self.world.camera, self.world.autopilot)):
            self.world.kill(process)
        try:
            self.tried("systemctl stop edgevpr", limit_s=PATIENCE_S)
        except (RuntimeError, OSError, AttributeError):  # off, or it does not answer
            if self.machine.is_on():
                self.machine.cut_power()
            self.machine.boot()
            self.tried("systemctl stop edgevpr", limit_s=PATIENCE_S)
        self.configure()

    def next_match(self, since_s: float, limit_s: float = PATIENCE_S) -> float:
        """Wait for an accepted match that the ground hears of after `since_s`; return how long after."""
        matches = self.world.ground.matches_s
        wait_until(lambda: matches and matches[-1] > since_s, limit_s, "an accepted match")
        return next(each for each in matches if each > since_s) - since_s

    def next_text(self, part: str, since_s: float, limit_s: float = PATIENCE_S) -> float:
        """Wait for a text with this part after `since_s`; return how long after."""
        texts = self.world.ground.texts

        def heard() -> list[float]:
            return [t_s for t_s, text in texts if t_s > since_s and part in text]

        wait_until(heard, limit_s, f"the text {part!r}")
        return heard()[0] - since_s

    def unit(self, name: str) -> str:
        """Return a property of the unit."""
        return self.run(f"systemctl show edgevpr --value -p {name}").strip()

    def restarts(self) -> int:
        return int(self.unit("NRestarts"))

    def inside_s(self) -> float:
        """Return the monotonic clock of the machine, by which the lines of the log are stamped."""
        return float(self.run("cut -d' ' -f1 /proc/uptime"))

    def log(self) -> list[dict[str, Any]]:
        """Read the logs of all flights, the newest last: their whole lines."""
        numbered = LOG.replace(".jsonl", "-*.jsonl")
        lines = []
        for line in self.machine.output(f"cat {numbered} {LOG} 2>/dev/null").splitlines():
            with suppress(ValueError):
                lines.append(json.loads(line))
        return lines

    def journal(self, since_inside_s: float) -> str:
        """Return what the journal has of the service, of this boot, since then."""
        lines = self.run("journalctl -b -u edgevpr -o short-monotonic --no-pager --no-hostname").splitlines()
        return "\n".join(line for line in lines if line[:1] == "[" and float(line[1:].split("]")[0]) >= since_inside_s)

    def first_inside(self, is_it: Callable[[dict], bool], since_inside_s: float, limit_s: float = PATIENCE_S) -> float:
        """Wait for a line of the log that is it, after a time inside; return the seconds from then to its own time."""
        found: list[float] = []

        def there() -> bool:
            found[:] = [line["t_mono_s"] for line in self.log() if line["t_mono_s"] >= since_inside_s and is_it(line)]
            return bool(found)

        wait_until(there, limit_s, "a line of the log", look_s=1.0)
        return found[0] - since_inside_s


def of_kind(lines: Sequence[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    return [line for line in lines if line["kind"] == kind]
