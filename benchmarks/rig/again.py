"""The navigator again, over flights of the rig: where it takes the aircraft to be without GPS, beside the true place.

What it heard is read from the flight's tlog and log. So a change of it is seen in seconds; not what an autopilot would
have done with what is sent then, and no place is looked for.

python benchmarks/rig/again.py RUN ...    # folders of `runs`
"""

import json
import sys
from collections.abc import Iterator
from dataclasses import fields
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[1]))

import base
import numpy as np
from figures import read_table, spread
from pymavlink import mavutil

from edgevpr.core.types import Position, Receiver, Vehicle
from edgevpr.frames.level import View
from edgevpr.lab.simulate.generated import to_metres
from edgevpr.mavlink.channel import Channel
from edgevpr.mavlink.peer import Autopilot
from edgevpr.runtime.flight.flightlog import read_log
from edgevpr.runtime.flight.navigator import Navigator
from edgevpr.runtime.recognise.locate import Located
from edgevpr.runtime.recognise.perspective import Lean
from edgevpr.runtime.recognise.stride import Stride

_EVERY_S, _FIRST_S = 0.5, 20.0
_CHANNELS = {
    "COMMAND_INT": Channel.COMMAND,
    "GPS_INPUT": Channel.GPS_INPUT,
    "ODOMETRY": Channel.ODOMETRY,
    "GLOBAL_POSITION_SENSOR": Channel.SENSOR,
}  # by what was sent


def messages(path: Path) -> Iterator[tuple[float, Any]]:
    """Yield the messages of a tlog, each with its time, seconds since 1970."""
    log = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    while message := log.recv_msg():
        yield message._timestamp, message


def event_of(line: dict[str, Any]) -> Any:
    """Return the event of a query's line, with all that the navigator asks of one."""
    where, stride, told, view = (line.get(name) for name in ("located", "stride", "vehicle", "view"))
    located = vehicle = None
    if line["accepted"] and where:
        lean = where.get("lean")
        located = Located(
            position=Position(where["lat_deg"], where["lon_deg"]),
            covariance_m2=tuple(where["covariance_m2"]),
            heading_deg=where["heading_deg"],
            places=tuple(where["places"]),
            lean=lean and Lean(over_height=tuple(lean[:2]), sd=lean[2]),
        )
    if told:
        known = {each.name: told[each.name] for each in fields(Vehicle) if told.get(each.name) is not None}
        known |= {"gps": Receiver(**told["gps"])} if told["gps"] else {}
        vehicle = Vehicle(**known | {"velocity_m_s": told["velocity_m_s"] and tuple(told["velocity_m_s"])})
    return SimpleNamespace(
        frame=SimpleNamespace(t_mono_s=line["t_frame_s"]),
        vehicle=vehicle,
        view=View(**view) if view else View(),
        stride=stride and Stride(to_s=line["t_frame_s"], **stride | {"moved_m": tuple(stride["moved_m"])}),
        best=located and SimpleNamespace(place=SimpleNamespace(place_id=line["place"])),
        located=located,
        accuracy_m=line["accuracy_m"],
    )


def flown_again(folder: Path) -> np.ndarray:
    """Return, twice a second without GPS: seconds after the loss, errors east and north, and what would be claimed."""
    config, run = (json.loads((folder / name).read_text()) for name in ("config.yaml", "run.json"))
    lines, true = list(read_log(folder / "flight.jsonl")), read_table(folder / "pictures.csv")
    loss_s = run["marks_s"]["loss"]
    began_s = datetime.fromisoformat(lines[0]["time"]).timestamp() - lines[0]["t_mono_s"]
    heard = [(t_s - began_s, message) for t_s, message in messages(folder / "flight.tlog")]
    heard += [(line["t_mono_s"], line) for line in lines if line["kind"] in ("query", "gps", "survey")]
    navigator = Navigator(config["mavlink"]["min_accuracy_m"], 1 / config["source"]["rate_hz"])
    navigator.hear_channel(_CHANNELS[str(read_table(folder / "sent.csv")["kind"][-1])])
    autopilot, rows, due_s = Autopilot(197, None, navigator), [], loss_s
    for t_s, what in sorted(heard, key=lambda each: each[0]):
        while due_s < t_s:
            if here := navigator._known(due_s):
                at_m = to_metres(here.position.lat_deg, here.position.lon_deg)
                there_m = (np.interp(due_s, true["t_s"], true[name]) for name in ("east_m", "north_m"))
                rows.append((due_s - loss_s, *np.subtract(at_m, tuple(there_m)), navigator._claimed_m(here)))
            due_s += _EVERY_S
        if not isinstance(what, dict):
            autopilot.hear(what, t_s)
        elif what["kind"] == "gps":
            navigator.believe_gps(not what["is_wrong"])
        elif what["kind"] == "survey" and t_s < loss_s:
            navigator.begin_anew()
        elif what["kind"] == "query":
            event = event_of(what)
            if what["accepted"]:
                navigator.advise(event, t_s)
            else:
                navigator.hear_frame(event)
    return np.array(rows)


def main() -> None:
    for folder in map(Path, sys.argv[1:]):
        if not (folder / "flight.jsonl").exists():
            sys.exit(f"again: {folder} is no flight of the rig with edgevpr.")
        after_s, *off_m, claimed_m = flown_again(folder).T
        error_m, sigmas = np.hypot(*off_m), abs(np.array(off_m)) / claimed_m
        first_m = np.sqrt(np.mean(np.square(error_m[after_s < _FIRST_S])))
        within = " / ".join(f"{(sigmas <= limit).mean():.2f}" for limit in (1, 2))
        found = {**spread(error_m), f"first {_FIRST_S:.0f} s": round(float(first_m), 1)}
        print(f"{folder.name}: {json.dumps(found)}, claimed {np.median(claimed_m):.1f}, within {within}")


if __name__ == "__main__":
    base.run(main)
