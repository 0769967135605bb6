"""Faults of the board: media that are full, read-only or pulled, under the log and the map; power cuts; a start without
a network; and the installation, with devices that come and go."""

import random
import time

from faults_service import is_taken
from machine import HOST
from trial import LOG, MAP, PATIENCE_S, Outcome, Trial, fault, of_kind
from world import wait_until, write_track

LOGS, MAPS = "/var/log/edgevpr", "/var/lib/edgevpr"
LEARNT = f"{MAPS}/learnt.gpkg"
CUTS = 4
_SYNCED_S = 2.5  # a line is on the disk two seconds after it was written
_GADGET = "/sys/kernel/config/usb_gadget/fc"
# A flight controller on USB, made of the kernel's own parts: its vendor and product are ArduPilot's.
_PLUG_FC = f"""
modprobe dummy_hcd && modprobe libcomposite && mount -t configfs none /sys/kernel/config 2>/dev/null
mkdir -p {_GADGET}/strings/0x409 {_GADGET}/configs/c.1 {_GADGET}/functions/acm.0 && cd {_GADGET}
echo 0x1209 > idVendor && echo 0x5740 > idProduct && echo ArduPilot > strings/0x409/manufacturer
ln -s functions/acm.0 configs/c.1/ 2>/dev/null  # configfs takes the path from here
ls /sys/class/udc | head -1 > UDC && udevadm settle
"""
_UNPLUG_FC = f"echo > {_GADGET}/UDC; udevadm settle"


@fault("the disk of the flight log is full for 15 s", flies=False, restarts=None)
def log_full(trial: Trial, row: Outcome) -> None:
    _log_gone(trial, row, f"dd if=/dev/zero of={LOGS}/filler bs=64k 2>/dev/null", f"rm {LOGS}/filler")


@fault("the medium of the flight log turns read-only, and is mounted anew after 15 s", flies=False, restarts=None)
def log_read_only(trial: Trial, row: Outcome) -> None:
    # So does the kernel itself after an error of the medium. Nothing but to mount it anew makes it writable again.
    anew = f"umount -l {LOGS}; e2fsck -fy /dev/disk/by-label/logs > /dev/null; mount {LOGS}"
    _log_gone(trial, row, f"mount -o remount,abort {LOGS}; touch {LOGS}/a", anew)


@fault(
    "the USB stick of the flight log is pulled, and plugged in and mounted again after 15 s", flies=False, restarts=None
)
def log_pulled(trial: Trial, row: Outcome) -> None:
    _log_gone(trial, row, None, None)


def _log_gone(trial: Trial, row: Outcome, take: str | None, give: str | None) -> None:
    _mounted(trial)
    trial.flies()
    before, restarts, trial.begin_s = trial.log(), trial.restarts(), time.monotonic()
    trial.tried(take) if take else trial.machine.pull()
    time.sleep(15)
    status, matches_s = trial.unit("StatusText"), trial.matches_since(trial.begin_s)
    back_s, back_inside_s = time.monotonic(), trial.inside_s()
    if not give:
        trial.machine.plug()
        give = f"umount -l {LOGS}; sleep 5; mount {LOGS}"
    trial.tried(give)
    try:
        written_s = trial.first_inside(lambda line: True, back_inside_s, limit_s=60)
    except RuntimeError:
        row.expect(False, "the log is written again within 60 s")
        written_s = float("nan")
    after = trial.log()
    gaps = [line for line in of_kind(after, "gap") if line["t_mono_s"] > back_inside_s - 1]
    row.does = f"flies on without a log, says so in its status, and writes again {written_s:.1f} s after it can"
    row.kept = "the flight and its fixes, and all lines from before"
    lost = gaps[0]["lost_lines"] if gaps else 0
    row.lost = f"the lines of that time ({lost} of them, counted in a line `gap`)"
    row.expect(matches_s[-1:] and matches_s[-1] > back_s - 5, "matches go on")
    row.expect("cannot be written" in status or "moved" in status, f"its status says so (it says {status!r})")
    row.expect(all(line in after for line in before[:-3]), "no line from before is lost")
    row.expect(gaps, "the log says how much is missing")
    row.expect(trial.restarts() == restarts, "the service was not restarted")


