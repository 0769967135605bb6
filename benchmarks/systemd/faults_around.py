"""Faults of what is around the service: camera, link, clock, and a start before anything is there."""

import signal
import time

from trial import PATIENCE_S, Row, Trial, longest_gap_s, of_kind


def camera_lost(trial: Trial) -> Row:
    row = Row(fault="camera lost, and back after 15 s (stream)")
    trial.flies()
    restarts = trial.restarts()
    begin_s, world = time.monotonic(), trial.world
    world.kill(world.camera)
    told_s = trial.next_text("camera lost", begin_s)
    time.sleep(15)
    matches = sum(each > begin_s + told_s for each in world.ground.matches_s)
    back_s = time.monotonic()
    world.start_camera()
    row.again_s = trial.next_match(back_s)
    trial.next_text("camera is back", back_s)
    row.told = world.ground.told_since(begin_s)
    row.does = f"says so after {told_s:.0f} s, goes on turning, and opens it again after growing pauses (10 s at most)"
    row.kept, row.lost = "all but new matches", "pictures and fixes of that time"
    row.expect(trial.restarts() == restarts, "the service was not restarted")
    row.expect(matches <= 1, "no match comes without a picture, but for that of a query that was under way")
    row.expect(row.again_s < 20, "it works again within 20 s")
    return row


def camera_frozen(trial: Trial) -> Row:
    row = Row(fault="camera frozen: the same picture again and again")
    trial.flies()
    begin_s, world = time.monotonic(), trial.world
    world.camera.send_signal(signal.SIGUSR1)
    told_s = trial.next_text("camera frozen", begin_s)
    frozen_s = time.monotonic()
    time.sleep(10)
    wrong = sum(each > frozen_s for each in world.ground.matches_s)
    back_s = time.monotonic()
    world.camera.send_signal(signal.SIGUSR2)
    row.again_s = trial.next_match(back_s)
    trial.next_text("camera is back", back_s)
    row.told = world.ground.told_since(begin_s)
    row.does = f"refuses repeated pictures at once, and says so after {told_s:.0f} s"
    row.kept, row.lost = "all but new matches", "fixes of that time"
    row.expect(wrong == 0, "no match comes of a repeated picture")
    return row


def link_lost(trial: Trial) -> Row:
    row = Row(fault="flight controller silent for 40 s (link cut)")
    trial.flies()
    restarts = trial.restarts()
    begin_s, begin_inside_s, world = time.monotonic(), trial.inside_s(), trial.world
    world.kill(world.autopilot)
    time.sleep(40)
    matches = sum(each > begin_s for each in world.ground.matches_s)
    back_s, back_inside_s = time.monotonic(), trial.inside_s()
    world.start_autopilot()
    answered_s = trial.first_inside(
        lambda line: line["kind"] == "answer" and line["result"] == "ACCEPTED", back_inside_s
    )
    row.again_s = answered_s
    row.told = world.ground.told_since(begin_s)
    late = [line for line in of_kind(trial.log(), "answer") if (line.get("t_sent_s") or 0) > begin_inside_s]
    row.does = (
        f"goes on recognising ({matches} matches in that time, told to the ground station on its own link), sends no "
        f"fix, and the first fix after the link is back was taken after {answered_s:.0f} s"
    )
    row.kept, row.lost = "matches in the flight log", "fixes of that time"
    row.expect(matches > 5, "matches go on")
    row.expect(late, "fixes go on")
    row.expect(trial.restarts() == restarts and back_s > begin_s, "the service was not restarted")
    return row


def clock_set(trial: Trial) -> Row:
    row = Row(fault="clock of the board set 5 h ahead, then 10 h back, in flight")
    trial.flies()
    restarts = trial.restarts()
    begin_s, begin_inside_s, world = time.monotonic(), trial.inside_s(), trial.world
    for step in ("+5 hours", "-10 hours", "+5 hours"):
        trial.run(f"date -s '{step}' > /dev/null")
        time.sleep(8)
    row.told = world.ground.told_since(begin_s)
    matches_s = [each for each in world.ground.matches_s if each > begin_s]
    lines = [line for line in trial.log() if line["t_mono_s"] > begin_inside_s and line["kind"] == "query"]
    times_s = [line["t_mono_s"] for line in lines]
    hours = {line["time"][:13] for line in lines}
    gap_s = longest_gap_s(matches_s)
    row.does = (
        f"goes on: frames, fixes and ages run by the monotonic clock (longest pause between matches {gap_s:.1f} s)"
    )
    row.kept = "all; `t_mono_s` of the log's lines goes on, only `time` jumps"
    row.expect(times_s == sorted(times_s) and len(hours) >= 3, "the log's own clock goes on while the date jumps")
    row.expect(gap_s < 8 and len(matches_s) > 8, "matches go on without a pause")
    row.expect(trial.restarts() == restarts, "the service was not restarted, by its watchdog for example")
    return row


def nothing_there_yet(trial: Trial) -> Row:
    row = Row(fault="start before camera and flight controller are there")
    world = trial.world
    for process in filter(None, (world.camera, world.autopilot)):
        world.kill(process)
    begin_s = time.monotonic()
    trial.run("systemctl restart edgevpr", limit_s=PATIENCE_S)
    ready_s = time.monotonic() - begin_s
    time.sleep(20)
    row.expect(trial.unit("ActiveState") == "active", "the service is up without camera and flight controller")
    restarts = trial.restarts()
    back_s = time.monotonic()
    world.start_camera()
    world.start_autopilot()
    row.again_s = trial.next_match(back_s)
    time.sleep(6)
    row.told = world.ground.told_since(begin_s)
    row.does = f"is ready after {ready_s:.0f} s all the same, and waits for both"
    row.kept, row.lost = "everything", "nothing"
    row.expect(restarts == 0, "the service was not restarted")
    return row


FAULTS = (nothing_there_yet, camera_lost, camera_frozen, link_lost, clock_set)
