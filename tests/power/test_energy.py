"""Running totals of a scripted flight against the closed form."""

import random
import time

import pytest

from edgevpr.core.types import StageCost
from edgevpr.power.boards import load_board
from edgevpr.power.energy import RunningEnergy
from edgevpr.power.meter import stage

PI4 = load_board("rpi-4b")  # 2.29 W idle, 6.82 W full, 4 cores


def test_a_scripted_flight_costs_what_the_closed_form_says():
    """An hour of queries of all lengths, metered with the same fake clocks that the totals look at."""
    script, now_s, cpu_s = random.Random(7), [0.0], [0.0]
    energy = RunningEnergy(PI4, lambda: now_s[0], lambda: cpu_s[0])
    closed_j = closed_cpu_s = 0.0
    while now_s[0] < 3600:
        costs = []
        for _ in range(2):
            wall_s, cores = script.uniform(0.001, 0.8), script.uniform(0, 4)
            with stage(lambda: now_s[0], lambda: cpu_s[0]) as metered:
                now_s[0] += wall_s
                cpu_s[0] += wall_s * cores
            costs.append(metered.cost)
            closed_j += (2.29 + 4.53 * cores / 4) * wall_s  # (a + s U) t
            closed_cpu_s += wall_s * cores
        energy.add(*costs)
        rest_s = script.uniform(0, 1)
        now_s[0] += rest_s
        closed_j += 2.29 * rest_s
    so_far = energy.so_far()
    assert so_far.idle_j + so_far.marginal_j == pytest.approx(closed_j, rel=1e-9)
    assert so_far.idle_j == pytest.approx(2.29 * now_s[0], rel=1e-9)
    assert so_far.stages_cpu_s == pytest.approx(closed_cpu_s, rel=1e-9)
    assert so_far.process_cpu_s == pytest.approx(so_far.stages_cpu_s, rel=1e-9)


def test_waiting_costs_idle_power_only():
    now_s = [50.0]
    energy = RunningEnergy(PI4, lambda: now_s[0], lambda: 0.0)
    now_s[0] = 150.0
    so_far = energy.so_far()
    assert (so_far.elapsed_s, so_far.idle_j, so_far.marginal_j) == (100.0, pytest.approx(229.0), 0.0)


def test_a_stage_of_no_length_costs_nothing():
    energy = RunningEnergy(PI4, lambda: 0.0, lambda: 0.0)
    energy.add(StageCost(0.0, 0.0))
    so_far = energy.so_far()
    assert so_far.idle_j + so_far.marginal_j == 0


def test_stages_of_the_real_process_add_up_to_its_own_cpu_time():
    energy = RunningEnergy(PI4)
    for _ in range(3):
        with stage() as metered:
            until_s = time.process_time() + 0.05
            while time.process_time() < until_s:
                pass
        energy.add(metered.cost)
    so_far = energy.so_far()
    assert so_far.stages_cpu_s == pytest.approx(so_far.process_cpu_s, rel=0.03)
    assert so_far.stages_cpu_s <= so_far.process_cpu_s
