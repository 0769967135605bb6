"""MAVSDK beside edgevpr on one flight controller: python mavsdk_beside.py [PORT]

A router that owns the flight controller's port sends a copy of everything to this UDP port (docs/how-to/
run-with-other-software.md). Both are heard there: the autopilot, and edgevpr, which is component 197 of the same
vehicle. Says once a second where the autopilot believes to be, and whether edgevpr knows the place. Ends when edgevpr
has been silent for five seconds. MAVSDK is `pip install "mavsdk>=4"`.
"""

import json
import math
import sys
import time

from mavsdk.component_type import ComponentType
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkDirect
from mavsdk.plugins.telemetry.telemetry import Telemetry

EDGEVPR = 197  # mavlink.component_id
ACTIVE = 4  # MAV_STATE: it has a camera and a map, and is not paused
SURE, GOOD_FOR_S = 0.999, 3.0  # for you to choose: how probable, and how old, a match may be
FIRST_WITHIN_S, SILENT_AFTER_S = 60.0, 5.0


class Edgevpr:
    """What edgevpr has said last, and when."""

    def __init__(self) -> None:
        self.beat_s = time.monotonic() + FIRST_WITHIN_S
        self.match_s, self.confidence, self.is_active = float("-inf"), 0.0, False

    def handle(self, message, _) -> None:
        if message.component_id != EDGEVPR:
            return
        said, now_s = json.loads(message.fields_json), time.monotonic()
        if message.message_name == "HEARTBEAT":
            self.beat_s, self.is_active = now_s, said["system_status"] == ACTIVE
        elif said["name"] == "vpr_conf":  # comes with each accepted match
            self.match_s, self.confidence = now_s, said["value"]

    def knows_the_place(self) -> bool:
        return self.is_active and self.confidence >= SURE and time.monotonic() - self.match_s < GOOD_FOR_S


def main(port: str = "14540") -> None:
    station = Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER))
    station.add_any_connection(f"udpin://127.0.0.1:{port}")
    vehicle = station.first_autopilot(FIRST_WITHIN_S)
    if vehicle is None:
        sys.exit(f"No autopilot is heard at port {port}: does the router send to it?")
    telemetry, direct, edgevpr = Telemetry(vehicle), MavlinkDirect(vehicle), Edgevpr()
    telemetry.subscribe_status_text(lambda status, _: print("text", status.text, flush=True))
    for name in ("HEARTBEAT", "NAMED_VALUE_FLOAT"):
        direct.subscribe_message(name, edgevpr.handle)
    while time.monotonic() - edgevpr.beat_s < SILENT_AFTER_S:
        at = telemetry.position()
        here = f"at {at.latitude_deg:.6f}, {at.longitude_deg:.6f}" if not math.isnan(at.latitude_deg) else "nowhere"
        known = f"known, {edgevpr.confidence:.6f} sure" if edgevpr.knows_the_place() else "not known"
        print(f"autopilot: {here}; the place is {known}", flush=True)
        time.sleep(1.0)
    station.destroy()


if __name__ == "__main__":
    main(*sys.argv[1:])
