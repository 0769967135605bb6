"""The micro-benchmark: what it makes of its rounds, and that it runs, on however fast a machine."""

from threading import Barrier

import pytest

from edgevpr.power import speed


def test_micro_benchmark_is_relative_to_the_reference(monkeypatch):
    rates_hz = {speed.product_round: speed.REFERENCE_PRODUCTS_HZ / 16, speed.pass_round: speed.REFERENCE_PASSES_HZ / 4}
    monkeypatch.setattr(speed, "_rates_hz", lambda make, threads: (rates_hz[make], 3 * rates_hz[make]))
    found = speed.micro_benchmark()
    assert (found.products, found.passes) == (0.0625, 0.25)
    assert (found.single, found.multi) == (0.125, 0.375)
    assert found.verified


def test_rates_take_the_quickest_round_of_one_thread_and_all_of_several(monkeypatch):
    lengths_s = iter([[0.1, 0.3, 0.05, 0.2], [0.1, 0.3], [0.5]])
    monkeypatch.setattr(speed, "_round_times_s", lambda work, start: next(lengths_s))
    assert speed._rates_hz(lambda: None, 2) == (pytest.approx(20.0), pytest.approx(2 / 0.4 + 1 / 0.5))


def test_round_times_go_on_until_there_are_enough_rounds_and_time(monkeypatch):
    now_s = [0.0]
    monkeypatch.setattr(speed.time, "perf_counter", lambda: now_s[0])

    def work():
        now_s[0] += length_s

    for length_s, rounds in ((0.125, 5), (0.0625, 7)):
        assert speed._round_times_s(work, Barrier(1)) == [length_s] * rounds


def test_micro_benchmark_runs_on_this_machine(monkeypatch):
    monkeypatch.setattr(speed, "_MIN_TIME_S", 0.01)
    found = speed.micro_benchmark()
    assert all(value > 0 for value in (found.single, found.multi, found.products, found.passes))
    assert found.single == pytest.approx((found.products * found.passes) ** 0.5, rel=0.01)
