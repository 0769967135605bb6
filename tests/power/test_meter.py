"""Stages metered with a clock that says what the test wants, and with the real one."""

import threading
import time

import pytest

from edgevpr.core.types import NO_COST, StageCost
from edgevpr.power.boards import load_board
from edgevpr.power.equations import Pack, parse_pack
from edgevpr.power.meter import OwnMemory, QueryMeter, query_cost, stage


def clock(*readings):
    return iter(readings).__next__


def test_a_stage_costs_what_both_clocks_have_moved_on():
    with stage(clock(100.0, 100.75), clock(7.0, 8.5)) as metered:
        assert metered.cost == NO_COST
    assert metered.cost == StageCost(wall_s=0.75, cpu_s=1.5)


def test_the_cpu_time_of_other_threads_is_counted():
    own_s = []

    def spin():
        while time.thread_time() < 0.02:
            pass
        own_s.append(time.thread_time())

    with stage() as metered:
        thread = threading.Thread(target=spin)
        thread.start()
        thread.join()
    assert metered.cost.cpu_s >= own_s[0]
    assert metered.cost.wall_s > 0


def test_a_query_costs_by_the_closed_form():
    # Pi 4B, 2.29 W idle, 6.82 W full, 4 cores: one busy core for 0.4 s, then two for 1.5 s.
    with stage(clock(0.0, 0.4), clock(0.0, 0.4)) as encoding:
        pass
    with stage(clock(0.4, 1.9), clock(0.4, 3.4)) as matching:
        pass
    cost = query_cost(encoding.cost, matching.cost, load_board("rpi-4b"), Pack(4, 5200), 0.85, rss_mb=80.0)
    assert cost.u_encode == pytest.approx(0.25, abs=1e-9)
    assert cost.u_match == pytest.approx(0.5, abs=1e-9)
    assert (cost.t_encode_s, cost.t_match_s) == pytest.approx((0.4, 1.5), abs=1e-9)
    assert cost.cpu_s == pytest.approx(3.4, abs=1e-9)
    volt_hours = 14.8 * 0.85 * 3600
    total_j = (2.29 + 4.53 * 0.25) * 0.4 + (2.29 + 4.53 * 0.5) * 1.5
    marginal_j = 4.53 * 0.25 * 0.4 + 4.53 * 0.5 * 1.5
    assert cost.used_mah == pytest.approx(1000 * total_j / volt_hours, abs=1e-9)
    assert cost.marginal_mah == pytest.approx(1000 * marginal_j / volt_hours, abs=1e-9)
    assert cost.rss_mb == 80.0


def test_energy_summed_over_many_short_stages_is_the_closed_form():
    board, pack = load_board("rpi-3b-plus"), Pack(3, 2200)
    ticks = [(0.01 * (1 + i % 3), 0.02 * (i % 2)) for i in range(1000)]  # wall, CPU seconds
    summed_mah = sum(
        query_cost(StageCost(wall_s, cpu_s), StageCost(0, 0), board, pack, 0.9, rss_mb=80.0).used_mah
        for wall_s, cpu_s in ticks
    )
    wall_s, core_s = (sum(column) for column in zip(*ticks, strict=True))
    closed_j = board.idle_w * wall_s + (board.full_w - board.idle_w) * core_s / board.cores
    assert summed_mah == pytest.approx(closed_j / (11.1 * 0.9 * 3.6), abs=1e-9)


def test_the_memory_that_takes_long_to_read_is_read_every_twenty_seconds():
    now_s, answers = [0.0], iter([80.0, 81.0, None])
    memory = OwnMemory(lambda: now_s[0], lambda: next(answers))
    seen = []
    for now_s[0] in (0.0, 0.1, 19.9, 20.0, 39.9, 40.0, 59.9):
        seen.append(memory.look()[1])
    assert seen == [80.0, 80.0, 80.0, 81.0, 81.0, None, None]


def test_the_real_process_has_its_share_of_the_memory_it_shows():
    rss_mb, pss_mb = OwnMemory().look()
    if pss_mb is None:
        pytest.skip("this kernel does not say")
    assert 1 < pss_mb <= 1.05 * rss_mb


def test_a_signal_between_a_step_and_the_setting_of_its_cost_is_not_masked():
    """A flight is ended by an exception of a signal's handler, which can come at any call: here, of the clock."""

    class Ended(BaseException):
        pass

    calls = []

    def counted():
        calls.append(1)
        if len(calls) == 2:  # the first is of the beginning of the step
            raise Ended
        return 0.0

    meter = QueryMeter(load_board("generic-x86"), parse_pack("4S5200"), 0.85, wall_clock=counted)
    meter.begin()
    with pytest.raises(Ended), meter.step("encode"):
        pass
    assert meter.steps().encode == NO_COST
