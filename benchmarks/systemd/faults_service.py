"""Faults of the service itself (signals, memory, its watchdog, its configuration), and of what is around it: camera,
link and clock."""

import signal
import time

import numpy as np
from trial import MAP, PATIENCE_S, Outcome, Trial, fault, of_kind
from world import wait_until

_START_S, _LOWER = 90, "/run/systemd/system/edgevpr.service.d"


@fault("start before camera and flight controller are there", flies=False, restarts=None)
def nothing_there_yet(trial: Trial, row: Outcome) -> None:
    world = trial.world
    for process in filter(None, (world.camera, world.autopilot)):
        world.kill(process)
    trial.restart()
    ready_s = time.monotonic() - trial.begin_s
    time.sleep(20)
    row.expect(trial.unit("ActiveState") == "active", "the service is up without camera and flight controller")
    row.expect(trial.restarts() == 0, "the service was not restarted")
    back_s = time.monotonic()
    world.start_camera()
    world.start_autopilot()
    row.again_s = trial.next_match(back_s)
    time.sleep(6)
    row.does = f"is ready after {ready_s:.0f} s all the same, and waits for both"
    row.kept, row.lost = "everything", "nothing"


@fault("camera lost, and back after 15 s (stream)")
def camera_lost(trial: Trial, row: Outcome) -> None:
    trial.world.kill(trial.world.camera)
    told_s = trial.next_text("camera lost", trial.begin_s)
    time.sleep(15)
    matches = len(trial.matches_since(trial.begin_s + told_s))
    back_s = time.monotonic()
    trial.world.start_camera()
    row.again_s = trial.next_match(back_s)
    trial.next_text("camera is back", back_s)
    row.does = f"says so after {told_s:.0f} s, goes on turning, and opens it again after growing pauses (10 s at most)"
    row.kept, row.lost = "all but new matches", "pictures and fixes of that time"
    row.expect(matches <= 1, "no match comes without a picture, but for that of a query that was under way")
    row.expect(row.again_s < 20, "it works again within 20 s")


@fault("camera frozen: the same picture again and again", restarts=None)
def camera_frozen(trial: Trial, row: Outcome) -> None:
    trial.world.camera.send_signal(signal.SIGUSR1)
    told_s = trial.next_text("camera frozen", trial.begin_s)
    frozen_s = time.monotonic()
    time.sleep(10)
    row.expect(not trial.matches_since(frozen_s), "no match comes of a repeated picture")
    back_s = time.monotonic()
    trial.world.camera.send_signal(signal.SIGUSR2)
    row.again_s = trial.next_match(back_s)
    trial.next_text("camera is back", back_s)
    row.does = f"refuses repeated pictures at once, and says so after {told_s:.0f} s"
    row.kept, row.lost = "all but new matches", "fixes of that time"


@fault("flight controller silent for 40 s (link cut)")
def link_lost(trial: Trial, row: Outcome) -> None:
    trial.world.kill(trial.world.autopilot)
    time.sleep(40)
    matches = len(trial.matches_since(trial.begin_s))
    back_inside_s = trial.inside_s()
    trial.world.start_autopilot()
    row.again_s = trial.first_inside(is_taken, back_inside_s)
    late = [line for line in of_kind(trial.log(), "answer") if (line.get("t_sent_s") or 0) > trial.begin_inside_s]
    row.does = (
        f"goes on recognising ({matches} matches in that time, told to the ground station on its own link), sends no "
        f"fix, and the first fix after the link is back was taken after {row.again_s:.0f} s"
    )
    row.kept, row.lost = "matches in the flight log", "fixes of that time"
    row.expect(matches > 5, "matches go on")
    row.expect(late, "fixes go on")


def is_taken(line: dict) -> bool:
    return line["kind"] == "answer" and line["result"] == "ACCEPTED"


@fault("clock of the board set 5 h ahead, then 10 h back, in flight")
def clock_set(trial: Trial, row: Outcome) -> None:
    for step in ("+5 hours", "-10 hours", "+5 hours"):
        trial.run(f"date -s '{step}' > /dev/null")
        time.sleep(8)
    matches_s = trial.matches_since(trial.begin_s)
    lines = [line for line in of_kind(trial.log(), "query") if line["t_mono_s"] > trial.begin_inside_s]
    times_s, gap_s = [line["t_mono_s"] for line in lines], max(np.diff(matches_s), default=0.0)
    row.does = (
        f"goes on: frames, fixes and ages run by the monotonic clock (longest pause between matches {gap_s:.1f} s)"
    )
    row.kept = "all; `t_mono_s` of the log's lines goes on, only `time` jumps"
    hours = {line["time"][:13] for line in lines}
    row.expect(times_s == sorted(times_s) and len(hours) >= 3, "the log's own clock goes on while the date jumps")
    row.expect(gap_s < 8 and len(matches_s) > 8, "matches go on without a pause")


