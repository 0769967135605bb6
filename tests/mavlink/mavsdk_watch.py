"""MAVSDK as a ground station, run as a program: a JSON line of all that it says of system 1, until its input ends.

`python mavsdk_watch.py PORT`; apart from the tests' process, because MAVSDK is a native library with threads of its
own, which writes its own lines to the output too: they are led away.
"""

import json
import os
import sys

from mavsdk.component_type import ComponentType
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkDirect
from mavsdk.plugins.telemetry.telemetry import Telemetry

PATIENCE_S = 60.0

out = os.fdopen(os.dup(1), "w")
os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def say(**fields) -> None:
    print(json.dumps(fields), file=out, flush=True)


def main(port: str) -> None:
    station = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    station.add_any_connection(f"udpin://127.0.0.1:{port}")
    system = station.first_autopilot(PATIENCE_S)
    telemetry, direct = Telemetry(system), MavlinkDirect(system)
    telemetry.subscribe_status_text(lambda status, _: say(text=status.text))
    direct.subscribe_message("", lambda it, _: say(component=it.component_id, **json.loads(it.fields_json)))
    say(autopilot=system.get_system_id())
    for _ in sys.stdin:  # a line asks
        say(components=system.component_ids())
    station.destroy()


if __name__ == "__main__":
    main(sys.argv[1])
