"""Power cuts in mid-flight, and a start without any network."""

import random
import time

from faults_disks import LEARNT, learns, usual
from trial import PATIENCE_S, Row, Trial, of_kind
from world import wait_until

CUTS = 4
_SYNCED_S = 2.5  # a line is on the disk two seconds after it was written


def power_cut(trial: Trial) -> Row:
    row = Row(fault=f"power cut in mid-flight, while it learns ({CUTS} times, at random moments)")
    rng, world, begin_s = random.Random(1), trial.world, time.monotonic()
    booted_s, again_s, lines_s, places = [], [], [], 0  # places: that the logs of all flights call learnt
    learns(trial)
    for _ in range(CUTS):
        wait_until(lambda: of_kind(trial.log(), "query"), PATIENCE_S, "a query", look_s=1.0)
        time.sleep(rng.uniform(3, 20))
        seen, seen_s, first_s = trial.log(), trial.inside_s(), time.monotonic()
        time.sleep(rng.uniform(0, 2))
        cut_s = seen_s + time.monotonic() - first_s
        trial.machine.cut_power()
        power_s = time.monotonic()
        booted_s.append(trial.machine.boot())
        again_s.append(_first_query(trial, power_s))
        log = trial.log()
        lost = [line for line in seen if line["t_mono_s"] < cut_s - _SYNCED_S and line not in log]
        row.expect(not lost, f"no line is lost that was older than {_SYNCED_S} s ({len(lost)} are)")
        lines_s.append(max(0.0, cut_s - _before_the_cut(log)[-1]["t_mono_s"]))
        told = {line["place"] for line in of_kind(_before_the_cut(log), "learnt")}
        held = _held(trial)
        places = len(told)
        row.expect(told <= held, "every place that the log calls learnt is in the map")
        check = trial.tried(f"/opt/edgevpr/bin/edgevpr map check {LEARNT}")
        row.expect(check.code == 0, f"the map is sound ({check.text.strip()[-200:]})")
        row.expect(trial.unit("ActiveState") == "active", "the service is up by itself")
    row.told = world.ground.told_since(begin_s)
    row.again_s = max(again_s)
    row.does = (
        f"the service starts with the board ({max(booted_s):.0f} s at most until the system is up, "
        f"{max(again_s):.0f} s until the first query), and recovers map and log by itself"
    )
    row.kept = f"every place that the log calls learnt ({places} in all), and a sound map"
    row.lost = f"the last lines of the log: {max(lines_s):.1f} s of them at most"
    usual(trial)
    return row


def _first_query(trial: Trial, since_s: float) -> float:
    queries_s = trial.world.ground.queries_s
    wait_until(lambda: queries_s and queries_s[-1] > since_s, PATIENCE_S, "a query after the power cut")
    return next(each for each in queries_s if each > since_s) - since_s


def _before_the_cut(lines: list[dict]) -> list[dict]:
    """Return the lines before the last flight began: that is the one after the power cut."""
    last = max(number for number, line in enumerate(lines) if line["kind"] == "start" and "repeated" not in line)
    return lines[:last]


def _held(trial: Trial) -> set[int]:
    script = f"import sqlite3; print(*(row[0] for row in sqlite3.connect('file:{LEARNT}?mode=ro', uri=True).execute("
    script += "'SELECT place_id FROM places')))"
    return set(map(int, trial.run(f'/opt/edgevpr/bin/python -c "{script}"').split()))


def no_network(trial: Trial) -> Row:
    row = Row(fault="start of the board without any network")
    trial.run("systemctl enable edgevpr")
    trial.machine.shut_down()
    booted_s = trial.machine.boot(network=False)
    inside_s = trial.inside_s()
    row.expect(trial.unit("ActiveState") == "active", "the service is up")
    up_s = float(trial.unit("ActiveEnterTimestampMonotonic")) / 1e6
    time.sleep(10)
    row.expect(trial.restarts() == 0, "it was not restarted")
    status = trial.unit("StatusText")
    row.expect(trial.log()[-1]["kind"] != "end" and status, "it turns")
    row.does = (
        f"is up {up_s:.0f} s after the board was switched on, waits for camera and link, and keeps looking for both"
    )
    row.kept, row.lost = "everything", "what a network would have brought"
    trial.machine.shut_down()
    trial.machine.boot()
    back_s = time.monotonic()
    row.again_s = trial.next_match(back_s)
    row.expect(booted_s > 0 and inside_s > 0, "the machine boots")
    return row


FAULTS = (power_cut, no_network)