@fault("the program is killed (SIGKILL)", restarts=1)
def killed(trial: Trial, row: Outcome) -> None:
    before = of_kind(trial.log(), "query")
    trial.run("systemctl kill --signal=KILL --kill-whom=main edgevpr")
    row.again_s = trial.next_match(trial.begin_s + 1)
    row.does = "systemd starts it again 2 s later"
    row.kept, row.lost = "map and every line of the flight log", "the query that was being worked on"
    _no_line_lost(trial, row, before)


def _no_line_lost(trial: Trial, row: Outcome, before: list[dict]) -> None:
    after = trial.log()
    row.expect(all(line in after for line in before), "no line of the log is lost")


@fault("killed ten times in a row, each as soon as it runs", restarts=None)
def storm(trial: Trial, row: Outcome) -> None:
    restarts = trial.restarts()
    for number in range(10):
        wait_until(lambda: trial.unit("MainPID") != "0", PATIENCE_S, "a process")
        trial.run("systemctl kill --signal=KILL --kill-whom=main edgevpr")
        wait_until(lambda n=number: trial.restarts() > restarts + n, PATIENCE_S, "a restart")
    row.again_s = trial.next_match(time.monotonic())
    row.does = "systemd never gives up (no start limit): each time it is started again after 2 s"
    row.kept, row.lost = "map and log", "the time in between"
    row.expect(trial.restarts() >= restarts + 10, "ten restarts")
    row.expect(trial.unit("ActiveState") == "active", "it is up at last")


@fault("the program hangs (SIGSTOP)", restarts=None)
def stopped(trial: Trial, row: Outcome) -> None:
    restarts = trial.restarts()
    trial.run("systemctl kill --signal=STOP --kill-whom=main edgevpr")
    took_s = wait_until(lambda: trial.restarts() > restarts, PATIENCE_S, "a restart by the watchdog", look_s=0.5)
    row.again_s = trial.next_match(time.monotonic())
    row.does = f"the watchdog of systemd (60 s) ends it, and it is started again, {took_s:.0f} s after it hung"
    row.kept, row.lost = "map and every line of the flight log", "fixes of that time"
    row.expect("watchdog" in trial.journal(trial.begin_inside_s).lower(), "the journal says that it was the watchdog")
    row.expect(took_s < 75, "it is started again within 75 s")


@fault("memory limit reached (MemoryMax)", restarts=None)
def memory(trial: Trial, row: Outcome) -> None:
    before, restarts = trial.log(), trial.restarts()
    # A limit below what it takes does the same as a program that takes more than the limit.
    trial.run("systemctl set-property --runtime edgevpr MemoryMax=30M MemorySwapMax=0", check=False)
    is_killed = lambda: "oom" in trial.journal(trial.begin_inside_s).lower()  # noqa: E731
    wait_until(is_killed, PATIENCE_S, "the kernel's kill", look_s=0.5)
    trial.run("systemctl set-property --runtime edgevpr MemoryMax=256000000")
    limit_s = time.monotonic()
    wait_until(lambda: trial.restarts() > restarts, PATIENCE_S, "a restart")
    row.again_s = trial.next_match(limit_s)
    row.does = "the kernel ends it and no other program, and systemd starts it again 2 s later"
    row.kept, row.lost = "map and every line of the flight log", "fixes of that time"
    _no_line_lost(trial, row, before)
    row.expect(trial.unit("MemoryMax") == "256000000", "the limit is that of the board again")
    trial.run("rm -rf /run/systemd/system.control/edgevpr.service.d; systemctl daemon-reload")


@fault("ten queries in a row fail (the kernel refuses the memory that they ask for)")
def refused_memory(trial: Trial, row: Outcome) -> None:
    pid = trial.unit("MainPID")
    trial.run(f"prlimit --pid {pid} --as=$(( $(awk '{{print $1}}' /proc/{pid}/statm) * 4096 ))")
    told_s = trial.next_text("frames in a row have failed", trial.begin_s)
    trial.run(f"prlimit --pid {pid} --as=unlimited")
    back_s = time.monotonic()
    row.again_s = trial.next_match(back_s)
    trial.next_text("frames are recognised again", back_s)
    row.does = (
        f"refuses each, and says after {told_s:.0f} s that it has become critical; it tries every further picture"
    )
    row.kept, row.lost = "all but these matches", "fixes of that time"


