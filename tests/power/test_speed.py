"""The micro-benchmark: what it makes of its rounds, and that it runs, on however fast a machine."""

import pytest

from edgevpr.power import speed


def test_micro_benchmark_is_relative_to_the_reference(monkeypatch):
    rates_hz = {speed.product_round: speed.REFERENCE_PRODUCTS_HZ / 16, speed.pass_round: speed.REFERENCE_PASSES_HZ / 4}
    monkeypatch.setattr(speed, "_rates_hz", lambda make, threads: (rates_hz[make], 3 * rates_hz[make]))
    found = speed.micro_benchmark()
    assert (found.products, found.passes) == (0.0625, 0.25)
    assert (found.single, found.multi) == (0.125, 0.375)
    assert found.verified


def test_micro_benchmark_runs_on_this_machine(monkeypatch):
    monkeypatch.setattr(speed, "_MIN_TIME_S", 0.01)
    found = speed.micro_benchmark()
    assert all(value > 0 for value in (found.single, found.multi, found.products, found.passes))
    assert found.single == pytest.approx((found.products * found.passes) ** 0.5, rel=0.01)
