"""Metering of what a flight takes of its board while it flies: charge, cores, memory, heat."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

from edgevpr.power.boards import Board
from edgevpr.power.energy import RunningEnergy
from edgevpr.power.equations import Pack, marginal_energy_j, pack_ah
from edgevpr.power.load import OwnLoad
from edgevpr.power.machine import rss_mb
from edgevpr.power.meter import Stage, stage
from edgevpr.power.thermal import ThermalWatch
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.flight.governor import Reading
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.types import StageCost


class FlightMeter:
    """Counts from when it is made. `thermal` is what was last seen of the board's heat, and `queries_throttled` how
    many queries were made while the board slowed itself down. `close` it when done."""

    def __init__(
        self,
        board: Board,
        pack: Pack,
        regulator_efficiency: float,
        *,
        clock: Clock,
        watch: ThermalWatch | None = None,
    ) -> None:
        self._board, self._pack, self._regulator_efficiency = board, pack, regulator_efficiency
        self._clock = clock
        self._energy = RunningEnergy(board, clock.mono_s, clock.process_cpu_s)
        self._load = OwnLoad(board.cores, clock.mono_s, clock.process_cpu_s)
        self._watch = watch or ThermalWatch(clock=clock.mono_s)
        self.thermal = self._watch.look()
        self.queries_throttled = 0

    @property
    def age_s(self) -> float:
        """Give the seconds since the last `reading`."""
        return self._load.age_s

    @property
    def used_mah(self) -> float:
        """Give what the board has drawn so far."""
        return self.totals()["used_mah"]

    @contextmanager
    def reading_frame(self, is_live: bool) -> Iterator[Stage]:
        """Meter the reading of a frame. Of a live source it is mostly waiting for the next one: that is no work."""
        with stage(self._clock.mono_s, self._clock.process_cpu_s) as reading:
            yield reading
        if not is_live:
            self._load.busy(reading.cost)

    @contextmanager
    def working(self) -> Iterator[None]:
        """Meter what the loop does with a frame, by its own thread's CPU time."""
        with stage(self._clock.mono_s, self._clock.thread_cpu_s) as work:
            yield
        self._load.busy(work.cost)

    @contextmanager
    def telling(self) -> Iterator[None]:
        """Meter telling others what was found."""
        with stage(self._clock.mono_s, self._clock.process_cpu_s) as told:
            yield
        self._energy.add(told.cost)

    def count(self, event: Recognition) -> None:
        """Count what a frame took: reading it, and its walk."""
        self._energy.add(event.steps.read, event.cost.whole)
        self.queries_throttled += event.is_query and bool(self.thermal.throttled)

    def totals(self) -> dict[str, float]:
        """Sum up until now: `queries_throttled`; `used_mah`, what the board has drawn from the pack, idle all the time
        and busy with this process (of other programs nothing is known); `process_mah`, the part that the process added;
        `marginal_mah`, the part of it that the stages of its queries added. And the CPU-seconds of both."""
        so_far, board = self._energy.so_far(), self._board
        process = StageCost(so_far.elapsed_s, so_far.process_cpu_s)
        process_j = marginal_energy_j(board.idle_w, board.full_w, process.utilisation(board.cores), so_far.elapsed_s)
        return {
            "queries_throttled": self.queries_throttled,
            "elapsed_s": so_far.elapsed_s,
            "used_mah": self._mah(so_far.idle_j + process_j),
            "process_mah": self._mah(process_j),
            "marginal_mah": self._mah(so_far.marginal_j),
            "process_cpu_s": so_far.process_cpu_s,
            "stages_cpu_s": so_far.stages_cpu_s,
        }

    def look_at_heat(self) -> None:
        """Look at the sensors, once a second or so."""
        self.thermal = self._watch.look()

    def heat_fields(self) -> dict[str, Any]:
        """Give for the log: temperature, frequency, whether the board slows itself down, and why."""
        return asdict(self.thermal)

    def reading(self) -> Reading:
        """Give for the governor what was so since the last reading."""
        cpu_share, late_share = self._load.look()
        return Reading(
            cpu_share=cpu_share,
            late_share=late_share,
            rss_mb=rss_mb(),
            temperature_c=self.thermal.temperature_c,
            throttled=self.thermal.throttled,
        )

    def close(self) -> None:
        """Let go of the sensors."""
        self._watch.close()

    def _mah(self, energy_j: float) -> float:
        return 1000 * pack_ah(energy_j, self._pack, self._regulator_efficiency)