def _mounted(trial: Trial) -> None:
    """Have the media of logs and maps mounted: a boot waits for them 10 s, in which a busy host may not find them. The
    service makes them its user's when it starts."""
    for folder in (LOGS, MAPS):
        if trial.tried(f"mountpoint -q {folder}").code:
            trial.run(f"systemctl stop edgevpr; mount {folder}", limit_s=PATIENCE_S)


@fault("the disk of the map is full while a flight learns", flies=False, restarts=None)
def map_full(trial: Trial, row: Outcome) -> None:
    _learns(trial)
    begin_s, inside_s, restarts = time.monotonic(), trial.inside_s(), trial.restarts()
    trial.tried(f"dd if=/dev/zero of={MAPS}/filler bs=64k 2>/dev/null")
    told_s = trial.next_text("nothing more is learnt", begin_s)
    queries = len(trial.world.ground.queries_s)
    time.sleep(6)
    row.expect(len(trial.world.ground.queries_s) > queries, "the flight goes on")
    trial.run(f"rm {MAPS}/filler")
    row.expect(trial.restarts() == restarts, "the service was not restarted")
    learnt = [line for line in of_kind(trial.log(), "learnt") if line["t_mono_s"] < inside_s]
    trial.restart()
    row.expect(len(_places(trial)) >= len(learnt) > 0, "no place is lost")
    trial.first_inside(lambda line: line["kind"] == "learnt", trial.inside_s() - 5)
    row.told = trial.world.ground.told_since(begin_s)
    row.does = f"learns nothing more, says so after {told_s:.0f} s, and goes on; after the next start it learns again"
    row.kept, row.lost = "every place that the log calls learnt", "places that would have been learnt since"
    _usual(trial)


def _learns(trial: Trial) -> None:
    """Begin a flight that makes a new map, and wait for its first places."""
    world = trial.world
    _mounted(trial)
    trial.tried("systemctl stop edgevpr")
    trial.run(f"rm -f {LEARNT}* {LOGS}/*.jsonl")
    if world.autopilot and world.autopilot.poll() is None:
        world.kill(world.autopilot)
    if world.camera is None or world.camera.poll() is not None:
        world.start_camera()
    world.start_autopilot("--track", write_track(world.flight / "track.csv"))
    # A dry run: no fix of ours is in the position that is learnt.
    mavlink = {name: f"udpout:{HOST}:{port}" for name, port in world.ports.items()} | {"send_fixes": False}
    trial.configure(map=LEARNT, technique="hog", mapping={"learn": True}, mavlink=mavlink)
    trial.run("systemctl reset-failed edgevpr; systemctl start edgevpr", limit_s=PATIENCE_S)
    wait_until(lambda: len(of_kind(trial.log(), "learnt")) >= 3, PATIENCE_S, "three places learnt", look_s=1.0)


def _usual(trial: Trial) -> None:
    """Have the usual flight configured again."""
    trial.world.kill(trial.world.autopilot)
    trial.configure()
    trial.tried("systemctl stop edgevpr")
    trial.run(f"rm -f {LEARNT}*")


def _places(trial: Trial) -> set[int]:
    """Return the places of the map that is learnt."""
    script = f"import sqlite3; print(*(row[0] for row in sqlite3.connect('file:{LEARNT}?mode=ro', uri=True).execute("
    script += "'SELECT place_id FROM places')))"
    return set(map(int, trial.run(f'/opt/edgevpr/bin/python -c "{script}"').split()))


