"""Faults of the service itself: signals, memory, its watchdog, its configuration, and how it ends."""

import time

from trial import MAP, PATIENCE_S, Row, Trial, of_kind
from world import wait_until

_START_S, _LOWER = 90, "/run/systemd/system/edgevpr.service.d"


def killed(trial: Trial) -> Row:
    row = Row(fault="the program is killed (SIGKILL)")
    trial.flies()
    begin_s, before = time.monotonic(), of_kind(trial.log(), "query")
    restarts = trial.restarts()
    trial.run("systemctl kill --signal=KILL --kill-whom=main edgevpr")
    row.again_s = trial.next_match(begin_s + 1)
    row.told = trial.world.ground.told_since(begin_s)
    after = trial.log()
    row.does = "systemd starts it again 2 s later"
    row.kept, row.lost = "map and every line of the flight log", "the query that was being worked on"
    row.expect([line for line in before if line not in after] == [], "no line of the log is lost")
    row.expect(trial.restarts() == restarts + 1, "one restart")
    return row


def storm(trial: Trial) -> Row:
    row = Row(fault="killed ten times in a row, each as soon as it runs")
    trial.flies()
    begin_s, restarts = time.monotonic(), trial.restarts()
    for number in range(10):
        wait_until(lambda: trial.unit("MainPID") != "0", PATIENCE_S, "a process")
        trial.run("systemctl kill --signal=KILL --kill-whom=main edgevpr")
        wait_until(lambda n=number: trial.restarts() > restarts + n, PATIENCE_S, "a restart")
    over_s = time.monotonic()
    row.again_s = trial.next_match(over_s)
    row.told = trial.world.ground.told_since(begin_s)
    row.does = "systemd never gives up (no start limit): each time it is started again after 2 s"
    row.kept, row.lost = "map and log", "the time in between"
    row.expect(trial.restarts() >= restarts + 10, "ten restarts")
    row.expect(trial.unit("ActiveState") == "active", "it is up at last")
    return row


def stopped(trial: Trial) -> Row:
    row = Row(fault="the program hangs (SIGSTOP)")
    trial.flies()
    begin_s, begin_inside_s, restarts = time.monotonic(), trial.inside_s(), trial.restarts()
    trial.run("systemctl kill --signal=STOP --kill-whom=main edgevpr")
    took_s = wait_until(lambda: trial.restarts() > restarts, PATIENCE_S, "a restart by the watchdog", look_s=0.5)
    row.again_s = trial.next_match(time.monotonic())
    row.told = trial.world.ground.told_since(begin_s)
    row.does = f"the watchdog of systemd (60 s) ends it, and it is started again, {took_s:.0f} s after it hung"
    row.kept, row.lost = "map and every line of the flight log", "fixes of that time"
    row.expect("watchdog" in trial.journal(begin_inside_s).lower(), "the journal says that it was the watchdog")
    row.expect(took_s < 75, "it is started again within 75 s")
    return row


def memory(trial: Trial) -> Row:
    row = Row(fault="memory limit reached (MemoryMax)")
    trial.flies()
    before = trial.log()
    begin_s, begin_inside_s, restarts = time.monotonic(), trial.inside_s(), trial.restarts()
    # A limit below what it takes does the same as a program that takes more than the limit.
    trial.run("systemctl set-property --runtime edgevpr MemoryMax=30M MemorySwapMax=0", check=False)
    wait_until(lambda: "oom" in trial.journal(begin_inside_s).lower(), PATIENCE_S, "the kernel's kill", look_s=0.5)
    trial.run("systemctl set-property --runtime edgevpr MemoryMax=256000000")
    limit_s = time.monotonic()
    wait_until(lambda: trial.restarts() > restarts, PATIENCE_S, "a restart")
    row.again_s = trial.next_match(limit_s)
    row.told = trial.world.ground.told_since(begin_s)
    row.does = "the kernel ends it and no other program, and systemd starts it again 2 s later"
    row.kept, row.lost = "map and every line of the flight log", "fixes of that time"
    after = trial.log()
    row.expect([line for line in before if line not in after] == [], "no line of the log is lost")
    row.expect(trial.unit("MemoryMax") == "256000000", "the limit is that of the board again")
    trial.run("rm -rf /run/systemd/system.control/edgevpr.service.d; systemctl daemon-reload")
    return row


def refused_memory(trial: Trial) -> Row:
    row = Row(fault="ten queries in a row fail (the kernel refuses the memory that they ask for)")
    trial.flies()
    begin_s, restarts = time.monotonic(), trial.restarts()
    pid = trial.unit("MainPID")
    trial.run(f"prlimit --pid {pid} --as=$(( $(awk '{{print $1}}' /proc/{pid}/statm) * 4096 ))")
    told_s = trial.next_text("frames in a row have failed", begin_s)
    trial.run(f"prlimit --pid {pid} --as=unlimited")
    back_s = time.monotonic()
    row.again_s = trial.next_match(back_s)
    trial.next_text("frames are recognised again", back_s)
    row.told = trial.world.ground.told_since(begin_s)
    row.does = (
        f"refuses each, and says after {told_s:.0f} s that it has become critical; it tries every further picture"
    )
    row.kept, row.lost = "all but these matches", "fixes of that time"
    row.expect(trial.restarts() == restarts, "the service was not restarted")
    return row


