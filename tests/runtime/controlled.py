"""edgevpr's link and the strict simulated flight controller, at the two ends of a UDP line, by one clock that is turned
by hand: nothing depends on how fast the machine is."""

import select
import socket
from dataclasses import replace

import numpy as np
from air import match_at
from fakes import FakeClock
from freeflight import Piloted
from mavlink_peers import link_to, wait_until

from edgevpr.core.config import SourceSetsConfig, load_config
from edgevpr.core.geodesy import moved
from edgevpr.core.types import Position
from edgevpr.mavlink.messages import Health
from edgevpr.mavlink.wire import PacketReader, mavlink
from edgevpr.power.meter import MachineLoad
from edgevpr.runtime.flight.autopilot import ToAutopilot
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.navigator import Navigator
from edgevpr.runtime.flight.notifier import Notifier

STEP_S = 0.025
FIX_SD_M = 1.0
NO_SETS = SourceSetsConfig(None, None)
LOAD = MachineLoad((0.5,), 1, 2)


class Controlled:
    """A vehicle of the simulated flight controller with edgevpr beside it: matches come once a second while it `sees`,
    and reports of this computer. `heard` is what the flight controller has heard, with the times."""

    def __init__(self, vehicle, *, source_sets=NO_SETS, send_fixes=True, **parameters):
        self.kind = vehicle.removeprefix("ardu")
        self.controller = Piloted(vehicle, **parameters)
        self.motion = self.controller.motion
        self.clock, self.rng = FakeClock(), np.random.default_rng(3)
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.bind(("127.0.0.1", 0))
        self.navigator = Navigator(1.0, 1.0, is_muted=not send_fixes)
        url = f"udpout:127.0.0.1:{self._sock.getsockname()[1]}"
        self.link = link_to(url, clock=self.clock, listener=self.navigator)
        settings = replace(load_config(None).mavlink, send_fixes=send_fixes, source_sets=source_sets)
        notifier = Notifier(FlightLog(None), self.link)
        self.autopilot = ToAutopilot(
            self.link, self.navigator, notifier, settings=settings, cores=4, clock=self.clock.clock
        )
        self._packer, self._receiver = mavlink.MAVLink(None, 1, 1), PacketReader()
        self._to, self._said, self._steps = None, 0, 0
        self.sees, self.heard, self.reports = True, [], []
        self.link.want_position()

    def __enter__(self):
        self.link.start()
        self.link.set_health(Health.ACTIVE)
        self._listen(patience_s=60.0)
        return self

    def __exit__(self, *_):
        self.link.close()
        self._sock.close()

    @property
    def now_s(self):
        return self._steps * STEP_S

    @property
    def brain(self):
        return self.controller.brain

    def heard_of(self, kind, since_s=0.0):
        return [each for t_s, each in self.heard if each.get_type() == kind and t_s >= since_s]

    def commands(self, number):
        kinds = "COMMAND_INT", "COMMAND_LONG"
        return [(t_s, each) for t_s, each in self.heard if each.get_type() in kinds and each.command == number]

    def fly(self, seconds):
        for _ in range(round(seconds / STEP_S)):
            self._steps += 1
            self.clock.now_s = 1000.0 + self.now_s
            self._say(self.controller.advance(self.now_s))
            self._listen()
            if self._steps % round(1 / STEP_S) == 0:
                self.autopilot.report(Health.ACTIVE, LOAD, None)
                if self.sees:
                    self._see()
        return self

    def until(self, condition, seconds=60):
        for _ in range(seconds):
            if condition():
                return
            self.fly(1)
        raise AssertionError(f"not in {seconds} s")

    def _see(self):
        truth, now_s = self.controller.brain.truth, self.clock.now_s
        here = Position(*moved(truth.lat_deg, truth.lon_deg, *self.rng.normal(0, FIX_SD_M, 2)))
        vehicle = self.link.vehicle_at(now_s)
        event = match_at(here, now_s, vehicle, FIX_SD_M, (self._steps,))
        self.reports.append(self.autopilot.report_match(event, 0.0).fix)

    def _say(self, messages):
        for message in messages:
            self._sock.sendto(message.pack(self._packer), self._to)
            self._packer.seq = (self._packer.seq + 1) % 256
            self._said += 1
        if messages:
            wait_until(lambda: sum(self.link.stats().received.values()) >= self._said, "its hearing", every_s=0.0003)

    def _listen(self, patience_s=0.0):
        while select.select([self._sock], [], [], patience_s)[0]:
            patience_s = 0.0
            data, self._to = self._sock.recvfrom(65_536)
            for message in self._receiver.feed(data):
                self.heard.append((self.now_s, message))
                self._say(self.controller.receive(message))