@fault(f"power cut in mid-flight, while it learns ({CUTS} times, at random moments)", flies=False, restarts=None)
def power_cut(trial: Trial, row: Outcome) -> None:
    rng, booted_s, again_s, lines_s, places = random.Random(1), [], [], [], 0
    _learns(trial)
    for _ in range(CUTS):
        wait_until(lambda: of_kind(trial.log(), "query"), PATIENCE_S, "a query", look_s=1.0)
        time.sleep(rng.uniform(3, 20))
        seen, seen_s, first_s = trial.log(), trial.inside_s(), time.monotonic()
        time.sleep(rng.uniform(0, 2))
        cut_s = seen_s + time.monotonic() - first_s
        trial.machine.cut_power()
        power_s = time.monotonic()
        booted_s.append(trial.machine.boot())
        queries_s = trial.world.ground.queries_s
        wait_until(lambda s=power_s, q=queries_s: q and q[-1] > s, PATIENCE_S, "a query after the power cut")
        again_s.append(next(each for each in queries_s if each > power_s) - power_s)
        log = trial.log()
        lost = [line for line in seen if line["t_mono_s"] < cut_s - _SYNCED_S and line not in log]
        row.expect(not lost, f"no line is lost that was older than {_SYNCED_S} s ({len(lost)} are)")
        # The last flight is the one after the power cut.
        starts = [at for at, line in enumerate(log) if line["kind"] == "start" and "repeated" not in line]
        before = log[: starts[-1]]
        lines_s.append(max(0.0, cut_s - before[-1]["t_mono_s"]))
        told = {line["place"] for line in of_kind(before, "learnt")}
        places = len(told)
        row.expect(told <= _places(trial), "every place that the log calls learnt is in the map")
        check = trial.tried(f"/opt/edgevpr/bin/edgevpr map check {LEARNT}")
        row.expect(check.code == 0, f"the map is sound ({check.text.strip()[-200:]})")
        row.expect(trial.unit("ActiveState") == "active", "the service is up by itself")
    row.told, row.again_s = trial.world.ground.told_since(trial.begin_s), max(again_s)
    row.does = (
        f"the service starts with the board ({max(booted_s):.0f} s at most until the system is up, "
        f"{max(again_s):.0f} s until the first query), and recovers map and log by itself"
    )
    row.kept = f"every place that the log calls learnt ({places} in all), and a sound map"
    row.lost = f"the last lines of the log: {max(lines_s):.1f} s of them at most"
    _usual(trial)


@fault("start of the board without any network", flies=False, restarts=None)
def no_network(trial: Trial, row: Outcome) -> None:
    trial.run("systemctl enable edgevpr")
    trial.machine.shut_down()
    trial.machine.boot(network=False)
    row.expect(trial.unit("ActiveState") == "active", "the service is up")
    up_s = float(trial.unit("ActiveEnterTimestampMonotonic")) / 1e6
    time.sleep(10)
    row.expect(trial.restarts() == 0, "it was not restarted")
    row.expect(trial.log()[-1]["kind"] != "end" and trial.unit("StatusText"), "it turns")
    row.does = (
        f"is up {up_s:.0f} s after the board was switched on, waits for camera and link, and keeps looking for both"
    )
    row.kept, row.lost = "everything", "what a network would have brought"
    trial.machine.shut_down()
    trial.machine.boot()
    row.again_s = trial.next_match(time.monotonic())


@fault("judged by systemd: `systemd-analyze verify` and `security`", flies=False, restarts=None)
def judged(trial: Trial, row: Outcome) -> None:
    verified = trial.tried("systemd-analyze verify edgevpr.service")
    exposure = trial.run("systemd-analyze security edgevpr.service --no-pager").splitlines()[-1]
    row.does = exposure.strip().lstrip("→ ").replace("for edgevpr.service: ", "").removesuffix(" :-)")
    row.expect(verified.code == 0 and not verified.text.strip(), f"verify is silent ({verified.text.strip()})")
    limits = {name: trial.unit(name) for name in ("MemoryMax", "CPUQuotaPerSecUSec", "WatchdogUSec", "MemoryCurrent")}
    row.kept = ", ".join(f"{name} {value}" for name, value in limits.items())
    row.expect(limits["MemoryMax"] == "256000000" and limits["MemoryCurrent"].isdigit(), "the limit of memory holds")