@fault("map truncated in flight, and put back")
def map_damaged(trial: Trial, row: Outcome) -> None:
    trial.run(f"cp -a {MAP} /root/sound.gpkg; truncate -s 100000 {MAP}")
    told_s = trial.next_text("map", trial.begin_s)
    time.sleep(5)
    accepted, back_s = len(trial.matches_since(trial.begin_s + told_s)), time.monotonic()
    trial.run(f"cp -a /root/sound.gpkg {MAP}.new && mv {MAP}.new {MAP}")
    row.again_s = trial.next_match(back_s)
    time.sleep(6)
    row.told = trial.world.ground.told_since(trial.begin_s)
    row.does = (
        f"refuses what cannot be read, says so after {told_s:.0f} s, and takes the map again once it is sound "
        f"({accepted} matches meanwhile)"
    )
    row.kept, row.lost = "the flight, and its log", "fixes of that time"
    row.expect(row.told, "the ground station is told")


@fault("a mistake in the configuration at the start", restarts=None)
def misconfigured(trial: Trial, row: Outcome) -> None:
    trial.machine.put("/etc/edgevpr/config.yaml", b"sauce: {uri: /dev/video0}\n")
    trial.tried("systemctl restart edgevpr", limit_s=PATIENCE_S)
    time.sleep(8)
    row.expect(trial.unit("ActiveState") == "failed", "it stays down")
    row.expect("sauce" in trial.journal(trial.begin_inside_s), "the journal names the key")
    row.told = trial.world.ground.told_since(trial.begin_s)
    trial.configure()
    back_s = time.monotonic()
    trial.run("systemctl start edgevpr", limit_s=PATIENCE_S)
    row.again_s = trial.next_match(back_s)
    row.does = "ends with code 2 and one sentence in the journal, and is not tried again until it is corrected"
    row.kept, row.lost = "map and log", "the flight"


@fault("stopped by systemctl stop, in mid-flight", restarts=None)
def ended(trial: Trial, row: Outcome) -> None:
    took_s = []
    for _ in range(3):
        took_s.append(float(trial.run("a=$(date +%s%N); systemctl stop edgevpr; echo $(($(date +%s%N) - a))")) / 1e9)
        last = trial.log()[-1]
        row.expect(last["kind"] == "end", f"the log's last line is `end` (it is {last['kind']})")
        row.expect(trial.unit("Result") == "success", "it ends as a success")
        back_s = time.monotonic()
        trial.run("systemctl start edgevpr", limit_s=PATIENCE_S)
        row.again_s = trial.next_match(back_s)
    row.does = f"ends within {max(took_s):.1f} s (slowest of three), with the line `end` in the log"
    row.kept = "everything"
    row.expect(max(took_s) < 2, "it ends within 2 s")


@fault(
    f"a start that takes longer than TimeoutStartSec (here {_START_S} s): `cohog`, a third of a core",
    flies=False,
    restarts=None,
)
def slow_start(trial: Trial, row: Outcome) -> None:
    trial.tried("systemctl stop edgevpr")
    slow = f"{MAP}.slow.gpkg"
    trial.machine.put(slow, (trial.world.flight / "slow.gpkg").read_bytes())
    trial.run(f"chmod 644 {slow}")
    trial.configure(map=slow)
    lower = f"[Service]\nTimeoutStartSec={_START_S}\nCPUQuota=30%%\n"
    trial.run(f"mkdir -p {_LOWER} && printf '{lower}' > {_LOWER}/lower.conf && systemctl daemon-reload")
    begin_s, inside_s = time.monotonic(), trial.inside_s()
    trial.tried("systemctl start edgevpr", limit_s=1500)
    took_s = time.monotonic() - begin_s
    row.expect(trial.unit("ActiveState") == "active", "it is up")
    row.expect(took_s > _START_S, f"the start takes longer than the time-out ({took_s:.0f} s)")
    row.expect("timed out" not in trial.journal(inside_s), "no start is broken off")
    row.does = f"asks systemd for more time for as long as it computes, and is up after {took_s:.0f} s"
    row.kept, row.lost = "everything", "nothing but time"
    trial.run(f"rm -r {_LOWER}; rm {slow}; systemctl stop edgevpr; systemctl daemon-reload", limit_s=PATIENCE_S)
    trial.configure()
