"""The micro-benchmark: what it makes of its rounds, and that it runs, on however fast a machine."""

import pytest

from edgevpr.power import speed
from edgevpr.power.speed import Speed


def test_micro_benchmark_is_relative_to_the_reference(monkeypatch):
    rounds = iter([16 / speed.REFERENCE_PRODUCTS_HZ, 4 / speed.REFERENCE_PASSES_HZ])
    monkeypatch.setattr(speed, "_time_rounds_s", lambda work: [9.0, next(rounds)])
    assert speed.run_micro_benchmark() == Speed(pytest.approx(0.0625), pytest.approx(0.25))
