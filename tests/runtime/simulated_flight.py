"""A simulated flight for the navigator: a true path, an autopilot that reckons, and matches with noise and age. It has
no link: reports, forces and matches are given by hand, in the order of their time."""

import math
from collections import deque
from dataclasses import replace

import numpy as np
from fakes import make_receiver, make_vehicle

from edgevpr.core.contract import FineMatch
from edgevpr.core.geodesy import offset_m, offset_position
from edgevpr.core.types import FRAME_TIME_SD_S, Candidate, Frame, Place, Position, QueryCost, StepCosts, Vehicle
from edgevpr.frames.level import LevelledImage, View
from edgevpr.mavlink.conversation import INTERIM_FIX_INTERVAL_S
from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.receivers import RECEIVER_LAG_S
from edgevpr.mavlink.vehicle import Attitude
from edgevpr.runtime.flight.navigator import Advice, Navigator
from edgevpr.runtime.recognise.locate import Located
from edgevpr.runtime.recognise.odometry import OdometryStep
from edgevpr.runtime.recognise.recognition import Recognition

HOME = 47.0, 8.0
GPS_SD_M = 1.0
STEP_S = 0.02
_REPORT_STEPS = 10  # five reports and ten states a second
_STATE_STEPS = 5
_FARTHEST_STEPS = 250  # between two frames that share ground
_GRAVITY_M_S2 = 9.80665
_DRIFT_M_S = 5.0  # as edgevpr takes an autopilot's own position to go wrong
PICTURE = np.zeros((8, 8), np.uint8)
_NO_COST = QueryCost(
    t_encode_s=0, t_match_s=0, u_encode=0, u_match=0, cpu_s=0, rss_mb=0, used_mah=0, marginal_mah=0
)  # fmt: skip


def make_match(
    position: Position, t_s: float, vehicle: Vehicle | None, sd_m: float, places, view: View | None = None, lean=None
) -> Recognition:
    """An accepted match of a frame taken at `t_s`."""
    fix = {"position": position, "covariance_m2": (sd_m**2, 0.0, sd_m**2)}
    return Recognition(
        frame=Frame(image=PICTURE, name=f"{t_s:.1f} s", t_mono_s=t_s),
        vehicle=vehicle,
        picture=view and LevelledImage(PICTURE, None, view),
        best=Candidate(Place(place_id=places[0] if places else 1, source_image="", position=position), FineMatch(0.5)),
        accepted=True,
        located=Located(**fix, places=tuple(places), attitude_error=lean),
        accuracy_m=sd_m,
        steps=StepCosts(),
        cost=_NO_COST,
    )