@fault("flight controller on USB pulled, and plugged in again after 10 s", flies=False, restarts=None)
def usb_named(trial: Trial, row: Outcome) -> None:
    trial.run(_PLUG_FC)
    wait_until(lambda: trial.tried("test -e /dev/edgevpr-fc").code == 0, PATIENCE_S, "/dev/edgevpr-fc", look_s=1.0)
    listed = trial.tried("ls -l /dev/edgevpr-fc; stat -Lc '%G %a' /dev/edgevpr-fc").text
    row.expect("dialout 660" in listed, f"/dev/edgevpr-fc is there, for the group dialout ({listed.strip()})")
    ground = f"udpout:{HOST}:{trial.world.ground.port}"
    trial.configure(mavlink={"link": "serial:/dev/edgevpr-fc:921600", "ground": ground})
    fly = "systemd-run -q --unit=fc /opt/edgevpr/bin/edgevpr simulate autopilot --link serial:/dev/ttyGS0:921600"
    trial.run(f"{fly}; systemctl restart edgevpr", limit_s=PATIENCE_S)
    trial.first_inside(is_taken, trial.inside_s())
    begin_s, restarts = time.monotonic(), trial.restarts()
    trial.run(f"systemctl stop fc; {_UNPLUG_FC}")
    time.sleep(10)
    row.expect(trial.tried("test -e /dev/edgevpr-fc").code, "the name goes with the device")
    back_inside_s = trial.inside_s()
    trial.run(f"ls /sys/class/udc | head -1 > {_GADGET}/UDC; udevadm settle; {fly}")
    row.again_s = trial.first_inside(is_taken, back_inside_s)
    row.told = trial.world.ground.told_since(begin_s)
    row.does = "goes on recognising, opens the port again, and finds the flight controller under the same name"
    row.kept, row.lost = "matches in the flight log", "fixes of that time"
    row.expect(trial.restarts() == restarts, "the service was not restarted")
    trial.tried(f"systemctl stop fc; {_UNPLUG_FC}")
    trial.configure()
    trial.restart()


@fault("V4L2 camera lost, and back after 15 s", flies=False, restarts=None)
def v4l_lost(trial: Trial, row: Outcome) -> None:
    trial.run("modprobe vivid n_devs=1 node_types=0x1 && udevadm settle")
    device = trial.run("ls /dev/video* | head -1").strip()
    row.expect("video 660" in trial.run(f"stat -c '%G %a' {device}"), "the camera is for the group video")
    trial.configure(source={"uri": device, "rate_hz": 1.0})
    trial.restart()
    ground = trial.world.ground
    queries = len(ground.queries_s)
    wait_until(lambda: len(ground.queries_s) > queries + 2, PATIENCE_S, "queries of the camera")
    begin_s, restarts = time.monotonic(), trial.restarts()
    trial.run("echo vivid.0 > /sys/bus/platform/drivers/vivid/unbind")
    told_s = trial.next_text("camera lost", begin_s)
    time.sleep(15)
    back_s = time.monotonic()
    trial.run("echo vivid.0 > /sys/bus/platform/drivers/vivid/bind; udevadm settle")
    wait_until(lambda: ground.queries_s[-1] > back_s + 1, PATIENCE_S, "a query of the camera that is back")
    row.again_s = next(each for each in ground.queries_s if each > back_s + 0.5) - back_s
    trial.next_text("camera is back", back_s)
    row.told = ground.told_since(begin_s)
    row.does = (
        f"says so after {told_s:.0f} s, goes on turning, and opens it again (a query counts, for it shows no ground)"
    )
    row.kept, row.lost = "all but new matches", "pictures and fixes of that time"
    row.expect(trial.restarts() == restarts, "the service was not restarted")
    trial.configure()
    trial.restart()


@fault("`service uninstall` while it flies", restarts=None)
def uninstalled(trial: Trial, row: Outcome) -> None:
    look = f"sha256sum {MAP} /etc/edgevpr/config.yaml; wc -l < {LOG}"
    before = trial.run(look).splitlines()
    trial.run("/root/edgevpr/bin/edgevpr service uninstall")
    after = trial.run(look).splitlines()
    gone = trial.tried("ls -d /opt/edgevpr /etc/systemd/system/edgevpr.service /etc/udev/rules.d/99-edgevpr.rules").text
    row.expect(before[:2] == after[:2] and int(after[2]) >= int(before[2]), "map, log and configuration stay")
    row.expect(trial.log()[-1]["kind"] == "end", "the flight ends with its log flushed")
    row.expect(gone.count("No such file") == 3, f"program, unit and rules are gone ({gone})")
    row.expect(trial.tried("pgrep -f '[e]dgevpr run'").code == 1, "nothing of it runs")
    row.does = "stops it, and takes program, unit and udev rules away"
    row.kept, row.lost = "map, flight log, configuration and the user", "program, unit and rules"
