"""Stages and whole flights metered with a clock that says what the test wants, and with the real one."""

import threading
import time

import pytest
from fakes import FakeClock

from edgevpr.core.types import NO_COST, StageCost
from edgevpr.power.boards import load_board
from edgevpr.power.meter import ProcessLoad, QueryMeter, meter_stage


def test_stage_counts_the_cpu_time_of_other_threads():
    own_s = []

    def spin():
        while time.thread_time() < 0.02:
            pass
        own_s.append(time.thread_time())

    with meter_stage() as metered:
        thread = threading.Thread(target=spin)
        thread.start()
        thread.join()
    assert metered.cost.cpu_s >= own_s[0]
    assert metered.cost.wall_s > 0


def test_step_does_not_mask_an_exception_before_its_cost_is_set():
    """A flight is ended by an exception of a signal's handler, which can come at any call: here, of the clock."""

    class Ended(BaseException):
        pass

    calls = []

    def read_clock():
        calls.append(1)
        if len(calls) == 2:  # the first is of the beginning of the step
            raise Ended
        return 0.0

    meter = QueryMeter(load_board("generic-x86"), wall_clock=read_clock)
    meter.begin()
    with pytest.raises(Ended), meter.step("encode"):
        pass
    assert meter.steps().encode == NO_COST


class WorkingClock(FakeClock):
    """The load of a process, by a clock of its own."""

    def __init__(self):
        super().__init__()
        self.load = ProcessLoad(4, self, lambda: self.cpu_s)

    def work(self, wall_s, ran_s):
        """Work of one thread that ran for `ran_s` of `wall_s`."""
        super().work(wall_s, ran_s / wall_s)
        self.load.add_work(StageCost(wall_s, ran_s))


def test_own_load_counts_unrecorded_work_too():
    clocks = WorkingClock()
    clocks.work(0.5, 0.5)
    clocks.now_s += 1.5
    clocks.cpu_s += 0.3  # another thread decodes a stream
    assert clocks.load.age_s == 2.0
    assert clocks.load.measure() == (pytest.approx(0.8 / 2 / 4), 0.0)
    assert clocks.load.age_s == 0.0
    clocks.now_s += 1.0
    assert clocks.load.measure() == (0.0, 0.0), "since the last look"


def test_own_load_is_late_only_if_its_thread_had_to_wait():
    clocks = WorkingClock()
    clocks.work(0.99, 0.97)
    clocks.now_s += 0.01
    assert clocks.load.measure()[1] == 0.0, "it takes all the time, and nobody else does"
    clocks.work(0.9, 0.5)
    clocks.now_s += 0.1
    assert clocks.load.measure()[1] == pytest.approx(0.9)