class SimFlight:
    """A flight in wide circles at `speed_m_s`, with GPS until `lose_gps`. Its autopilot then reckons, wrong by `wind`
    (2,) m/s, which changes by `gusts` m/s a second, and by `velocity_sd` m/s of noise; what is sent it takes. Matches
    of `fix_sd_m` and `other_sd_m`, which say `said_sd_m` of themselves, come every `every_s` and are `late_s` old.
    With a `stride_sd_m`, each frame has its stride, too long by `stretch` and turned by `turn` (radians, to the right),
    as by a compass that is wrong (or a rotated camera, unless it `turns_compass`), and its match shows that where it
    `shows_turn`; without `matches`, no place is accepted. Without GPS, a frame is taken every `stride_s` for its stride
    only (None: none is). The times of its frames have the standard deviation `t_sd_s`. `gps_off_m` (2,) is by how much
    the receiver is wrong; the autopilot follows it until it `reject_gps`."""

    def __init__(
        self,
        navigator: Navigator,
        *,
        speed_m_s=15.0,
        wind=(0.0, 0.0),
        gusts=0.0,
        velocity_sd=0.1,
        fix_sd_m=3.0,
        said_sd_m=None,
        other_sd_m=1.0,  # half a degree of attitude at 100 m, and some hundredths of a second: no match knows of them
        every_s=1.0,
        late_s=0.4,
        map_off=(0.0, 0.0),
        bias=(0.0, 0.0),
        attitude=(0.0, 0.0),
        stride_sd_m=None,
        stride_s=None,
        t_sd_s=FRAME_TIME_SD_S,
        seed=7,
    ):
        self.navigator, self.rng = navigator, np.random.default_rng(seed)
        self.speed_m_s, self.velocity_sd, self.fix_sd_m, self.attitude = speed_m_s, velocity_sd, fix_sd_m, attitude
        self.gusts, self.noise_sd_m = gusts, math.hypot(fix_sd_m, other_sd_m)
        self.said_sd_m, self.t_sd_s = said_sd_m or fix_sd_m, t_sd_s
        self.wind, self.map_off, self.bias = map(np.array, (wind, map_off, bias))
        self.every_steps, self.late_steps = round(every_s / STEP_S), round(late_s / STEP_S)
        self.stride_steps = stride_s and round(stride_s / STEP_S)
        self.step, self.at_m, self.gps_off_m, self.has_gps = 0, np.zeros(2), np.zeros(2), True
        self.has_receiver = True
        self.off_m = np.zeros(2)  # by how much the autopilot is wrong
        self.known = GPS_SD_M, 0.0  # how well it knew its position, and when
        self.way, self.waiting, self.vehicle = [self.at_m], deque(), None
        self.is_silent = self.knows_nothing = False
        self.takes_fixes, self.matches, self.events = True, True, []
        self.stride_sd_m, self.stretch, self.turn, self.strode = stride_sd_m, 1.0, 0.0, None
        self.shows_turn, self.turns_compass = False, True
        self.advices: list[tuple[float, Advice]] = []
        self.errors_m, self.states = [], []  # of the autopilot once a second; of a continuous channel
        self.between, self.between_due_s = [], 0.0  # fixes that no match asked for, and their errors

    @property
    def t_s(self) -> float:
        return self.step * STEP_S

    @property
    def sent(self):
        return [(t_s, advice.fix) for t_s, advice in self.advices if advice.fix]

    def lose_gps(self) -> None:
        self.has_receiver = False
        self.reject_gps()

    def reject_gps(self) -> None:
        self.has_gps, self.known = False, (GPS_SD_M, self.t_s)

    def velocity(self, t_s: float) -> np.ndarray:
        return self.speed_m_s * np.array([math.sin(t_s / 20), math.cos(t_s / 20)])

    def measure_error(self, lat_deg: float, lon_deg: float, t_s: float | None = None) -> np.ndarray:
        """Metres (2,) of a position from where the aircraft was."""
        true_m = self.at_m if t_s is None else self.way[round(t_s / STEP_S)]
        return np.array(offset_m(*HOME, lat_deg, lon_deg)) - true_m

    def fly(self, seconds: float) -> "SimFlight":
        for _ in range(round(seconds / STEP_S)):
            self.step += 1
            before, velocity = self.velocity(self.t_s - STEP_S), self.velocity(self.t_s)
            if not self.has_gps:
                self.wind = self.wind + self.rng.normal(0, self.gusts * math.sqrt(STEP_S), 2)
            self.at_m = self.at_m + STEP_S * (before + velocity) / 2
            self.way.append(self.at_m)
            self.off_m = self.gps_off_m if self.has_gps else self.off_m - STEP_S * self.wind
            if not self.is_silent:
                self._report_force((velocity - before) / STEP_S)
                if self.step % _REPORT_STEPS == 0:
                    self._report(velocity)
            if self.step % _STATE_STEPS == 0:
                self.states.append((self.t_s, self.navigator.estimate_state(self.t_s)))
            if self.step % self.every_steps == 0:
                self.waiting.append((self.step, self.vehicle))
            if self.stride_steps and not self.has_gps and self.step % self.stride_steps == 0 and not self.waiting:
                self._take_frame(self.step, self.vehicle, is_query=False)
            if self.waiting and self.waiting[0][0] <= self.step - self.late_steps:
                take = self.match if self.matches else self._take_frame
                take(*self.waiting.popleft())
            if self.step % _STATE_STEPS == 0 and self.t_s >= self.between_due_s:
                self._take_interim_fix(self.navigator.make_interim_fix(self.t_s))
            if self.step % 50 == 0:
                self.errors_m.append(self.off_m)
        return self

    def _take_frame(self, step, vehicle, is_query=True) -> None:
        frame = Frame(image=PICTURE, name="", t_mono_s=step * STEP_S)
        event = Recognition(frame=frame, vehicle=vehicle, odometry=self._measure_odometry(step))
        self.navigator.handle_frame(event, is_query)

    def _measure_odometry(self, step) -> OdometryStep | None:
        before, self.strode = self.strode, step
        if self.stride_sd_m is None or before is None or step - before > _FARTHEST_STEPS:
            return None
        east_m, north_m = (self.way[step] - self.way[before]) * self.stretch
        turned = complex(east_m, north_m) * np.exp(-1j * self.turn)
        moved_m = np.array([turned.real, turned.imag]) + self.rng.normal(0, self.stride_sd_m, 2)
        from_s, to_s = before * STEP_S, step * STEP_S
        return OdometryStep(from_s=from_s, to_s=to_s, moved_m=tuple(moved_m), sd_m=self.stride_sd_m, inliers=100)

    def advise(self, event: Recognition) -> Advice:
        return self.navigator.advise(event, self.t_s)

    def match(self, step, vehicle) -> Advice:
        seen_m = self.way[step] + self.map_off + self.rng.normal(0, self.noise_sd_m, 2)
        where = Position(*offset_position(*HOME, *seen_m))
        event = make_match(where, step * STEP_S, vehicle, self.said_sd_m, self.places(step))
        event = replace(event, frame=replace(event.frame, t_sd_s=self.t_sd_s), odometry=self._measure_odometry(step))
        if self.shows_turn:
            picture = LevelledImage(PICTURE, None, replace(event.view, up_deg=0.0))
            located = replace(event.located, heading_deg=-math.degrees(self.turn))
            event = replace(event, picture=picture, located=located)
        self.events.append(event)
        advice = self.advise(event)
        self.advices.append((self.t_s, advice))
        if advice.fix:
            self.apply_fix(advice.fix)
        return advice

    def apply_fix(self, fix: Fix) -> None:
        """Take a fix, as the autopilot does that gets it."""
        self.between_due_s = self.t_s + INTERIM_FIX_INTERVAL_S
        if self.takes_fixes:
            self.off_m = self.measure_error(fix.lat_deg, fix.lon_deg, fix.t_frame_s)
            self.known = fix.accuracy_m, self.t_s

    def _take_interim_fix(self, fix: Fix | None) -> None:
        if fix:
            self.between.append((fix, self.measure_error(fix.lat_deg, fix.lon_deg)))
            self.apply_fix(fix)

    def places(self, step: int) -> tuple[int, ...]:
        """The places that a match of that step is of."""
        return (round(step * STEP_S),)

    def _report_force(self, acceleration_m_s2: np.ndarray) -> None:
        east, north = acceleration_m_s2 + self.bias + self.rng.normal(0, 0.2, 2)
        attitude = Attitude(self.t_s, 0.0, 0.0, math.degrees(self.turn * self.turns_compass))
        self.navigator.handle_specific_force(self.t_s, (north, east, -_GRAVITY_M_S2), attitude)

    def _report(self, velocity: np.ndarray) -> None:
        here = offset_position(*HOME, *(self.at_m + self.off_m))
        measured_m = self.way[max(0, self.step - round(RECEIVER_LAG_S / STEP_S))]
        there = offset_position(*HOME, *(measured_m + self.gps_off_m))
        wrong = 0.0 if self.has_gps else self.rng.normal(0, self.velocity_sd, 2) - self.wind
        if self.has_gps:
            self.known = GPS_SD_M, self.t_s
        sd_m = math.hypot(self.known[0], _DRIFT_M_S * (self.t_s - self.known[1]))
        roll_deg, pitch_deg = self.attitude
        self.vehicle = make_vehicle(
            *here,
            self.t_s,
            has_gps=self.has_gps,
            gps=make_receiver(there, GPS_SD_M, self.t_s) if self.has_receiver else None,
            velocity_m_s=tuple(velocity + wrong),
            position_sd_m=None if self.knows_nothing else sd_m,
            height_m=100.0,
            roll_deg=roll_deg,
            pitch_deg=pitch_deg,
        )
        self.navigator.handle_vehicle(self.vehicle)


def norms(errors_m) -> np.ndarray:
    return np.hypot(*np.array(errors_m).T)