def map_damaged(trial: Trial) -> Row:
    row = Row(fault="map truncated in flight, and put back")
    trial.flies()
    begin_s, restarts = time.monotonic(), trial.restarts()
    trial.run(f"cp -a {MAP} /root/sound.gpkg; truncate -s 100000 {MAP}")
    told_s = trial.next_text("map", begin_s)
    time.sleep(5)
    accepted = [each for each in trial.world.ground.matches_s if each > begin_s + told_s]
    back_s = time.monotonic()
    trial.run(f"cp -a /root/sound.gpkg {MAP}.new && mv {MAP}.new {MAP}")
    row.again_s = trial.next_match(back_s)
    time.sleep(6)
    row.told = trial.world.ground.told_since(begin_s)
    row.does = f"refuses what cannot be read, says so after {told_s:.0f} s, and takes the map again once it is sound"
    row.kept, row.lost = "the flight, and its log", "fixes of that time"
    row.expect(trial.restarts() == restarts, "the service was not restarted")
    row.expect(row.told, "the ground station is told")
    row.does += f" ({len(accepted)} matches meanwhile)"
    return row


def reloaded(trial: Trial) -> Row:
    row = Row(fault="configuration changed in flight (systemctl reload), then spoilt")
    trial.flies()
    begin_s, inside_s, restarts = time.monotonic(), trial.inside_s(), trial.restarts()
    trial.configure(match={"accept_precision": 0.99}, battery={"pack": "6S8000"})
    trial.run("systemctl reload edgevpr")
    time.sleep(4)
    trial.machine.put("/etc/edgevpr/config.yaml", b"board: [\n")
    trial.run("systemctl reload edgevpr")
    time.sleep(4)
    said = trial.journal(inside_s)
    trial.configure()
    row.again_s = trial.next_match(time.monotonic())
    row.told = trial.world.ground.told_since(begin_s)
    row.does = (
        "takes the keys that may change in flight, names the others, and keeps what it has where a file is spoilt"
    )
    row.kept = "the flight"
    row.expect("accept_precision" in said and "battery" in said, "the journal names what is taken and what waits")
    row.expect(trial.restarts() == restarts and "config.yaml" in said, "a spoilt file is said and changes nothing")
    return row


def misconfigured(trial: Trial) -> Row:
    row = Row(fault="a mistake in the configuration at the start")
    trial.flies()
    begin_s = time.monotonic()
    trial.machine.put("/etc/edgevpr/config.yaml", b"sauce: {uri: /dev/video0}\n")
    inside_s = trial.inside_s()
    trial.tried("systemctl restart edgevpr", limit_s=PATIENCE_S)
    time.sleep(8)
    row.expect(trial.unit("ActiveState") == "failed", "it stays down")
    row.expect("sauce" in trial.journal(inside_s), "the journal names the key")
    row.told = trial.world.ground.told_since(begin_s)
    trial.configure()
    back_s = time.monotonic()
    trial.run("systemctl start edgevpr", limit_s=PATIENCE_S)
    row.again_s = trial.next_match(back_s)
    row.does = "ends with code 2 and one sentence in the journal, and is not tried again until it is corrected"
    row.kept, row.lost = "map and log", "the flight"
    return row


def ended(trial: Trial) -> Row:
    row = Row(fault="stopped by systemctl stop, in mid-flight")
    trial.flies()
    begin_s, took_s = time.monotonic(), []
    for _ in range(3):
        took_s.append(float(trial.run("a=$(date +%s%N); systemctl stop edgevpr; echo $(($(date +%s%N) - a))")) / 1e9)
        last = trial.log()[-1]
        row.expect(last["kind"] == "end", f"the log's last line is `end` (it is {last['kind']})")
        row.expect(trial.unit("Result") == "success", "it ends as a success")
        back_s = time.monotonic()
        trial.run("systemctl start edgevpr", limit_s=PATIENCE_S)
        row.again_s = trial.next_match(back_s)
    row.told = trial.world.ground.told_since(begin_s)
    row.does = f"ends within {max(took_s):.1f} s (slowest of three), with the line `end` in the log"
    row.kept = "everything"
    row.expect(max(took_s) < 2, "it ends within 2 s")
    return row


def slow_start(trial: Trial) -> Row:
    row = Row(fault=f"a start that takes longer than TimeoutStartSec (here {_START_S} s): `cohog`, a third of a core")
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
    return row


FAULTS = (killed, storm, stopped, memory, refused_memory, map_damaged, reloaded, misconfigured, ended)
